"""Run a closed-box experiment and measure what shows whether the solver is right.

Checks at every 10,000th substep and at the end: the range of J, the cells without a particle, and
divergence against vorticity. Kinetic energy at every frame. In the cavity, the velocity on the
centre lines, averaged over the last part of the run, against Ghia, Ghia & Shin.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.generators.solver import Device, build

from . import ghia
from .diagnostics import (
    Profiles,
    box_of,
    displacement_energy,
    extract,
    grid_rates,
    kinetic_energy,
    lid_corners,
    occupancy,
)
from .experiment import Case, Experiment, initial_state, solver_parameters

if TYPE_CHECKING:
    from lagbench.generators.closed_box import ClosedBox

__all__ = ["AVERAGED", "CHECK_EVERY", "Check", "Result", "run"]


CHECK_EVERY = 10_000
"""Substeps between two checks."""

AVERAGED = 3000
"""Substeps at the end over which the nodal velocity is averaged, at most a quarter of the run."""

Report = Callable[[int], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Check:
    """State of the box at one substep."""

    substep: int  # when
    jacobian_min: float  # smallest J of any particle [1]
    jacobian_max: float  # largest J of any particle [1]
    jacobian_min_outside_lid_corners: float  # the same without the 5 x 5 cells at either end of a lid [1]
    jacobian_max_outside_lid_corners: float  # likewise [1]
    empty_cells: int  # cells without a particle
    particles_per_cell_min: int  # particles in the emptiest cell
    particles_per_cell_max: int  # particles in the fullest cell
    divergence_rms: float  # of the nodal velocity [1/s]
    vorticity_rms: float  # of the nodal velocity [1/s]
    divergence_over_vorticity: float  # their ratio [1]; NaN for a fluid at rest


@dataclasses.dataclass(kw_only=True)
class Result:
    """What a run has shown so far."""

    experiment: Experiment  # the settings
    checks: list[Check] = dataclasses.field(default_factory=list)  # one per check, in time order
    # substep of each record of the energy, 0 first
    frame_substeps: list[int] = dataclasses.field(default_factory=list)
    # E = sum m v_p^2 / 2 at each of them [mass length^2/s^2]
    kinetic_energy: list[float] = dataclasses.field(default_factory=list)
    # sum m (x(f) - x(f-1))^2 / 2 of each whole frame from the first [mass length^2]
    displacement_energy: list[float] = dataclasses.field(default_factory=list)
    averaged_from: int  # first substep of the velocity average
    profiles: Profiles | None = None  # centre lines; None in curl noise
    seconds: float = 0.0  # wall time spent in the solver [s]

    @property
    def retention(self) -> float | None:
        """Curl noise: displacement energy of the last frame over the first's [1]."""
        energy = self.displacement_energy
        if self.experiment.case is not Case.CURL_NOISE or not energy or energy[0] == 0.0:
            return None
        return energy[-1] / energy[0]

    @property
    def largest_rise_after_lid_off(self) -> float | None:
        """Largest gain of kinetic energy from one frame to the next, relative [1].

        Counts from the frame at which the lid stops; not above 0 where the energy falls
        monotonically. None while the lid moves.
        """
        off = self.experiment.lid_off_after
        if off is None:
            return None
        after = [e for at, e in zip(self.frame_substeps, self.kinetic_energy, strict=True) if at >= off]
        return max((b / a - 1.0 for a, b in itertools.pairwise(after)), default=None)

    def deviations(self) -> tuple[ghia.Deviation, ghia.Deviation] | None:
        """Return the deviation of u and of v from Ghia, Ghia & Shin, where they tabulate."""
        reference = ghia.centre_lines(self.experiment.reynolds or 0.0)
        if self.profiles is None or reference is None or self.experiment.lid_off_after is not None:
            return None
        found = self.profiles.at_reference_points()
        return ghia.deviation(found.u, reference.u), ghia.deviation(found.v, reference.v)


