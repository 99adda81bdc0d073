"""Simulate scenarios of a size and write each to its file.

Neither xarray nor pandas is imported, which keeps a worker below 400 MB.

The twin floor: how far a scenario drifts from a copy of itself that was nudged.

At the last frame that a model is given, every coordinate of every particle moves by
+2^-20 or -2^-20 (seeded signs), far below anything that a frame shows. The position
RMSE between this twin and the truth at each predicted frame is what no model can be
expected to undercut::

    floor(f) = sqrt(mean over particles and axes of (x_twin(f) - x(f))^2)

It starts at 2^-20 = 9.5e-7, stays near it while the flow is regular, and grows where
trajectories diverge. A prediction that lies below it has seen the answer.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.data.layout import scenario_path
from lagbench.data.registry import Size, Task
from lagbench.data.scenario import read_scenario
from lagbench.data.writer import ScenarioWriter

from .batch import Batch, Report, SimulationJob, substeps_of
from .constants import split_module
from .draws import QUANTUM, entropy, seed_text
from .split import ClosedBoxParameters, FreeSurfaceParameters, InitialState

STILL = 0.01  # share of its greatest kinetic energy from which on a free surface moves
OUTCOMES = ("active_frames",)
"""Parameters of a file that follow from its simulation; all others are known before it.
"""

# frames on the way to which kernels are compiled: one is read out, then one is advanced
# to
COMPILING = 2
# drawn parameters that files call by their CF-like long name
_FILE_NAMES = {"reynolds": "reynolds_number"}


@dataclass(frozen=True, kw_only=True)
class Facts:
    """What one simulated scenario went through; its file and the manifest state it."""

    start_frame: int  # frames simulated before frame 0
    kinetic_energy_first: float  # sum of m v^2 / 2 at frame 0
    kinetic_energy_last: float  # the same at the last frame
    kinetic_energy_max: float  # the largest of any frame
    kinetic_energy_mean: float  # the mean over frames
    # last over largest; small where the motion has died down
    energy_last_over_max: float
    max_speed: float  # largest velocity component at any substep [length/s]
    cfl: float  # cells that this speed crosses per substep [1]
    jacobian_min: float  # smallest J of any particle at any substep [1]
    jacobian_max: float  # largest J of any particle at any substep [1]


@dataclass(frozen=True, kw_only=True)
class Pace:
    """How long a scenario took for how much, once everything was compiled."""

    seconds: float  # processor time [s]
    particle_substeps: int  # substeps times particles
    frames: int  # frames that were advanced to, read out and written


@dataclass(frozen=True, kw_only=True)
class Simulated:
    """A scenario that was simulated and written."""

    scenario: int  # its id
    content_sha256: str  # content hash of its file
    pace: Pace | None = None  # of a scenario that was simulated alone


def _particle_mass(size: Size, state: InitialState) -> float:
    return float(size.value("density")) * state.area / size.particles


def file_parameters(size: Size, state: InitialState) -> dict[str, object]:
    """Return what a scenario's file states and hashes: constants, then what was
    drawn.
    """
    constants = {name: parameter.value for name, parameter in size.parameters.items()}
    drawn = {
        _FILE_NAMES.get(name, name): value for name, value in state.parameters.items()
    }
    return {**constants, **drawn, "start_frame": state.start_frame}


def scenario_writer(
    job: SimulationJob, scenario: int, state: InitialState
) -> ScenarioWriter:
    """Return the writer of a scenario's file, with all that is known before it runs."""
    size = job.size
    walls = None
    key = size.key(scenario)
    if isinstance(split_module(size).solver_parameters(size), ClosedBoxParameters):
        # of each wall towards each recorded frame [length/s], shape [frame, 4, 2]
        frames = range(
            state.start_frame, state.start_frame + size.frame_count(scenario)
        )
        walls = np.stack([state.walls_towards(frame) for frame in frames])
    return ScenarioWriter(
        scenario_path(job.root, key),
        key,
        particles=size.particles,
        frames=size.frame_count(scenario),
        frame_interval=size.frame_interval,
        material=state.material,
        particle_mass=_particle_mass(size, state),
        wall_velocity=walls,
        parameters=file_parameters(size, state),
        seed=seed_text(size.split, size.name, size.major, scenario),
        device=job.device.value,
        generator=size.generator,
    )


def active_frames(energies: Sequence[float], task: Task) -> int:
    """Return how many frames of the horizon pass until a free surface lies still.

    Counted up to and including the last at which the kinetic energy is at least 1 % of
    its greatest value from frame 0 to the end of the horizon.
    """
    span = energies[: task.input_frames + task.horizon]
    last = max(
        frame for frame, energy in enumerate(span) if energy >= STILL * max(span)
    )
    return max(0, last + 1 - task.input_frames)


