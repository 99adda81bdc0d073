"""Scenarios of one size that a solver advances together, from frame to frame.

Every scenario starts recording at a substep of its own, so a batch advances from one frame
to the next, whichever scenario it belongs to. On ``Device.CPU`` a batch is one scenario.
"""

from __future__ import annotations

import functools
import importlib
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError, WorkFailedError
from lagbench.registry import Size

from .base import ClosedBoxParameters, FreeSurfaceParameters, InitialState, Split
from .draws import generator
from .solver import Device, Solver, build

__all__ = ["Batch", "Extremes", "Job", "Report", "draw", "split_module", "substeps_of"]

STRIDE = 4_000_000
"""Particle-substeps between two reports: about a tenth of a second on a core."""

Report = Callable[[int], None]
"""Called with the substeps done since the last call, summed over scenarios."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What a worker simulates in one go; picklable.

    Attributes:
        size: tier of a split with its parameters.
        scenarios: ids that advance together; one on ``Device.CPU``.
        root: folder that holds all data sets.
        device: where the solver runs.
    """

    size: Size
    scenarios: tuple[int, ...]
    root: Path
    device: Device = Device.CPU


def split_module(size: Size) -> Split:
    """Return the module that draws the scenarios of a size.

    Raises:
        UsageError: it cannot be imported or lacks a function of ``base.Split``.
    """
    try:
        module = importlib.import_module(size.generator)
    except ImportError as error:
        raise UsageError(
            f"the generator of split {size.split!r} cannot be imported", where=size.generator, got=error
        ) from error
    missing = [name for name in ("solver_parameters", "initial_state") if not hasattr(module, name)]
    if missing:
        raise UsageError(f"a generator lacks {' and '.join(missing)}", where=size.generator)
    return cast("Split", module)


def draw(size: Size, scenario: int) -> InitialState:
    """Return a scenario before its first substep.

    Raises:
        WorkFailedError: the parameters lead to values that cannot be drawn.
    """
    rng = generator(size.split, size.name, size.major, scenario)
    try:
        return split_module(size).initial_state(size, scenario, rng)
    except WorkFailedError as error:
        raise _placed(error, f"{size.split} {size.name}, scenario {scenario}") from error


def _placed(error: WorkFailedError, where: str) -> WorkFailedError:
    """Return an error that says where it happened."""
    return WorkFailedError(error.what, where=where, expected=error.expected, got=error.got, fix=error.fix)


def substeps_of(size: Size, scenario: int) -> int:
    """Return how many substeps a scenario takes, those before frame 0 included."""
    recorded = (size.frame_count(scenario) - 1) * size.substeps_per_frame
    return draw(size, scenario).start_substep + recorded


@dataclass
class Extremes:
    """The widest values that a scenario has shown at any substep.

    Attributes:
        max_speed: largest velocity component [length/s].
        jacobian_min: smallest J of any particle [1].
        jacobian_max: largest J of any particle [1].
    """

    max_speed: float = 0.0
    jacobian_min: float = np.inf
    jacobian_max: float = -np.inf


class Batch:
    """Scenarios in a solver, and the frames at which they are due.

    Args:
        job: what to simulate.
        report: see :data:`Report`.
        frames: frames wanted of each scenario; None for all that it records.

    Attributes:
        states: the scenarios before their first substep.
        extremes: what each has gone through so far.
        solver: holds the scenarios in the order of the job.
    """

    def __init__(self, job: Job, report: Report, frames: Sequence[int] | None = None) -> None:
        self.job = job
        self.states = [draw(job.size, scenario) for scenario in job.scenarios]
        self.extremes = [Extremes() for _ in job.scenarios]
        self.solver = _solver(
            split_module(job.size).solver_parameters(job.size), job.device, len(self.states)
        )
        with self._naming():
            self.solver.load(self.states)
        self._report = report
        self._frames = frames or [job.size.frame_count(scenario) for scenario in job.scenarios]
        self._now = 0

    def recordings(self) -> Iterator[tuple[int, int]]:
        """Yield (index in the batch, frame) whenever the solver stands at that frame.

        Raises:
            WorkFailedError: a scenario blew up; says which, when, and the broken bound.
        """
        for substep, due in groupby(self._schedule(), key=lambda entry: entry[0]):
            self._advance_to(substep)
            self._position = self.solver.position()
            self._velocity = self.solver.velocity()
            for _, index, frame in due:
                yield index, frame

    def frame(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return position [length] and velocity [length/s] of a scenario, shape [particle, 2].

        They are those of the last yield of :meth:`recordings`.
        """
        return self._position[index], self._velocity[index]

    def _schedule(self) -> list[tuple[int, int, int]]:
        interval = self.job.size.substeps_per_frame
        return sorted(
            (state.start_substep + frame * interval, index, frame)
            for index, (state, count) in enumerate(zip(self.states, self._frames, strict=True))
            for frame in range(count)
        )

    def _advance_to(self, substep: int) -> None:
        stride = max(1, STRIDE // (self.job.size.particles * len(self.states)))
        while self._now < substep:
            count = min(stride, substep - self._now)
            with self._naming():
                self.solver.advance(count)
            self._now += count
            self._account(count)

    def _account(self, count: int) -> None:
        """Widen the extremes of the scenarios that still record, and report the work."""
        interval = self.job.size.substeps_per_frame
        running = 0
        for index, health in enumerate(self.solver.health()):
            end = self.states[index].start_substep + (self._frames[index] - 1) * interval
            if self._now <= end:
                running += 1
                widest = self.extremes[index]
                widest.max_speed = max(widest.max_speed, health.max_speed)
                widest.jacobian_min = min(widest.jacobian_min, health.jacobian_min)
                widest.jacobian_max = max(widest.jacobian_max, health.jacobian_max)
        self._report(count * running)

    @contextmanager
    def _naming(self) -> Iterator[None]:
        """Put a scenario's id into errors of the solver, which knows its index only."""
        ids, size = self.job.scenarios, self.job.size
        try:
            yield
        except WorkFailedError as error:
            place = re.sub(
                r"scenario (\d+)", lambda found: f"scenario {ids[int(found[1])]}", error.where or ""
            )
            raise _placed(error, f"{size.split} {size.name}, {place}") from error


@functools.lru_cache(maxsize=1)
def _solver(
    parameters: ClosedBoxParameters | FreeSurfaceParameters, device: Device, scenarios: int
) -> Solver:
    """Build a solver, or take the last one again: building compiles."""
    threads = 1 if device is Device.CPU else None
    return build(parameters, device=device, scenarios=scenarios, threads=threads)
