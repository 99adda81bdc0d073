"""Print what a test subset asks of a model: how the frozen field fails, or how long it
stays active.

    python benchmarks/frozen_field.py --root FOLDER --data cavity/mini
        [SPLIT/SIZE ...] [--each]

Full boxes, of two or three dimensions, walled or periodic: the reference predictor
frozen-field carries the particles by the velocity of the last given frame, which decays
as the given frames do where nothing drives the flow. Printed are the correlation of its
vorticity with the true one at frame 54 (tiny: the last) over the test scenarios, and
its relative error over the horizon, sqrt(sum_f MSE(omega) / sum_f mean(omega^2)), as a
table in Markdown. An undefined correlation is one below 0.8: the predicted flow has
come to rest. Free surfaces: active frames by pair or family. Exits with 1 where fewer
than 75 % of a full box's test correlate below 0.8, or the median error of the
split cavity is below 0.8, or (mini, full) a pair's median of active frames is below 80.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from lagbench.data.grid import fields
from lagbench.data.registry import Size, load
from lagbench.data.scenario import ScenarioFile, read_scenario
from lagbench.metrics.vorticity import pearson
from lagbench.references import given_in
from lagbench.references.frozen_field import predict

FRAME = 54
FALLEN = 0.8
SHARE = 0.75
ERROR = 0.8
ACTIVE = 80
KINDS = {
    "fluid": "family",
    "multimaterial": "pair",
    "fluid-3d": "family",
    "multimaterial-3d": "pair",
}
HEAD = (
    "| data set | test scenarios below 0.8 | median correlation | largest correlation "
    "| median error | accepted |\n|---|---:|---:|---:|---:|---|"
)


def main() -> int:
    """Print one block per data set; return 0 if all of them ask enough, else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--data", nargs="+", required=True, metavar="SPLIT/SIZE")
    parser.add_argument("--each", action="store_true", help="one line per scenario")
    options = parser.parse_args()
    failures = 0
    is_headed = False
    for name in options.data:
        split, size_name = name.split("/")
        size = load().size(split, size_name)
        if size.split in KINDS:
            failures += not _judge_activity(size, options.root, options.each)
            continue
        if not is_headed:
            print(HEAD)
            is_headed = True
        failures += not _judge_frozen_field(size, options.root, options.each)
    return 1 if failures else 0


def _judge_frozen_field(size: Size, root: Path, each: bool) -> bool:
    """Print a row of correlations and errors of test; return whether it is hard enough.

    The row has the share of correlations below 0.8, their median and largest value, and
    the median relative error.
    """
    correlations = []
    errors = []
    for scenario in size.subsets["test"]:
        path = size.path(root, scenario)
        with read_scenario(path) as file:
            correlation, error = _score_frozen_field(size, file, root)
            parameters = file.header.parameters
        correlations.append(correlation)
        errors.append(error)
        if each:
            kind = []
            for name in ("wall", "motion", "reynolds_number", "frequency"):
                if name in parameters:
                    kind.append(parameters[name])
            print(
                f"  {scenario}: correlation {correlation:.3f}, error {error:.3f}; "
                f"{kind}",
                flush=True,
            )

    is_below = ~(np.array(correlations) >= FALLEN)  # undefined ones count
    share_below = float(np.mean(is_below))
    median_error = float(np.median(errors))
    is_hard_enough = share_below >= SHARE
    if size.split == "cavity":
        is_hard_enough = is_hard_enough and median_error >= ERROR
    verdict = "yes" if is_hard_enough else "no"
    defined = [value for value in correlations if np.isfinite(value)]
    median_correlation = "-"
    largest_correlation = "-"
    if defined:
        median_correlation = f"{np.median(defined):.3f}"
        largest_correlation = f"{np.max(defined):.3f}"
    print(
        f"| {size.split} {size.name} | {share_below:.0%} of {len(errors)} | "
        f"{median_correlation} | {largest_correlation} | {median_error:.3g} | "
        f"{verdict} |",
        flush=True,
    )
    return is_hard_enough


def _score_frozen_field(
    size: Size, file: ScenarioFile, root: Path
) -> tuple[float, float]:
    """Return correlation at frame 54 and relative error over the horizon."""
    first = size.task.input_frames - 1
    last = first + size.task.horizon
    frames = slice(0, last + 1)
    stored_truth = file.read("position", frames)
    truth = stored_truth.astype(np.float64)
    given = given_in(file, size, root)
    box = size.box
    grid = size.field_grid
    full = grid.full_weight(size.particles, box.volume)
    correlation = float("nan")
    squared_error = 0.0
    squared_truth = 0.0
    before = given.last
    predicted = predict(given)
    judged_frame = min(FRAME, last)
    for frame, position in zip(given.predicted_frames, predicted, strict=True):
        true_before = truth[frame - 1]
        true_now = truth[frame]
        true_step = box.displacement(true_before, true_now)
        true_fields = fields(true_now, true_step, grid, full=full)
        now = position.astype(np.float64)
        step = box.displacement(before, now)
        before = now
        counted = true_fields.counted
        predicted_fields = fields(now, step, grid, full=full, counted=counted)

        nodes = true_fields.differentiable
        true_vorticity = true_fields.vorticity[nodes].ravel()
        vorticity = predicted_fields.vorticity[nodes].ravel()
        error = true_vorticity - vorticity
        squared_error += float(np.mean(error**2))
        squared_truth += float(np.mean(true_vorticity**2))
        if frame == judged_frame:
            correlation = pearson(true_vorticity, vorticity)
    relative_error = float(np.sqrt(squared_error / squared_truth))
    return correlation, relative_error


def _judge_activity(size: Size, root: Path, each: bool) -> bool:
    """Print the median of active frames of each pair or family, over all scenarios."""
    counts_by_kind = defaultdict(list)
    for scenario in size.scenarios:
        path = size.path(root, scenario)
        with read_scenario(path) as file:
            parameters = file.header.parameters
        kind_name = KINDS[size.split]
        kind = parameters[kind_name]
        active_frames = int(str(parameters["active_frames"]))
        counts_by_kind[kind].append(active_frames)
        if each:
            print(f"  {scenario}: {kind} {active_frames}")
    medians = []
    for kind, counts in counts_by_kind.items():
        median = float(np.median(counts))
        medians.append(median)
        print(
            f"{size.split} {size.name}, {kind}: median {median:g} active frames "
            f"of {size.task.horizon}, {min(counts)} to {max(counts)}"
        )
    return size.name == "tiny" or min(medians) >= ACTIVE


if __name__ == "__main__":
    raise SystemExit(main())
