"""Scenarios of one size that a solver advances together, from frame to frame.

Every scenario starts recording after frames of its own, so a batch advances from one
frame to the next, whichever scenario it belongs to. On ``Device.CPU`` a batch is one
scenario.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size
from lagbench.errors import UsageError, WorkFailedError

from .constants import blamed_on_parameters, solver_constants, split_module
from .draws import generator
from .solver import Device, Health, Solver, build
from .split import ClosedBoxParameters, FreeSurfaceParameters, InitialState

# particle-substeps between two reports: about a tenth of a second on a core
STRIDE = 4_000_000

Report = Callable[[int], None]
"""Called with the substeps done since the last call, summed over scenarios."""


@dataclass(frozen=True, kw_only=True)
class SimulationJob:
    """What a worker simulates in one go; picklable."""

    size: Size  # tier of a split with its parameters
    scenarios: tuple[int, ...]  # ids that advance together; one on Device.CPU
    root: Path  # folder that holds all data sets
    device: Device = Device.CPU  # where the solver runs


def draw(size: Size, scenario: int) -> InitialState:
    """Return a scenario before its first substep; what cannot be drawn is a
    WorkFailedError.
    """
    rng = generator(size.split, size.name, size.major, scenario)
    module = split_module(size)
    try:
        with blamed_on_parameters(size, f"drawing scenario {scenario}"):
            state: object = module.initial_state(size, scenario, rng)
    except WorkFailedError as error:
        raise _placed(
            error, f"{size.split} {size.name}, scenario {scenario}"
        ) from error
    if not isinstance(state, InitialState):
        where = f"{size.generator}.initial_state"
        got = type(state).__name__
        raise UsageError(
            "a split drew no initial state",
            where=where,
            expected="an InitialState",
            got=got,
        )
    return state


def _placed(error: WorkFailedError, where: str) -> WorkFailedError:
    """Return an error that says where it happened."""
    return WorkFailedError(
        error.what, where=where, expected=error.expected, got=error.got, fix=error.fix
    )


def substeps_of(size: Size, scenario: int) -> int:
    """Return how many substeps a scenario takes, those before frame 0 included."""
    last = draw(size, scenario).start_frame + size.frame_count(scenario) - 1
    return last * size.substeps_per_frame


class Batch:
    """Scenarios in a solver, and the frames at which they are due."""

    def __init__(
        self, job: SimulationJob, report: Report, frames: Sequence[int] | None = None
    ) -> None:
        self.job = job  # what to simulate
        # the scenarios before their first substep
        self.states = [draw(job.size, scenario) for scenario in job.scenarios]
        # what each has gone through so far
        unseen = Health(
            finite=True, max_speed=0.0, jacobian_min=np.inf, jacobian_max=-np.inf
        )
        self.extremes = [unseen] * len(self.states)
        # in the order of the job
        self.solver = _solver(solver_constants(job.size), job.device, len(self.states))
        with self._naming():
            self.solver.load(self.states)
        self._report = report
        self._frames = frames or [
            job.size.frame_count(scenario) for scenario in job.scenarios
        ]
        self._stride = max(1, STRIDE // (job.size.particles * len(self.states)))
        self._now = 0
        self._displaced: list[tuple[int, NDArray[np.float32]]] = []

    def recordings(self) -> Iterator[tuple[int, int]]:
        """Yield (index in the batch, frame) whenever the solver stands at that
        frame.
        """
        interval = self.job.size.substeps_per_frame
        schedule = sorted(
            ((state.start_frame + frame) * interval, index, frame)
            for index, (state, count) in enumerate(
                zip(self.states, self._frames, strict=True)
            )
            for frame in range(count)
        )
        for substep, due in groupby(schedule, key=lambda entry: entry[0]):
            self._advance_to(substep)
            self._position = self.solver.position()
            self._velocity = self.solver.velocity()
            for _, index, frame in due:
                yield index, frame

    def frame(self, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return position [length] and velocity [length/s], shape [particle, 2], at the
        last recording.
        """
        return self._position[index], self._velocity[index]

    def displace(self, offset: NDArray[np.float32]) -> None:
        """Add an offset to the positions [length], shape [scenario, particle, 2]."""
        self.solver.displace(offset)
        self._displaced.append((self._now, offset.copy()))

    def _advance_to(self, substep: int) -> None:
        while self._now < substep:
            count = min(self._stride, substep - self._now)
            with self._naming():
                try:
                    self.solver.advance(count)
                except WorkFailedError:
                    self._replay(count)
                    raise
            self._now += count
            # Extremes are those of the scenarios that still record, and so is the work.
            interval = self.job.size.substeps_per_frame
            running = 0
            for index, health in enumerate(self.solver.health()):
                last = self.states[index].start_frame + self._frames[index] - 1
                if self._now <= last * interval:
                    running += 1
                    widest = self.extremes[index]
                    self.extremes[index] = Health(
                        finite=health.finite,
                        max_speed=max(widest.max_speed, health.max_speed),
                        jacobian_min=min(widest.jacobian_min, health.jacobian_min),
                        jacobian_max=max(widest.jacobian_max, health.jacobian_max),
                    )
            self._report(count * running)

    def _replay(self, count: int) -> None:
        """Repeat everything up to here, then single substeps, to learn which one breaks
        first.

        Returns when none of them breaks: then the failure was not the simulation's.
        """
        self.solver.load(self.states)
        done = 0
        for start, offset in [*self._displaced, (self._now, None)]:
            while done < start:
                step = min(self._stride, start - done)
                self.solver.advance(step)
                done += step
            if offset is not None:
                self.solver.displace(offset)
        for _ in range(count):
            self.solver.advance(1)

    @contextmanager
    def _naming(self) -> Iterator[None]:
        """Put a scenario's id into errors of the solver, which knows its index only."""
        ids = self.job.scenarios
        size = self.job.size
        try:
            yield
        except WorkFailedError as error:
            place = re.sub(
                r"scenario (\d+)",
                lambda found: f"scenario {ids[int(found[1])]}",
                error.where or "",
            )
            raise _placed(error, f"{size.split} {size.name}, {place}") from error


@functools.lru_cache(maxsize=1)
def _solver(
    parameters: ClosedBoxParameters | FreeSurfaceParameters,
    device: Device,
    scenarios: int,
) -> Solver:
    """Build a solver, or take the last one again: building compiles."""
    threads = 1 if device is Device.CPU else None
    return build(parameters, device=device, scenarios=scenarios, threads=threads)
