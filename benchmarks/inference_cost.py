"""Time of a predicted frame against the number of particles, one core: is it linear
(thesis section 3.2.2)?

    python benchmarks/inference_cost.py --rows 1-4 --output docs/figures

rolls untrained models out over boxes of 2,000 q^2 particles at one density:
connectivity radius and grid spacing shrink with 1/q, and the `mlp` has as many inputs
as the box has numbers. Prints a table of milliseconds of processor time
and the exponents of a least-squares line through their logarithms; with --output also
into `inference_cost.md` there. The solver's exponents are in table_3_1.py's table.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from pathlib import Path

import numpy as np
import torch

from lagbench.baselines.baseline import Batch, DatasetInfo
from lagbench.baselines.catalogue import find
from lagbench.baselines.recipe import recipe_for
from lagbench.baselines.rollout import roll_out
from lagbench.data.layout import parse_ids
from lagbench.data.registry import load
from lagbench.errors import LagbenchError, UsageError
from lagbench.figures.tables import markdown

SPLIT = "curl-noise"
SIZE = "mini"
MODELS = ("gns", "mlp", "neuralmpm")
PARTICLES = 2000
FRAMES = 8
"""Frames of a rollout: one call of NeuralMPM with the recipe of this split."""

REPEATS = 3


def make_dataset_info(q: int) -> DatasetInfo:
    """Return the info of a data set with q^2 times the particles.

    They are those of the data set whose recipes are used; no file of it is read.
    """
    size = load().size(SPLIT, SIZE)
    statistics_by_name = {}
    if size.measured:
        for name, (x, y) in size.measured.statistics.items():
            components = (float(x), float(y))
            statistics_by_name[name] = components
    task = size.task
    return DatasetInfo(
        split=SPLIT,
        size=SIZE,
        version=size.version,
        dataset_sha256="",
        particles=PARTICLES * q**2,
        bounds=size.bounds,
        radius=task.radius / q,
        input_frames=task.input_frames,
        horizon=FRAMES,
        score_cells=task.score_grid.cells,
        score_placement=task.score_grid.placement,
        frame_interval=size.frame_interval,
        moving_walls=False,
        statistics=statistics_by_name,
    )


def make_given_frames(info: DatasetInfo) -> Batch:
    """Return the given frames of a box full of particles that swirl.

    There is one particle in each cell of a lattice.
    """
    count = info.particles
    even_side = math.sqrt(count)
    side = math.ceil(even_side)
    axis = np.arange(side)
    coordinates = np.meshgrid(axis, axis, indexing="ij")
    lattice = np.stack(coordinates, axis=-1)
    all_cells = lattice.reshape(-1, 2)
    cells = all_cells[:count]
    rng = np.random.default_rng(0)
    offset = rng.random((count, 2))
    # positions in a box of side 1, shape [particle, 2]
    unit_position = (cells + offset) / side
    phase_x, phase_y = np.pi * unit_position.T
    velocity_x = np.sin(phase_x) * np.cos(phase_y)
    velocity_y = -np.cos(phase_x) * np.sin(phase_y)
    unit_velocity = np.stack([velocity_x, velocity_y], axis=-1)
    speed = info.statistics["velocity_std"][0]
    velocity = 2.0 * speed * unit_velocity
    low, high = np.transpose(info.bounds)
    extent = high - low
    first = low + extent * unit_position
    frames = []
    for step in range(info.input_frames):
        frame = first + step * velocity
        frames.append(frame)
    position = np.stack(frames, axis=1)
    return Batch(
        position=torch.tensor(position, dtype=torch.float32),
        sample=torch.zeros(count, dtype=torch.int64),
        material=torch.zeros(count, dtype=torch.int64),
        wall_velocity=None,
        scenario=torch.zeros(1, dtype=torch.int64),
        frame=torch.zeros(1, dtype=torch.int64),
    )


def measure_milliseconds(name: str, q: int) -> float:
    """Return the median processor time of a frame of a model."""
    info = make_dataset_info(q)
    entry = find(name)
    recipe = recipe_for(entry, SPLIT, SIZE)
    options = dict(recipe.model)
    if "cells" in options:
        options["cells"] *= q
    torch.manual_seed(0)
    model = entry.model.build(options, info)
    given_frames = make_given_frames(info)
    roll_out(model, given_frames, FRAMES)
    milliseconds = []
    for _ in range(REPEATS):
        start = time.process_time()
        roll_out(model, given_frames, FRAMES)
        seconds = time.process_time() - start
        seconds_per_frame = seconds / FRAMES
        milliseconds.append(1e3 * seconds_per_frame)
    return statistics.median(milliseconds)


def read_rows(text: str) -> tuple[int, ...]:
    """Return the values of q that a text names, as in 1-4.

    Raises:
        UsageError: there are none, or one is below 1.
    """
    rows = parse_ids(text, where="--rows", noun="q")
    if min(rows) < 1:
        raise UsageError(
            "there is nothing to measure",
            where="--rows",
            expected="values of q from 1 on",
            got=repr(text),
            fix="give them as in --rows 1-4",
        )
    return rows


def main() -> int:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rows", default="1-4", help="values of q, as in 1-4")
    parser.add_argument("--output", type=Path, help="folder of the table")
    options = parser.parse_args()
    rows = read_rows(options.rows)
    torch.set_num_threads(1)

    counts = PARTICLES * np.square(rows)
    times: dict[str, list[float]] = {}  # [ms]
    for name in MODELS:
        times[name] = []
        for q in rows:
            milliseconds = measure_milliseconds(name, q)
            times[name].append(milliseconds)
    lines = []
    for i, q in enumerate(rows):
        cells = [str(q), f"{counts[i]:,}"]
        for name in MODELS:
            milliseconds = times[name][i]
            cells.append(f"{milliseconds:.3g}")
        lines.append(cells)
    if len(rows) > 1:
        log_counts = np.log(counts)
        exponents = []
        for name in MODELS:
            log_times = np.log(times[name])
            slope, _ = np.polyfit(log_counts, log_times, 1)
            exponents.append(f"{slope:.2f}")
        lines.append(["", "exponent", *exponents])
    caption = (
        "## Time of a predicted frame for more and more particles\n\n"
        "The table shows the processor time [ms] of one predicted frame on one core "
        f"(mean of {FRAMES} frames). The models are a graph "
        "network (`gns`), a network with all particles of a frame as one input "
        "(`mlp`), and `neuralmpm`. The models are untrained, because weights do not "
        f"change the time. The options come from the recipes for {SPLIT} {SIZE}.\n\n"
        f"The box holds {PARTICLES:,} q^2 particles. Compared with q = 1, the grid of "
        "`neuralmpm` has q times as many cells along each axis. The connectivity "
        "radius of `gns` is divided by q, so a particle keeps its number of "
        "neighbours. The last row has the exponent p of the fit time ~ (number of "
        "particles)^p."
    )
    heads = ("q", "particles", *MODELS)
    table = markdown(heads, lines)
    text = f"{caption}\n\n{table}\n"
    print(text)
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
        path = options.output / "inference_cost.md"
        path.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"inference_cost: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
