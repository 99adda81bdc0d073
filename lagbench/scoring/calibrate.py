"""Fit the constants of the calibrated rows on train, and write them to the package.

usage: python -m lagbench.scoring.calibrate --split fluid --size mini [--root FOLDER]
           [--row restarted-half-calibrated ...]

The error to minimise is the ranking metric, over some scenarios of train and some of
their frames. It jumps a little between neighbouring constants where the flow is
chaotic, and a descent stops at the next jump. So a quadratic polynomial is fitted to
its logarithm at many points of a box, and its minimum is taken (a response surface, Box
and Wilson 1951, J. R. Stat. Soc. B 13). Where the error is smooth that is done once
more in a smaller box around it.
Nothing is drawn: the same data give the same constants.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, minimize
from scipy.stats.qmc import Halton

from lagbench.data.local import resolve_root
from lagbench.data.registry import Size, load
from lagbench.errors import LagbenchError, WorkFailedError
from lagbench.metrics.aggregate import Tally, aggregate, measure
from lagbench.metrics.frame import FramePair, snapshots
from lagbench.metrics.table import ranking_metric, select
from lagbench.references.calibrated import (
    CALIBRATED_PATH,
    ROWS,
    CalibratedRow,
    Constants,
    fit_key,
)
from lagbench.references.predictor import given_in

from .task import ScoredTask, load_scored_task

Floats = NDArray[np.float64]

SCENARIOS = {2: 8, 3: 3}
"""Scenarios of train by dimension, at most."""

FRAMES = {2: 200, 3: 60}
"""Predicted frames by dimension, at most."""

COMPARED = 12
"""Frames of these that are compared, evenly spaced."""

POINTS_PER_TERM = 2
"""Points at which the error is measured, over the terms of the polynomial."""

SMALLER = 0.3
"""Width of the second box over that of the first."""

WORST_ERROR = 10.0
"""Error of constants with which the solver breaks down."""


def error_of(row: CalibratedRow, constants: Constants, task: ScoredTask) -> float:
    """Return the ranking metric of a row on some scenarios of train."""
    size = task.size
    metrics = select((ranking_metric(size),))
    names = [metric.name for metric in metrics if metric.statistic is not None]
    predicted = task.config.predicted_frames[: FRAMES[size.dimension]]
    compared = predicted[:: -max(1, len(predicted) // COMPARED)]
    tallies = {}
    for scenario in task.scenarios[: SCENARIOS[size.dimension]]:
        values = {}
        with task.opened(scenario) as truth:
            given = given_in(truth.file, size, task.truth.root)
            try:
                frames = snapshots(truth.scenario, row.predict(given, constants))
                for frame, true, one in zip(
                    predicted, truth.snapshots(), frames, strict=False
                ):
                    if frame in compared:
                        pair = FramePair(truth.scenario, frame, true, one)
                        values[frame] = measure(pair, metrics)
            except WorkFailedError:
                return WORST_ERROR
        tallies[scenario] = Tally.of(names, sorted(compared), values)
    error = aggregate(metrics, tallies)[ranking_metric(size)].mean
    return error if np.isfinite(error) else WORST_ERROR


def fit(
    row: CalibratedRow, task: ScoredTask, *, report: Callable[[str], None]
) -> dict[str, float]:
    """Return the constants of a row with the least error on train."""
    ranges = row.ranges(task.size)
    names = list(ranges)
    box = np.array(list(ranges.values()))

    def measured(point: Floats) -> float:
        constants = dict(zip(names, point.tolist(), strict=True))
        error = error_of(row, constants, task)
        report(f"{row.name} {constants}: {error:.5g}")
        return error

    best: tuple[float, Floats] = (np.inf, box.mean(axis=1))
    widths = (1.0, SMALLER) if row.is_smooth else (1.0,)
    for width in widths:
        half = 0.5 * width * (box[:, 1] - box[:, 0])
        low = np.maximum(box[:, 0], best[1] - half)
        high = np.minimum(box[:, 1], best[1] + half)
        ends = np.stack([low, high], axis=1)
        points = spread_points(ends, POINTS_PER_TERM * count_terms(len(names)))
        errors = np.array([measured(point) for point in points])
        lowest = minimum_of_surface(points, np.log(errors), ends)
        points = np.vstack([points, lowest])
        errors = np.append(errors, measured(lowest))
        i = int(np.argmin(errors))
        if errors[i] < best[0]:
            best = (float(errors[i]), points[i])
    return {
        name: round(value, 4)
        for name, value in zip(names, best[1].tolist(), strict=True)
    }


def spread_points(ends: Floats, count: int) -> Floats:
    """Return points that fill a box evenly, shape [point, constant].

    They are those of Halton's sequence, without its first, a corner.

    Args:
        ends: lower and upper end of each constant, shape [constant, 2].
        count: how many points.
    """
    sequence = Halton(len(ends), scramble=False)
    sequence.fast_forward(1)
    low, high = ends.T
    return np.asarray(low + sequence.random(count) * (high - low))


def count_terms(dimension: int) -> int:
    """Return the terms of a quadratic polynomial of so many variables."""
    return (dimension + 1) * (dimension + 2) // 2


def minimum_of_surface(points: Floats, values: Floats, ends: Floats) -> Floats:
    """Return where the quadratic polynomial that fits values best is least in a box.

    Args:
        points: where the values were measured, shape [point, constant].
        values: shape [point].
        ends: of the box, shape [constant, 2].
    """
    polynomial, *_ = np.linalg.lstsq(_terms(points), values, rcond=None)

    def surface(point: Floats) -> float:
        return float((_terms(point[None]) @ polynomial).item())

    # The polynomial may have a saddle: each descent ends at a minimum of its own.
    low, high = ends.T
    minima = []
    for start in points[np.argsort(values)[:5]]:
        minima.append(minimize(surface, start, bounds=Bounds(low, high)))
    best = min(minima, key=lambda minimum: float(minimum.fun))
    return np.asarray(best.x, np.float64)


def _terms(points: Floats) -> Floats:
    """Return 1, all constants, and all their products, shape [point, term]."""
    with_one = np.column_stack([np.ones(len(points)), points])
    columns = []
    for i, column in enumerate(with_one.T):
        for other in with_one.T[i:]:
            columns.append(column * other)
    return np.column_stack(columns)


def record_fit(
    size: Size, name: str, constants: Constants, path: Path = CALIBRATED_PATH
) -> None:
    """Write the constants of a row beside the others."""
    fits = json.loads(path.read_text("utf-8"))
    fits.setdefault(fit_key(size), {})[name] = dict(constants)
    path.write_text(json.dumps(fits, indent=1, sort_keys=True) + "\n", "utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this module; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--split", required=True)
    parser.add_argument("--size", required=True)
    parser.add_argument("--root", type=Path)
    parser.add_argument("--row", nargs="+", choices=[row.name for row in ROWS])
    options = parser.parse_args(arguments)

    def report(line: str) -> None:
        sys.stderr.write(f"{line}\n")

    try:
        size = load().size(options.split, options.size)
        task = load_scored_task(size, resolve_root(options.root), subset="train")
        for row in ROWS:
            if row.fits(size) and (not options.row or row.name in options.row):
                constants = fit(row, task, report=report)
                record_fit(size, row.name, constants)
                sys.stdout.write(f"{fit_key(size)} {row.name}: {constants}\n")
    except LagbenchError as error:
        sys.stderr.write(f"calibrate: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
