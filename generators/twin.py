"""The twin floor: how far a scenario drifts from a copy of itself that was nudged.

At the last frame that a model is given, every coordinate of every particle moves by +2^-20 or
-2^-20 (seeded signs), far below anything that a frame shows. The position RMSE between this
twin and the truth at each predicted frame is what no model can be expected to undercut::

    floor(f) = sqrt(mean over particles and axes of (x_twin(f) - x(f))^2)

It starts at 2^-20 = 9.5e-7, stays near it while the flow is regular, and grows where
trajectories diverge. A prediction that lies below it has seen the answer.
"""

from __future__ import annotations

import math
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from lagbench.format import ScenarioFile, read_scenario, scenario_path
from lagbench.registry import Size

from .batch import Batch, Job, Report, substeps_of
from .draws import QUANTUM, entropy
from .simulate import scenario_key

__all__ = ["nudge", "twin_floors", "twin_substeps"]

_STREAM = 1
"""Appended to a scenario's seed: the nudge has a random stream of its own."""


def nudge(size: Size, scenario: int) -> NDArray[np.float32]:
    """Return the displacement of a scenario's twin [length], shape [particle, 2]."""
    seed = (*entropy(size.split, size.name, size.major, scenario), _STREAM)
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    signs = np.where(rng.random((size.particles, 2)) < 0.5, -1.0, 1.0)
    return (QUANTUM * signs).astype(np.float32)


def twin_substeps(size: Size, scenario: int) -> int:
    """Return how many substeps a scenario's twin takes."""
    unused = size.frame_count(scenario) - _last_frame(size, scenario) - 1
    return substeps_of(size, scenario) - unused * size.substeps_per_frame


def _last_frame(size: Size, scenario: int) -> int:
    last = size.task.input_frames + size.task.horizon - 1
    return min(last, size.frame_count(scenario) - 1)


def twin_floors(job: Job, report: Report) -> dict[int, tuple[float, ...]]:
    """Simulate the twins of a job's scenarios beside their files.

    Args:
        job: scenarios whose files exist.
        report: told the substeps done.

    Returns:
        For each scenario the RMSE per predicted frame [length].

    Raises:
        DataError: a scenario's file is missing or damaged.
        WorkFailedError: a twin blew up.
    """
    size = job.size
    counts = [_last_frame(size, scenario) + 1 for scenario in job.scenarios]
    batch = Batch(job, report, frames=counts)
    offsets = np.zeros((len(counts), size.particles, 2), dtype=np.float32)
    floors: list[list[float]] = [[] for _ in counts]
    with ExitStack() as stack:
        truths = [stack.enter_context(_open_truth(job, scenario)) for scenario in job.scenarios]
        for index, frame in batch.recordings():
            if frame == size.task.input_frames - 1:
                offsets[:] = 0.0
                offsets[index] = nudge(size, job.scenarios[index])
                batch.displace(offsets)
            elif frame >= size.task.input_frames:
                truth = truths[index].read("position", slice(frame, frame + 1))[0]
                floors[index].append(_rmse(batch.frame(index)[0], truth))
    return {scenario: tuple(floor) for scenario, floor in zip(job.scenarios, floors, strict=True)}


def _open_truth(job: Job, scenario: int) -> ScenarioFile:
    return read_scenario(scenario_path(job.root, scenario_key(job.size, scenario)))


def _rmse(twin: NDArray[np.float32], truth: NDArray[np.float32]) -> float:
    error = twin.astype(np.float64) - truth.astype(np.float64)
    return math.sqrt(math.fsum((error * error).ravel().tolist()) / error.size)
