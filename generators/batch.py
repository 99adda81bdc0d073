"""Draw scenarios of one size, and advance them together from frame to frame.

Every scenario records from a frame of its own on. A batch therefore advances to the
next frame that is due, whichever scenario it belongs to. On ``Device.CPU`` a batch is
one scenario.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from lagbench.data.registry import Size
from lagbench.errors import (
    UsageError,
    WorkFailedError,
    find_place_in_extension,
)

from .constants import blamed_on_parameters, place_of, solver_constants, split_module
from .draws import generator
from .refinement import recorded_particles, refined
from .solver import Health, Singles, Solver, build
from .split import Device, FreeSurfaceParameters, InitialState, SolverParameters

if TYPE_CHECKING:
    from .free_surface import FreeSurface

# particle-substeps between two reports: about a tenth of a second on a core
STRIDE = 4_000_000

# drawn parameters that files call by their CF-like long name
_FILE_NAMES = {"reynolds": "reynolds_number"}

Report = Callable[[int], None]
"""Called with the substeps done since the last call, summed over scenarios."""


@dataclass(frozen=True, kw_only=True)
class SimulationJob:
    """What a worker simulates in one go; picklable."""

    size: Size  # tier of a split with its parameters
    scenarios: tuple[int, ...]  # ids that advance together; one on Device.CPU
    root: Path  # folder that holds all data sets
    device: Device = Device.CPU  # where the solver runs


def start_frame(size: Size, scenario: int) -> int:
    """Return how many frames a scenario is simulated before frame 0 is recorded.

    The split says it from the head of the scenario's random stream, without a draw of
    the whole scenario. A split without a function ``start_frame`` records at once.

    Raises:
        UsageError: the split says a negative number.
    """
    state_start_frame = getattr(split_module(size), "start_frame", None)
    if state_start_frame is None:
        return 0

    rng = generator(size.split, size.name, size.major, scenario, size.draw_seed)
    with blamed_on_parameters(size, f"drawing the first frame of scenario {scenario}"):
        first_frame = int(state_start_frame(size, scenario, rng))
    if first_frame < 0:
        raise UsageError(
            f"a split starts a scenario before its first substep: got {first_frame}, "
            "expected 0 or more frames before frame 0; let start_frame return how "
            "many frames are simulated before frame 0",
            where=f"{size.generator}.start_frame, scenario {scenario}",
        )
    return first_frame


def substep_count(size: Size, scenario: int) -> int:
    """Return how many substeps a scenario takes, those before frame 0 included."""
    last_frame = start_frame(size, scenario) + size.frame_count(scenario) - 1
    return last_frame * size.substeps_per_frame * size.refinement


def perturbed_substep_count(size: Size, scenario: int) -> int:
    """Return how many substeps a perturbed run takes: it ends with the horizon."""
    omitted = size.frames_after_horizon(scenario) * size.substeps_per_frame
    return substep_count(size, scenario) - omitted * size.refinement


def draw_initial_state(size: Size, scenario: int) -> InitialState:
    """Draw a scenario before its first substep.

    Raises:
        WorkFailedError: a value cannot be drawn.
        UsageError: the split returns something else than an initial state, or one that
            starts at another frame than the split said or hides a constant.
    """
    rng = generator(size.split, size.name, size.major, scenario, size.draw_seed)
    module = split_module(size)
    with blamed_on_parameters(size, f"drawing scenario {scenario}"):
        try:
            state: object = module.initial_state(size, scenario, rng)
        except WorkFailedError as error:
            line = find_place_in_extension(error, size.generator)
            if line is None:
                place = f"{place_of(size)}, scenario {scenario}"
                raise WorkFailedError(error.text, where=place) from error
            raise WorkFailedError(
                f"{error.text}; mend this line of the module, or the parameters that "
                f"it uses: {place_of(size)}",
                where=f"{size.split} {size.name}, scenario {scenario}, {line}",
            ) from error

    # From here on the author of the split is at fault, not the parameters.
    where = f"{size.generator}.initial_state"
    if not isinstance(state, InitialState):
        raise UsageError(
            f"a split drew no initial state: got {type(state).__name__}, expected an "
            "InitialState; return an InitialState: docs/extending.md",
            where=where,
        )
    stated_start = start_frame(size, scenario)
    if state.start_frame != stated_start:
        raise UsageError(
            "a split starts a scenario at another frame than it said: got "
            f"{state.start_frame}, expected start_frame {stated_start}; let the split "
            "have a function start_frame(size, scenario, rng) that returns the "
            "start_frame of its initial state",
            where=f"{where}, scenario {scenario}",
        )
    return state


def file_parameters(
    size: Size, scenario: int, state: InitialState
) -> dict[str, object]:
    """Return what a scenario's file states and hashes: constants, then what was
    drawn.

    Constants of one subset stand in its files only.
    """
    subset = size.subset_of(scenario)
    parameters: dict[str, object] = {}
    for name, parameter in size.parameters.items():
        if parameter.subset in (None, subset):
            parameters[name] = parameter.value
    for name, value in state.parameters.items():
        parameters[_FILE_NAMES.get(name, name)] = value
    parameters["start_frame"] = state.start_frame
    if size.refinement > 1:
        parameters["refinement"] = size.refinement
    return parameters


class ScenarioBatch:
    """Scenarios in a solver, and the frames at which they are due."""

    def __init__(
        self, job: SimulationJob, report: Report, frames: Sequence[int] | None = None
    ) -> None:
        size = refined(job.size)
        scenario_count = len(job.scenarios)
        self.job = job  # what to simulate
        self.size = size  # on which the solver runs
        # the scenarios before their first substep, in the order of the job
        self.states = [draw_initial_state(size, scenario) for scenario in job.scenarios]
        # which particles of each scenario its file holds
        self.recorded = []
        for scenario, state in zip(job.scenarios, self.states, strict=True):
            particles = np.arange(job.size.particles)
            if size.subdivision > 1:
                coarse = draw_initial_state(job.size, scenario)
                particles = recorded_particles(coarse, state)
            self.recorded.append(particles)
        self.solver = _solver(solver_constants(size), job.device, scenario_count)
        self._is_free_surface = isinstance(
            self.solver.parameters, FreeSurfaceParameters
        )
        self.solver.names = [
            f"{size.split} {size.name}, scenario {scenario}"
            for scenario in job.scenarios
        ]
        self.solver.load(self.states)
        # extremes that each scenario has gone through so far
        self.extremes = self.solver.health()

        self._report = report
        # recorded frames of each scenario
        self._frames = frames or [size.frame_count(i) for i in job.scenarios]
        # substeps between two reports
        self._stride = max(1, STRIDE // (size.particles * scenario_count))
        self._substep = 0  # substeps done so far

    def recordings(self) -> Iterator[tuple[int, int]]:
        """Yield (index in the batch, frame) whenever the solver stands at that
        frame.
        """
        interval = self.size.substeps_per_frame
        schedule: list[tuple[int, int, int]] = []
        for index, state in enumerate(self.states):
            frame_count = self._frames[index]
            for frame in range(frame_count):
                substep = (state.start_frame + frame) * interval
                schedule.append((substep, index, frame))
        schedule.sort()

        for substep, due in groupby(schedule, key=lambda entry: entry[0]):
            self._advance_to(substep)
            self._position = self.solver.position()
            self._velocity = self.solver.velocity()
            if self._is_free_surface:
                self._volume_ratio = cast("FreeSurface", self.solver).volume_ratio()
            for _, index, frame in due:
                yield index, frame

    def frame(self, index: int) -> tuple[Singles, Singles]:
        """Return position [length] and velocity [length/s] of all particles of the run,
        shape [particle, axis], at the last recording.
        """
        return self._position[index], self._velocity[index]

    def volume_ratio(self, index: int) -> Singles:
        """Return J of liquid and Jp of snow at the last recording [1], shape
        [particle]; free surfaces only.
        """
        ratio: Singles = self._volume_ratio[index]
        return ratio

    def _advance_to(self, substep: int) -> None:
        """Advance to a substep."""
        while self._substep < substep:
            count = min(self._stride, substep - self._substep)
            self.solver.advance(count)
            self._substep += count
            running_count = self._update_extremes()
            self._report(count * running_count)

    def _update_extremes(self) -> int:
        """Widen the extremes of the scenarios that still record; return how many do."""
        interval = self.size.substeps_per_frame
        running_count = 0
        for index, health in enumerate(self.solver.health()):
            last_frame = self.states[index].start_frame + self._frames[index] - 1
            if self._substep > last_frame * interval:
                continue

            running_count += 1
            widest = self.extremes[index]
            self.extremes[index] = Health(
                finite=health.finite,
                max_speed=max(widest.max_speed, health.max_speed),
                jacobian_min=min(widest.jacobian_min, health.jacobian_min),
                jacobian_max=max(widest.jacobian_max, health.jacobian_max),
            )
        return running_count


@functools.lru_cache(maxsize=1)
def _solver(
    parameters: SolverParameters,
    device: Device,
    scenarios: int,
) -> Solver:
    """Build a solver, or take the last one again: building compiles."""
    if device is Device.CPU:
        threads = 1
    else:
        threads = None
    return build(parameters, device=device, scenarios=scenarios, threads=threads)
