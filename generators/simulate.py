"""Simulate scenarios of a size and write each to its file.

Neither xarray nor pandas is imported, which keeps a worker below 400 MB.
"""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field

import numpy as np
from numpy.typing import NDArray

from lagbench.format import ScenarioKey, ScenarioWriter, scenario_path
from lagbench.registry import Size

from .base import ClosedBoxParameters, InitialState
from .batch import Batch, Job, Report, split_module
from .draws import seed_text

__all__ = ["Facts", "Outcome", "file_parameters", "scenario_key", "scenario_writer", "simulate"]

_FILE_NAMES = {"reynolds": "reynolds_number"}
"""Drawn parameters that files call by their CF-like long name."""


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What one simulated scenario went through; the manifest states it.

    Attributes:
        start_substep: substeps before frame 0.
        kinetic_energy_first: sum of m v^2 / 2 at frame 0.
        kinetic_energy_last: the same at the last frame.
        kinetic_energy_max: the largest of any frame.
        kinetic_energy_mean: the mean over frames.
        energy_last_over_max: last over largest; small where the motion has died down.
        max_speed: largest velocity component at any substep [length/s].
        cfl: cells that this speed crosses per substep [1].
        jacobian_min: smallest J of any particle at any substep [1].
        jacobian_max: largest J of any particle at any substep [1].
    """

    start_substep: int
    kinetic_energy_first: float
    kinetic_energy_last: float
    kinetic_energy_max: float
    kinetic_energy_mean: float
    energy_last_over_max: float
    max_speed: float
    cfl: float
    jacobian_min: float
    jacobian_max: float


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """A scenario that was simulated and written.

    Attributes:
        scenario: its id.
        content_sha256: content hash of its file.
        facts: see :class:`Facts`, as a plain mapping.
    """

    scenario: int
    content_sha256: str
    facts: dict[str, int | float]


def scenario_key(size: Size, scenario: int) -> ScenarioKey:
    """Return what names a scenario of a size."""
    return ScenarioKey(
        split=size.split,
        size=size.name,
        version=size.version,
        scenario=scenario,
        subset=size.subset_of(scenario),
    )


def _particle_mass(size: Size, state: InitialState) -> float:
    return float(size.value("density")) * state.area / size.particles


def file_parameters(size: Size, state: InitialState) -> dict[str, object]:
    """Return what a scenario's file states and hashes: constants, then what was drawn."""
    constants = {name: parameter.value for name, parameter in size.parameters.items()}
    drawn = {_FILE_NAMES.get(name, name): value for name, value in state.parameters.items()}
    return {**constants, **drawn, "start_substep": state.start_substep}


def scenario_writer(job: Job, scenario: int, state: InitialState) -> ScenarioWriter:
    """Return the writer of a scenario's file, with all that is known before it runs."""
    size = job.size
    key = scenario_key(size, scenario)
    closed = isinstance(split_module(size).solver_parameters(size), ClosedBoxParameters)
    return ScenarioWriter(
        scenario_path(job.root, key),
        key,
        particles=size.particles,
        frames=size.frame_count(scenario),
        frame_interval=size.frame_interval,
        material=state.material,
        particle_mass=_particle_mass(size, state),
        wall_velocity=state.wall_velocity if closed else None,
        parameters=file_parameters(size, state),
        seed=seed_text(size.split, size.name, size.major, scenario),
        device=job.device.value,
        generator=size.generator,
    )


@dataclass
class _Recording:
    """One scenario's open file and its kinetic energy, frame by frame."""

    writer: ScenarioWriter
    mass: float
    energies: list[float] = field(default_factory=list)

    def append(self, position: NDArray[np.float32], velocity: NDArray[np.float32]) -> None:
        self.writer.append(position, velocity)
        speed = velocity.astype(np.float64)
        self.energies.append(0.5 * self.mass * float(np.sum(speed * speed)))


def _facts(batch: Batch, index: int, energies: list[float]) -> Facts:
    extremes, size = batch.extremes[index], batch.job.size
    largest = max(energies)
    return Facts(
        start_substep=batch.states[index].start_substep,
        kinetic_energy_first=energies[0],
        kinetic_energy_last=energies[-1],
        kinetic_energy_max=largest,
        kinetic_energy_mean=math.fsum(energies) / len(energies),
        energy_last_over_max=energies[-1] / largest if largest > 0.0 else 0.0,
        max_speed=extremes.max_speed,
        cfl=extremes.max_speed * size.dt * size.grid,
        jacobian_min=extremes.jacobian_min,
        jacobian_max=extremes.jacobian_max,
    )


def simulate(job: Job, report: Report) -> list[Outcome]:
    """Simulate the scenarios of a job and write their files, all or none of them.

    Args:
        job: what to simulate and where to write it.
        report: told the substeps done.

    Raises:
        WorkFailedError: a scenario blew up (which one, at which substep, which bound), or a
            file cannot be written; then no file of the job appears.
    """
    batch = Batch(job, report)
    with ExitStack() as stack:
        recordings = [
            _Recording(
                stack.enter_context(scenario_writer(job, scenario, state)), _particle_mass(job.size, state)
            )
            for scenario, state in zip(job.scenarios, batch.states, strict=True)
        ]
        for index, _ in batch.recordings():
            recordings[index].append(*batch.frame(index))
    return [
        Outcome(
            scenario=scenario,
            content_sha256=recording.writer.content_sha256,
            facts=asdict(_facts(batch, index, recording.energies)),
        )
        for index, (scenario, recording) in enumerate(zip(job.scenarios, recordings, strict=True))
    ]
