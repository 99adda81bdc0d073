"""Do edits of the truth that no model should lose to rank behind the models?

    python benchmarks/truth_edits.py fluid --size mini predictions.nc ...

Prints the distances of a free surface for three edits of the true test scenarios, for
the naive predictors and for some predictions:

- *shuffled*: the identities of the particles are shuffled in each frame;
- *noise*: white noise of 0.03 on each coordinate of each frame;
- *smoothed*: the mean over 20 frames to either side.

``analog-barycentre`` is the mean over several analogs, ``ballistic-analog`` one of
them. docs/scoring.md quotes the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from lagbench.data.local import resolve_root
from lagbench.data.registry import load
from lagbench.metrics.aggregate import Tally, aggregate
from lagbench.metrics.frame import snapshots
from lagbench.metrics.table import METRICS
from lagbench.references.predictor import given_in
from lagbench.references.table import references_of
from lagbench.scoring.task import load_scored_task, measure_rows
from lagbench.submission.predictions import open_predictions

NAMES = ("cloud_distance", "motion_distance")
NOISE = 0.03  # [length]
HALF_WIDTH = 20  # frames to either side that are averaged

Frames = NDArray[np.float64]


def edits(truth: Frames, first: int, seed: int) -> Iterator[tuple[str, Frames]]:
    """Yield the name and the predicted frames of each edit.

    Args:
        truth: all frames of a scenario [length], shape [frame, particle, axis].
        first: number of the first predicted frame.
        seed: of the draws.
    """
    generator = np.random.default_rng(seed)
    predicted = truth[first:]
    order = [generator.permutation(truth.shape[1]) for _ in predicted]
    yield "shuffled", np.stack([x[i] for x, i in zip(predicted, order, strict=True)])
    yield "noise", predicted + NOISE * generator.normal(size=predicted.shape)
    smoothed = uniform_filter1d(truth, 2 * HALF_WIDTH + 1, axis=0, mode="nearest")
    yield "smoothed", smoothed[first:]


def main() -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("split")
    parser.add_argument("--size", default="mini")
    parser.add_argument("--root", type=Path)
    parser.add_argument("predictions", nargs="*", type=Path)
    options = parser.parse_intermixed_args()
    root = resolve_root(options.root)
    size = load().size(options.split, options.size)
    task = load_scored_task(size, root)
    metrics = tuple(METRICS[name] for name in NAMES)
    tallies: dict[str, dict[int, Tally]] = {}
    for number in task.scenarios:
        with task.opened(number) as opened:
            last = task.config.predicted_frames.stop
            truth = opened.file.read("position", slice(0, last)).astype(np.float64)
            given = given_in(opened.file, size, root)
            rows = dict(edits(truth, task.config.input_frames, number))
            for reference in references_of(size):
                if reference.counts:
                    rows[reference.name] = np.stack(list(reference.predict(given)))
            for path in options.predictions:
                with open_predictions(path) as predictions:
                    blocks = [block for _, block in predictions.blocks(number)]
                    rows[path.stem] = np.concatenate(blocks)
            measured, _ = measure_rows(
                opened.scenario,
                opened.snapshots(),
                {name: snapshots(opened.scenario, row) for name, row in rows.items()},
                metrics=metrics,
            )
        for name, tally in measured.items():
            tallies.setdefault(name, {})[number] = tally
    print(f"| row | {' | '.join(NAMES)} |\n| --- | --- | --- |")
    for name, by_scenario in tallies.items():
        scores = aggregate(metrics, by_scenario)
        cells = [f"{scores[metric].mean:.4f}" for metric in NAMES]
        print(f"| {name} | {' | '.join(cells)} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