def simulate(
    job: SimulationJob,
    report: Report,
    *,
    clock: Callable[[], float] = time.process_time,
) -> list[Simulated]:
    """Simulate the scenarios of a job and write their files, all or none of them.

    Kernels compile on the way to the first two frames, so time is taken from there on.
    """
    batch = Batch(job, report)
    size = job.size
    masses = [_particle_mass(size, state) for state in batch.states]
    # energies by scenario, frame by frame
    kinetic: list[list[float]] = [[] for _ in masses]
    begun = clock()
    with ExitStack() as stack:
        pairs = zip(job.scenarios, batch.states, strict=True)
        writers = [
            stack.enter_context(scenario_writer(job, scenario, state))
            for scenario, state in pairs
        ]
        for index, frame in batch.recordings():
            position, velocity = batch.frame(index)
            writers[index].append(position, velocity)
            speed = velocity.astype(np.float64).ravel()
            # An exact sum: which frames are active enters the content hash.
            kinetic[index].append(
                0.5 * masses[index] * math.fsum((speed * speed).tolist())
            )
            if frame == COMPILING - 1:
                begun = clock()
        for writer, energies, state, seen in zip(
            writers, kinetic, batch.states, batch.extremes, strict=True
        ):
            if isinstance(batch.solver.parameters, FreeSurfaceParameters):
                writer.state(active_frames=active_frames(energies, size.task))
            largest = max(energies)
            facts = Facts(
                start_frame=state.start_frame,
                kinetic_energy_first=energies[0],
                kinetic_energy_last=energies[-1],
                kinetic_energy_max=largest,
                kinetic_energy_mean=math.fsum(energies) / len(energies),
                energy_last_over_max=energies[-1] / largest if largest > 0.0 else 0.0,
                max_speed=seen.max_speed,
                cfl=seen.max_speed * size.dt * size.grid,
                jacobian_min=seen.jacobian_min,
                jacobian_max=seen.jacobian_max,
            )
            writer.state_facts(asdict(facts))
    timed = size.frame_count(job.scenarios[0]) - COMPILING
    pace = Pace(
        seconds=clock() - begun,
        particle_substeps=timed * size.substeps_per_frame * size.particles,
        frames=timed,
    )
    return [
        Simulated(
            scenario=scenario,
            content_sha256=writer.content_sha256,
            pace=pace if timed > 0 and len(job.scenarios) == 1 else None,
        )
        for scenario, writer in zip(job.scenarios, writers, strict=True)
    ]


def nudge(size: Size, scenario: int) -> NDArray[np.float32]:
    """Return the displacement of a scenario's twin [length], shape [particle, 2]."""
    # a random stream of its own: the scenario's seed and a 1
    seed = (*entropy(size.split, size.name, size.major, scenario), 1)
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    signs = np.where(rng.random((size.particles, 2)) < 0.5, -1.0, 1.0)
    return (QUANTUM * signs).astype(np.float32)


def twin_substeps(size: Size, scenario: int) -> int:
    """Return how many substeps a scenario's twin takes."""
    return (
        substeps_of(size, scenario)
        - size.frames_behind(scenario) * size.substeps_per_frame
    )


def twin_floors(job: SimulationJob, report: Report) -> dict[int, tuple[float, ...]]:
    """Simulate twins of scenarios beside their files; return the RMSE of each predicted
    frame [length].
    """
    size = job.size
    counts = [size.frame_count(i) - size.frames_behind(i) for i in job.scenarios]
    batch = Batch(job, report, frames=counts)
    offsets = np.zeros((len(counts), size.particles, 2), dtype=np.float32)
    floors: list[list[float]] = [[] for _ in counts]
    with ExitStack() as stack:
        paths = [size.path(job.root, scenario) for scenario in job.scenarios]
        truths = [stack.enter_context(read_scenario(path)) for path in paths]
        for index, frame in batch.recordings():
            if frame == size.task.input_frames - 1:
                offsets[:] = 0.0
                offsets[index] = nudge(size, job.scenarios[index])
                batch.displace(offsets)
            elif frame >= size.task.input_frames:
                truth = truths[index].read("position", slice(frame, frame + 1))[0]
                error = batch.frame(index)[0].astype(np.float64) - truth.astype(
                    np.float64
                )
                floors[index].append(
                    math.sqrt(math.fsum((error * error).ravel().tolist()) / error.size)
                )
    return {
        scenario: tuple(floor)
        for scenario, floor in zip(job.scenarios, floors, strict=True)
    }
