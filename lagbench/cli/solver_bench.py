"""The time that our solver takes, which a surrogate has to beat on the same machine."""

from __future__ import annotations

import time
from dataclasses import dataclass

from lagbench.data.registry import load
from lagbench.errors import LagbenchError
from lagbench.generators.batch import draw_initial_state
from lagbench.generators.constants import solver_constants
from lagbench.generators.solver import build
from lagbench.work.engine import find_engine
from lagbench.work.executor import Report, WorkItem, run_items

from .output import print_warning

WARM_UP_FRAMES = 2  # before the clock starts: kernels compile when they first run
LEAST_SECONDS = 0.5  # shortest processor time over which the mean is taken [s]


@dataclass(frozen=True, kw_only=True)
class SolverBench:
    """The cost of a frame for the solver, which simulates one scenario on one core."""

    split: str  # name of the split
    size: str  # name of the size
    particles: int  # particles of the scenario
    substeps: int  # solver steps of a frame
    frames: int  # frames that were timed
    # mean processor time of a frame [s], so that other work on the machine does not
    # count; writing it to disk is not part of it
    seconds_per_frame: float


def bench_solver(split: str, size: str, *, frames: int = 20) -> SolverBench:
    """Simulate the first test scenario and time its frames.

    The engine starts once per process: call this from a process of its own, as
    :func:`time_solver` does.

    Args:
        split: name of a split.
        size: name of a size.
        frames: least number of frames to time; more if they take under half a second.
    """
    tier = load().size(split, size)
    find_engine()
    solver = build(solver_constants(tier))
    first_scenario = tier.subsets["test"][0]
    solver.load([draw_initial_state(tier, first_scenario)])
    solver.advance(WARM_UP_FRAMES * tier.substeps_per_frame)

    start = time.process_time()
    seconds = 0.0
    frame_count = 0
    while frame_count < frames or seconds < LEAST_SECONDS:
        solver.advance(tier.substeps_per_frame)
        solver.position()
        frame_count += 1
        seconds = time.process_time() - start
    return SolverBench(
        split=split,
        size=size,
        particles=tier.particles,
        substeps=tier.substeps_per_frame,
        frames=frame_count,
        seconds_per_frame=seconds / frame_count,
    )


def time_solver(split: str, size: str) -> float | None:
    """Return the time of a frame [s]; None, with a warning, where it cannot run.

    It runs in a process of its own, where the memory and the threads of this process do
    not disturb it. Local splits have no solver, which is no reason for a warning.
    """
    if split not in load().splits:
        return None
    item = WorkItem(
        name=f"bench of {split} {size}", function=_bench, argument=(split, size)
    )
    try:
        find_engine()
        (finished,) = run_items([item])
    except LagbenchError as error:
        print_warning(f"our solver is not timed: {error}")
        return None
    bench: SolverBench = finished.value
    return bench.seconds_per_frame


def _bench(place: tuple[str, str], _: Report) -> SolverBench:
    return bench_solver(*place)
