"""How long a scenario of three dimensions takes to be scored, and in what memory.

    OMP_NUM_THREADS=1 python benchmarks/score_solid.py

A periodic cube holds 25^3 = 15,625 particles that an ABC flow carries over 96 frames;
the prediction is the truth with noise. All metrics but Sinkhorn are measured, and the
preview is taken. Target: 1.5 s of one core and 400 MB.
"""

from __future__ import annotations

import math
import resource
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import lagbench
from lagbench.data.local import locate
from lagbench.exchange import adopt
from lagbench.metrics.table import select
from lagbench.scoring.score import ScenarioJob, score_scenario
from lagbench.scoring.task import load_scored_task
from lagbench.submission.predictions import open_predictions

SIDE = 25
FRAMES = 96
GIVEN = 6
NOISE = 0.005  # [length]
REPEATS = 3

Floats = NDArray[np.float64]


def flow(position: Floats, seed: int) -> Floats:
    """Return the ABC flow with coefficients of a seed [length/frame]."""
    rng = np.random.default_rng(seed)
    a, b, c = rng.uniform(0.005, 0.015, 3)
    phase = 2.0 * math.pi * position
    x, y, z = phase.T
    u = a * np.sin(z) + c * np.cos(y)
    v = b * np.sin(x) + a * np.cos(z)
    w = c * np.sin(y) + b * np.cos(x)
    return np.stack([u, v, w], axis=1)


def carried(seed: int) -> NDArray[np.float32]:
    """Return the paths of a lattice, by the midpoint rule."""
    axis = (np.arange(SIDE) + 0.5) / SIDE
    coordinates = np.meshgrid(axis, axis, axis)
    lattice = np.stack(coordinates, axis=-1)
    position = lattice.reshape(-1, 3)
    frames = []
    for _ in range(FRAMES):
        wrapped = position % 1.0
        stored = wrapped.astype(np.float32)
        # Rounding may reach the upper end, which is the lower one.
        frames.append(stored % np.float32(1.0))
        middle = position + 0.5 * flow(position, seed)
        position = position + flow(middle, seed)
    return np.stack(frames)


def main() -> None:
    """Make the data, score a scenario, print its time and the memory."""
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        paths = []
        for seed in range(3):
            path = root / f"run{seed}.npy"
            np.save(path, carried(seed))
            paths.append(path)
        adopt(
            paths,
            output=root / "abc",
            valid=1,
            test=1,
            radius=1.6 / SIDE,
            frame_interval=0.1,
            bounds=((0.0, 1.0),) * 3,
            periodic=("x", "y", "z"),
            input_frames=GIVEN,
            full_box=True,
        )
        frames = carried(2)
        truth = frames[GIVEN:]
        rng = np.random.default_rng(0)
        noise = rng.normal(0.0, NOISE, truth.shape)
        prediction = truth + noise
        path = root / "predictions.nc"
        lagbench.submission.write(
            path,
            {2: prediction.astype(np.float32)},
            split=root / "abc",
            method="m",
        )

        size = locate(root / "abc").size
        task = load_scored_task(size, root)
        with open_predictions(path) as opened:
            info = opened.info
        metric_names = [metric.name for metric in select(())]
        job = ScenarioJob(
            task=task,
            scenario=2,
            predictions=path,
            info=info,
            metrics=tuple(metric_names),
            has_preview=True,
        )
        seconds = []
        for _ in range(REPEATS):
            started = time.process_time()
            score_scenario(job, lambda _: None)
            seconds.append(time.process_time() - started)
    usage = resource.getrusage(resource.RUSAGE_SELF)
    peak = usage.ru_maxrss / 1024.0  # [MB]
    print(
        f"{SIDE**3} particles, {FRAMES - GIVEN} frames: {min(seconds):.2f} s of one "
        f"core, {peak:.0f} MB with the making of the data"
    )


if __name__ == "__main__":
    main()