class _Run:
    """A solver and the result that grows with it."""

    def __init__(self, experiment: Experiment, device: Device) -> None:
        self.result = Result(experiment=experiment, averaged_from=experiment.substeps - averaged(experiment))
        self.parameters = solver_parameters(experiment)
        self.box = box_of(self.parameters)
        self.state = initial_state(experiment)
        self.mass = self.parameters.density * self.state.area / experiment.particles
        threads = 1 if device is Device.CPU else None
        self.solver = cast("ClosedBox", build(self.parameters, device=device, threads=threads))
        # The first substep compiles; loading again starts afresh, and no compilation is timed.
        self.solver.load([self.state])
        self.solver.advance(1)
        self.solver.load([self.state])
        self.before = self.solver.position()[0]

    def advance(self, first: int, last: int) -> None:
        start = time.perf_counter()
        self.solver.advance(last - first, average=first >= self.result.averaged_from)
        self.result.seconds += time.perf_counter() - start
        if last == self.result.experiment.lid_off_after:
            self.solver.move_walls(np.zeros((1, *self.state.wall_velocity.shape), np.float32))

    def interior(self, nodal: NDArray[np.floating]) -> NDArray[np.floating]:
        inside = slice(self.parameters.wall + 1, self.parameters.grid - self.parameters.wall)
        return nodal[inside, inside]

    def record_frame(self, substep: int) -> None:
        self.result.frame_substeps.append(substep)
        self.result.kinetic_energy.append(kinetic_energy(self.solver.velocity()[0], self.mass))
        if substep > 0:
            after = self.solver.position()[0]
            self.result.displacement_energy.append(displacement_energy(after, self.before, self.mass))
            self.before = after

    def check(self, substep: int) -> None:
        position, jacobian = self.solver.position()[0], self.solver.jacobian()[0]
        driven = self.result.experiment.case is Case.CAVITY
        outside = jacobian[~lid_corners(position, self.box)] if driven else jacobian
        counts = occupancy(position, self.box)
        rates = grid_rates(self.interior(self.solver.grid_velocity()[0]), self.box.spacing)
        self.result.checks.append(
            Check(
                substep=substep,
                jacobian_min=float(jacobian.min()),
                jacobian_max=float(jacobian.max()),
                jacobian_min_outside_lid_corners=float(outside.min()),
                jacobian_max_outside_lid_corners=float(outside.max()),
                empty_cells=int(np.sum(counts == 0)),
                particles_per_cell_min=int(counts.min()),
                particles_per_cell_max=int(counts.max()),
                divergence_rms=rates.divergence,
                vorticity_rms=rates.vorticity,
                divergence_over_vorticity=rates.ratio,
            )
        )


def stops(experiment: Experiment) -> Iterator[int]:
    """Yield the substeps at which the run pauses, ascending, the last one of the run included."""
    last = experiment.substeps
    points = {last, last - averaged(experiment), *range(CHECK_EVERY, last, CHECK_EVERY)}
    points.update(range(experiment.frame_substeps, last, experiment.frame_substeps))
    if experiment.lid_off_after is not None:
        points.add(experiment.lid_off_after)
    yield from sorted(points - {0})


def averaged(experiment: Experiment) -> int:
    """Return the substeps at the end over which the nodal velocity is averaged."""
    return max(1, min(AVERAGED, experiment.substeps // 4))


def run(experiment: Experiment, *, device: Device = Device.CPU, report: Report = lambda _: None) -> Result:
    """Simulate an experiment and measure it."""
    running = _Run(experiment, device)
    running.record_frame(0)
    done = 0
    for stop in stops(experiment):
        running.advance(done, stop)
        done = stop
        if done % experiment.frame_substeps == 0:
            running.record_frame(done)
        if done % CHECK_EVERY == 0 or done == experiment.substeps:
            running.check(done)
        report(done)
    if experiment.case is Case.CAVITY:
        mean = running.interior(running.solver.mean_grid_velocity()[0])
        running.result.profiles = extract(mean, running.box, experiment.lid_speed)
    return running.result
