"""Time of a predicted frame against the number of particles, one core: is it linear
(thesis section 3.2.2)?

    python benchmarks/inference_cost.py --rows 1-4 --output docs/figures

rolls untrained models out over boxes of 2,000 q^2 particles at one density:
connectivity radius and grid spacing shrink with 1/q, and a network of whole frames has
as many inputs as the box has numbers. Prints a table of milliseconds of processor time
and the exponents of a least-squares line through their logarithms; with --output also
into `inference_cost.md` there. The solver's exponents are in table_3_1.py's table.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from lagbench.baselines.baseline import Batch, DatasetInfo
from lagbench.baselines.catalogue import find
from lagbench.baselines.recipe import recipe_for
from lagbench.baselines.rollout import roll_out
from lagbench.data.registry import load
from lagbench.figures.tables import markdown

SPLIT = "curl-noise"
SIZE = "mini"
MODELS = ("gns", "mlp", "neuralmpm")
PARTICLES = 2000
FRAMES = 8
"""Frames of a rollout: one call of NeuralMPM with the recipe of this split."""

REPEATS = 3


def facts() -> DatasetInfo:
    """Return the public figures of the data set whose recipes are used; no file of it
    is read.
    """
    size = load().size(SPLIT, SIZE)
    if size.measured:
        known = size.measured.statistics
    else:
        known = {}
    task = size.task
    return DatasetInfo(
        split=SPLIT,
        size=SIZE,
        version=size.version,
        dataset_sha256="",
        particles=PARTICLES,
        bounds=size.bounds,
        radius=task.radius,
        input_frames=task.input_frames,
        horizon=FRAMES,
        score_cells=task.score_grid.cells,
        score_placement=task.score_grid.placement,
        frame_interval=size.frame_interval,
        moving_walls=False,
        statistics={name: (float(x), float(y)) for name, (x, y) in known.items()},
    )


def given(about: DatasetInfo) -> Batch:
    """Return the given frames of a box full of particles, one in each cell of a
    lattice, that swirl.
    """
    side = int(np.ceil(np.sqrt(about.particles)))
    cells = np.stack(
        np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), axis=-1
    ).reshape(-1, 2)
    rng = np.random.default_rng(0)
    unit = (cells[: about.particles] + rng.random((about.particles, 2))) / side
    a, b = np.pi * unit.T
    speed = about.statistics["velocity_std"][0]
    swirl = (
        2.0 * speed * np.stack([np.sin(a) * np.cos(b), -np.cos(a) * np.sin(b)], axis=-1)
    )
    low, high = np.transpose(about.bounds)
    frames = [
        low + (high - low) * unit + step * swirl for step in range(about.input_frames)
    ]
    count = about.particles
    return Batch(
        position=torch.tensor(np.stack(frames, axis=1), dtype=torch.float32),
        sample=torch.zeros(count, dtype=torch.int64),
        material=torch.zeros(count, dtype=torch.int64),
        wall_velocity=None,
        scenario=torch.zeros(1, dtype=torch.int64),
        frame=torch.zeros(1, dtype=torch.int64),
    )


def milliseconds(name: str, q: int) -> float:
    """Return the median processor time of a frame of a model."""
    about = facts()
    about = replace(about, particles=about.particles * q**2, radius=about.radius / q)
    entry = find(name)
    options = dict(recipe_for(entry, SPLIT, SIZE).model)
    if "cells" in options:
        options["cells"] *= q
    torch.manual_seed(0)
    model = entry.model.build(options, about)
    start = given(about)
    roll_out(model, start, FRAMES)
    taken = []
    for _ in range(REPEATS):
        before = time.process_time()
        roll_out(model, start, FRAMES)
        taken.append(1e3 * (time.process_time() - before) / FRAMES)
    return statistics.median(taken)


def main() -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", default="1-4", help="values of q, as in 1-4")
    parser.add_argument("--output", type=Path, help="folder of the table")
    asked = parser.parse_args()
    first, _, last = asked.rows.partition("-")
    rows = range(int(first), int(last or first) + 1)
    torch.set_num_threads(1)
    found = {name: [milliseconds(name, q) for q in rows] for name in MODELS}
    counts = [PARTICLES * q**2 for q in rows]
    lines = [
        [str(q), f"{count:,}", *(f"{found[name][i]:.3g}" for name in MODELS)]
        for i, (q, count) in enumerate(zip(rows, counts, strict=True))
    ]
    if len(rows) > 1:
        slopes = [
            float(np.polyfit(np.log(counts), np.log(found[name]), 1)[0])
            for name in MODELS
        ]
        lines.append(["", "exponent", *(f"{slope:.2f}" for slope in slopes)])
    said = f"Processor time of a frame [ms] on one core; untrained models, recipes of {SPLIT} {SIZE}."
    text = f"{said}\n\n{markdown(['q', 'particles', *MODELS], lines)}\n"
    print(text)
    if asked.output:
        (asked.output / "inference_cost.md").write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
