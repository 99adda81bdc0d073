"""Time our solver: what a surrogate has to beat on the same machine."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from dataclasses import dataclass

from .errors import WorkFailedError
from .extras import check_installed
from .registry import load

__all__ = ["SolverBench", "bench_apart", "bench_solver"]

WARM_UP = 2
"""Frames before the clock starts: kernels compile when they first run."""

FRAMES = 20

LEAST = 0.5
"""Shortest time over which the mean is taken [s]."""


@dataclass(frozen=True, kw_only=True)
class SolverBench:
    """What a frame costs the solver, one scenario on one core.

    Attributes:
        split: name of the split.
        size: name of the size.
        particles: particles of the scenario.
        substeps: solver steps of a frame.
        frames: frames that were timed.
        seconds_per_frame: mean processor time of a frame [s], so that other work on the machine
            does not count; writing it to disk is not part of it.
    """

    split: str
    size: str
    particles: int
    substeps: int
    frames: int
    seconds_per_frame: float


def bench_solver(split: str, size: str = "full", *, frames: int = FRAMES) -> SolverBench:
    """Simulate the first test scenario for some frames and time them.

    Taichi starts once per process: call this from one of its own, as :func:`bench_apart` does.

    Args:
        split: name of the split.
        size: name of the size.
        frames: frames to time at least; as many as half a second takes if that is more.

    Raises:
        UsageError: unknown split or size, or Taichi is not installed.
    """
    tier = load().size(split, size)
    check_installed("taichi", extra="generate")
    from .generators.batch import draw, solver_constants
    from .generators.solver import build

    with_state = draw(tier, tier.subsets["test"][0])
    solver = build(solver_constants(tier))
    solver.load([with_state])
    solver.advance(WARM_UP * tier.substeps_per_frame)
    started, timed = time.process_time(), 0
    while timed < frames or time.process_time() - started < LEAST:
        solver.advance(tier.substeps_per_frame)
        solver.position()
        timed += 1
    seconds = (time.process_time() - started) / timed
    return SolverBench(
        split=split,
        size=size,
        particles=tier.particles,
        substeps=tier.substeps_per_frame,
        frames=timed,
        seconds_per_frame=seconds,
    )


def bench_apart(split: str, size: str = "full", *, frames: int = FRAMES) -> SolverBench:
    """Time the solver in a process of its own, which this one's memory and threads do not disturb.

    Raises:
        UsageError: unknown split or size, or Taichi is not installed.
        WorkFailedError: the process failed.
    """
    load().size(split, size)
    check_installed("taichi", extra="generate")
    options = ["--split", split, "--size", size, "--frames", str(frames), "--json"]
    command = [sys.executable, "-m", "lagbench", "bench", "solver", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise WorkFailedError("the solver could not be timed", got=done.stderr.strip()[-300:])
    return SolverBench(**json.loads(done.stdout))
