"""Simulate scenarios of a size, write each to its file, and perturb those of test.

Neither xarray nor pandas is imported, which keeps a worker below 400 MB.

The predictability limit: how far a scenario drifts from a perturbed run of itself. At
the last frame that a model is given, every coordinate of every particle moves by +2^-20
or -2^-20 (seeded signs; particles stay in the box), far below anything that a frame
shows. The position RMSE between the perturbed run and the truth at each predicted frame
is what no model can be expected to undercut::

    limit(f) = sqrt(mean over particles and axes of (x_perturbed(f) - x(f))^2)

It starts at 2^-20 = 9.5e-7, stays near it while the flow is regular, and grows where
trajectories diverge. A prediction that lies below it has seen the answer. Manifests
call it ``twin_floor``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.data.layout import scenario_path
from lagbench.data.registry import Size, Task
from lagbench.data.scenario import read_scenario
from lagbench.data.writer import ScenarioWriter

from .batch import (
    Report,
    ScenarioBatch,
    SimulationJob,
    file_parameters,
)
from .constants import solver_constants
from .draws import QUANTUM, entropy, seed_text
from .full_box_parameters import FullBoxParameters
from .solver import Health, Singles
from .soundness import SoundnessRecorder
from .split import (
    FreeSurfaceParameters,
    InitialState,
    SolverParameters,
)

if TYPE_CHECKING:
    from .free_surface import FreeSurface

STILL = 0.01  # share of its greatest kinetic energy from which on a free surface moves
OUTCOMES = ("active_frames",)
"""Parameters of a file that follow from its simulation; all others are known before it.
"""


@dataclass(frozen=True, kw_only=True)
class SimulatedScenario:
    """A scenario that was simulated and written."""

    scenario: int  # its id
    content_sha256: str  # content hash of its file


def _mass(size: Size, state: InitialState) -> float:
    """Return the mass of all particles."""
    return float(size.value("density")) * state.area


def scenario_writer(
    job: SimulationJob,
    scenario: int,
    state: InitialState,
    recorded: NDArray[np.int64] | None = None,
) -> ScenarioWriter:
    """Return the writer of a scenario's file, with all that is known before it runs.

    Args:
        job: the size, and where its files lie.
        scenario: id.
        state: the scenario before its first substep.
        recorded: the particles of the state that the file holds; all when None.
    """
    size = job.size
    if recorded is None:
        recorded = np.arange(len(state.position))
    key = size.key(scenario)
    frame_count = size.frame_count(scenario)

    first_frame = state.start_frame
    frames = range(first_frame, first_frame + frame_count)
    wall_velocity = None
    if _has_driving_walls(solver_constants(size)):
        # of each wall towards each recorded frame [length/s], shape [frame, wall, axis]
        wall_velocity = np.stack([state.walls_towards(frame) for frame in frames])

    body_force = None
    if state.body_force is not None:
        # of each layer towards each recorded frame [length/s^2]
        body_force = np.stack([state.force_towards(frame) for frame in frames])

    return ScenarioWriter(
        scenario_path(job.root, key),
        key,
        particles=len(recorded),
        frames=frame_count,
        frame_interval=size.frame_interval,
        material=state.material[recorded],
        particle_mass=_mass(size, state) / len(recorded),
        wall_velocity=wall_velocity,
        body_force=body_force,
        parameters=file_parameters(size, scenario, state),
        seed=seed_text(size.split, size.name, size.major, scenario, size.draw_seed),
        device=job.device.value,
        generator=size.generator,
        dimension=size.box.dimension,
        periodic=size.periodic,
        has_velocity=size.stores_velocity,
    )


def _has_driving_walls(parameters: SolverParameters) -> bool:
    """Tell whether a full box ends at walls along some axis."""
    if isinstance(parameters, FullBoxParameters):
        return not all(parameters.box.periodic)
    return False


def active_frames(energies: Sequence[float], task: Task) -> int:
    """Return how many frames of the horizon pass until a free surface lies still.

    Counted up to and including the last at which the kinetic energy is at least 1 % of
    its greatest value from frame 0 to the end of the horizon.
    """
    span = energies[: task.input_frames + task.horizon]
    threshold = STILL * max(span)
    last = 0
    for frame, energy in enumerate(span):
        if energy >= threshold:
            last = frame
    return max(0, last + 1 - task.input_frames)


def simulate(job: SimulationJob, report: Report) -> list[SimulatedScenario]:
    """Simulate the scenarios of a job and write their files, all or none of them."""
    size = job.size
    batch = ScenarioBatch(job, report)
    # of each particle of the run
    masses = [_mass(size, state) / len(state.position) for state in batch.states]
    # kinetic energies by scenario, frame by frame
    energies: list[list[float]] = [[] for _ in masses]
    with ExitStack() as stack:
        writers = []
        for scenario, state, recorded in zip(
            job.scenarios, batch.states, batch.recorded, strict=True
        ):
            writer = scenario_writer(job, scenario, state, recorded)
            writers.append(stack.enter_context(writer))

        recorders = _soundness_recorders(batch)
        for index, _ in batch.recordings():
            position, velocity = batch.frame(index)
            recorded = batch.recorded[index]
            stored_velocity = velocity[recorded] if size.stores_velocity else None
            writers[index].append(position[recorded], stored_velocity)
            energy = _kinetic_energy(velocity, masses[index])
            energies[index].append(energy)
            if recorders:
                volume_ratio = batch.volume_ratio(index)
                recorders[index].add(velocity, volume_ratio)

        for index, writer in enumerate(writers):
            facts = _facts_of(
                size,
                batch.states[index],
                energies=energies[index],
                extremes=batch.extremes[index],
            )
            if recorders:
                writer.state(active_frames=active_frames(energies[index], size.task))
                solver = cast("FreeSurface", batch.solver)
                least, greatest = solver.volume_ratio_extremes()
                soundness = recorders[index].summary(least[index], greatest[index])
                facts |= asdict(soundness)
            writer.state_facts(facts)
    return [
        SimulatedScenario(scenario=scenario, content_sha256=writer.content_sha256)
        for scenario, writer in zip(job.scenarios, writers, strict=True)
    ]


def _soundness_recorders(batch: ScenarioBatch) -> list[SoundnessRecorder]:
    """Return a recorder for each scenario of a free surface, none for a full box."""
    parameters = batch.solver.parameters
    if not isinstance(parameters, FreeSurfaceParameters):
        return []
    recorders = []
    for state in batch.states:
        recorders.append(SoundnessRecorder(parameters, state.material))
    return recorders


def _kinetic_energy(velocity: Singles, mass: float) -> float:
    """Return sum of m v^2 / 2 over particles of one mass [mass length^2/s^2]."""
    components = velocity.astype(np.float64).ravel()
    squares = components * components
    # An exact sum: which frames are active enters the content hash.
    return 0.5 * mass * math.fsum(squares.tolist())


def _facts_of(
    size: Size, state: InitialState, *, energies: Sequence[float], extremes: Health
) -> dict[str, int | float]:
    """Return what a scenario went through; its file and the manifest state it."""
    largest = max(energies)
    last_over_max = 0.0  # small where the motion has died down
    if largest > 0.0:
        last_over_max = energies[-1] / largest
    return {
        "start_frame": state.start_frame,  # frames simulated before frame 0
        # sums of m v^2 / 2: at frame 0, at the last frame, the largest and the mean
        "kinetic_energy_first": energies[0],
        "kinetic_energy_last": energies[-1],
        "kinetic_energy_max": largest,
        "kinetic_energy_mean": math.fsum(energies) / len(energies),
        "energy_last_over_max": last_over_max,
        # largest velocity component at any substep [length/s]
        "max_speed": extremes.max_speed,
        # cells that this speed crosses per substep [1], the same at any refinement
        "cfl": extremes.max_speed * size.dt * size.grid,
        # extremes of J of any particle at any substep [1]
        "jacobian_min": extremes.jacobian_min,
        "jacobian_max": extremes.jacobian_max,
    }


def draw_perturbation(size: Size, scenario: int, particles: int) -> Singles:
    """Return the displacement of a perturbed run [length], shape [particle, axis]."""
    # a random stream of its own: the scenario's seed and a 1
    scenario_words = entropy(
        size.split, size.name, size.major, scenario, size.draw_seed
    )
    words = (*scenario_words, 1)
    seed = np.random.SeedSequence(words)
    rng = np.random.Generator(np.random.PCG64(seed))
    shape = (particles, size.box.dimension)
    draws = rng.random(shape)
    return (QUANTUM * np.where(draws < 0.5, -1.0, 1.0)).astype(np.float32)


def measure_predictability(
    job: SimulationJob, report: Report
) -> dict[int, tuple[float, ...]]:
    """Simulate scenarios again, perturbed, and compare them with their files.

    Returns:
        The predictability limit of each scenario: the RMSE of each predicted frame
        [length].
    """
    size = job.size
    input_frames = size.task.input_frames
    frame_counts = []
    for scenario in job.scenarios:
        frames_left_out = size.frames_after_horizon(scenario)
        frame_count = size.frame_count(scenario) - frames_left_out
        frame_counts.append(frame_count)
    batch = ScenarioBatch(job, report, frames=frame_counts)
    # displacements of the batch [length], shape [scenario, particle, axis]
    positions = [state.position for state in batch.states]
    offsets = np.zeros(np.shape(positions), dtype=np.float32)
    limits: list[list[float]] = [[] for _ in frame_counts]
    with ExitStack() as stack:
        truths = []
        for scenario in job.scenarios:
            file = read_scenario(size.path(job.root, scenario))
            truths.append(stack.enter_context(file))

        for index, frame in batch.recordings():
            if frame == input_frames - 1:
                offsets[:] = 0.0
                scenario = job.scenarios[index]
                offsets[index] = draw_perturbation(size, scenario, len(offsets[index]))
                batch.solver.displace(offsets)
            elif frame >= input_frames:
                position, _ = batch.frame(index)
                recorded_position = position[batch.recorded[index]]
                truth = truths[index].read("position", frame)
                error = _root_mean_square_error(recorded_position, truth, size.box)
                limits[index].append(error)
    return {
        scenario: tuple(limit)
        for scenario, limit in zip(job.scenarios, limits, strict=True)
    }


def _root_mean_square_error(position: Singles, truth: Singles, box: Box) -> float:
    exact_truth = truth.astype(np.float64)
    exact_position = position.astype(np.float64)
    error = box.displacement(exact_truth, exact_position)
    return math.sqrt(math.fsum((error * error).ravel().tolist()) / error.size)
