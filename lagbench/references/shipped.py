"""Scores of the reference predictors, measured once per data set and shipped.

``measured/<split>-<size>.json`` is bound to the hash of the data set;
``measured/<split>-<size>-shift.json``, on the subset ``shift``, also to that of the
subset. A file has the value
of every metric per scenario. For metrics that have a value at each frame it has the
mean over scenarios: at the reported frames, and for the metrics in :data:`CURVES` at
all frames (of long rollouts at a hundred, linear between). Scores have five significant
digits, means at frames four, curves three. Beside them stands what a frame costs each
predictor and the solver itself, timed in one run on one machine.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import write_atomically
from lagbench.data.checksums import round_digits
from lagbench.data.registry import Size
from lagbench.errors import DataError
from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import mean
from lagbench.metrics.table import available

FOLDER = Path(__file__).parent / "measured"

FORMAT = 1
"""Number of the layout of these files; stored as ``lagbench_floors``."""

CURVES = (
    "vorticity_nrmse",
    "motion_distance",
    "cloud_distance",
    "vorticity_mse",
    "vorticity_rmse",
    "vorticity_pearson",
    "attribute_mse",
    "position_rmse",
    "velocity_rmse",
    "energy_ratio",
    "energy_retention",
    "density_rmse",
    "divergence_rms",
    "shape_error",
    "connectivity",
)
"""Metrics of which reports and boards draw curves."""

DIGITS = 5
FRAME_DIGITS = 4
CURVE_DIGITS = 3
COST_DIGITS = 3

MOST_KNOTS = 100
"""Frames at which a curve is kept, at most."""

REPORTED_CORRELATION = 54
"""Frame whose correlation of vorticity is shipped; in shorter tasks the last one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceScores:
    """Scores and cost of a reference predictor on one split and size."""

    name: str  # name of the predictor
    # scores by metric; per_frame has one row, the mean over scenarios, NaN where it is
    # not kept
    scores: Mapping[str, Score]
    # processor time to predict a frame, on the machine that timed all of them [s]
    seconds_per_frame: float
    # of vorticity at frame 54 [1], NaN where undefined, shape [scenario]
    correlation: NDArray[np.float64]


def correlation_of(scores: Mapping[str, Score]) -> NDArray[np.float64]:
    """Return the correlation of vorticity at frame 54 or the last one, [scenario]."""
    pearson = scores["vorticity_pearson"]
    return pearson.at(min(REPORTED_CORRELATION, pearson.frames[-1]))


def shipped_path(size: Size, folder: Path = FOLDER) -> Path:
    """Return the file with the scores of the references of a split and size."""
    name = f"{size.split}-{size.name}"
    if size.scored_subset != "test":
        name += f"-{size.scored_subset}"
    return folder / f"{name}.json"


def shipped(size: Size, folder: Path = FOLDER) -> Mapping[str, ReferenceScores] | None:
    """Return the scores of the references of a split and size, by name.

    None where none were measured on the data set that the registry describes.
    """
    content = _read(size, folder)
    if content is None:
        return None
    references = {}
    for name, record in content["floors"].items():
        references[name] = ReferenceScores(
            name=name,
            scores=_scores_in(record, content),
            seconds_per_frame=record["seconds_per_frame"],
            correlation=_to_array(record["correlation"]),
        )
    return references


def _scores_in(
    record: Mapping[str, Any], content: Mapping[str, Any]
) -> dict[str, Score]:
    """Return the scores in the record of a predictor, by metric."""
    first, last = content["frames"]
    frames = range(first, last + 1)
    scenarios = tuple(content["scenarios"])
    reported = [frames.index(frame) for frame in content["reported_frames"]]
    metrics = available()
    scores = {}
    for name, values in record["values"].items():
        if name not in metrics:
            continue  # of a package that is not installed here
        per_frame = np.full((1, len(frames)), np.nan)
        if name in record["curves"]:
            curve = _to_array(record["curves"][name])
            per_frame[0] = np.interp(frames, _knots(frames), curve)
        if name in record["at"]:
            per_frame[0, reported] = _to_array(record["at"][name])
        undefined = record["undefined"].get(name, [0] * len(scenarios))
        scores[name] = Score(
            metrics[name],
            scenarios,
            tuple(frames),
            per_frame,
            _to_array(values),
            tuple(undefined),
        )
    return scores


def solver_seconds(size: Size, folder: Path = FOLDER) -> float | None:
    """Return the processor time of a frame of the solver itself [s].

    It was timed where the references were timed; None where it was not.
    """
    content = _read(size, folder)
    if content is None:
        return None
    return content.get("solver_seconds_per_frame")


def _read(size: Size, folder: Path) -> dict[str, Any] | None:
    """Return the content of a file; None where it is of other data, or not there."""
    path = shipped_path(size, folder)
    if size.measured is None or not path.is_file():
        return None
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    is_current = content["dataset_sha256"] == size.measured.dataset_sha256
    if size.scored_subset != "test":
        subset_sha256 = size.measured.subset_sha256.get(size.scored_subset)
        is_current = is_current and content.get("subset_sha256") == subset_sha256
    if content["lagbench_floors"] == FORMAT and is_current:
        return content
    return None


def _require(size: Size, folder: Path) -> dict[str, Any]:
    content = _read(size, folder)
    if content is None:
        raise DataError(
            "no reference predictors were measured on this data set; measure them "
            "first: python -m lagbench.scoring.measure_references",
            where=str(shipped_path(size, folder)),
        )
    return content


def _knots(frames: Sequence[int]) -> NDArray[np.intp]:
    """Return the frames at which a curve is kept, first and last included."""
    count = min(len(frames), MOST_KNOTS)
    return np.rint(np.linspace(frames[0], frames[-1], count)).astype(np.intp)


def _to_array(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([math.nan if value is None else value for value in values])


def write_shipped(
    size: Size,
    references: Mapping[str, ReferenceScores],
    *,
    dataset_sha256: str,
    reported: Sequence[int],
    folder: Path = FOLDER,
    partial: bool = False,
) -> Path:
    """Write the scores of the references of a data set.

    Equal scores and costs give equal bytes.

    Args:
        size: the split and size.
        references: scores by name.
        dataset_sha256: hash of the data set.
        reported: frames at which the scorer reports.
        folder: folder of shipped scores.
        partial: whether the other references stay as they are, and so do all costs,
            which compare only within one run on one machine.

    Raises:
        DataError: with ``partial``, where nothing was measured on this data set.
    """
    any_reference = next(iter(references.values()))
    any_score = next(iter(any_reference.scores.values()))
    records = {}
    for name, reference in references.items():
        records[name] = _record_of(reference, reported)
    costs: dict[str, Any] = {}
    if partial:
        before = _require(size, folder)
        for name in records.keys() & before["floors"].keys():
            cost = before["floors"][name]["seconds_per_frame"]
            records[name]["seconds_per_frame"] = cost
        records = {**before["floors"], **records}
        if "solver_seconds_per_frame" in before:
            cost = before["solver_seconds_per_frame"]
            costs["solver_seconds_per_frame"] = cost
    subset: dict[str, Any] = {}
    if size.scored_subset != "test":
        subset["subset"] = size.scored_subset
        if size.measured is not None:
            hashes = size.measured.subset_sha256
            subset["subset_sha256"] = hashes.get(size.scored_subset)
    content = {
        "lagbench_floors": FORMAT,
        "split": size.split,
        "size": size.name,
        "dataset_version": size.version,
        "dataset_sha256": dataset_sha256,
        **subset,
        "scenarios": list(any_score.scenarios),
        "frames": [any_score.frames[0], any_score.frames[-1]],
        "reported_frames": list(reported),
        **costs,
        "floors": records,
    }
    return _write(size, content, folder)


def write_costs(
    size: Size,
    seconds: Mapping[str, float],
    *,
    solver: float,
    folder: Path = FOLDER,
) -> Path:
    """Write what a frame costs each reference and the solver itself, timed in one run.

    Args:
        size: the split and size.
        seconds: processor time of a frame by name of the reference [s].
        solver: processor time of a frame of the solver itself [s].
        folder: folder of shipped scores.

    Raises:
        DataError: nothing was measured on this data set.
    """
    content = _require(size, folder)
    references = content.pop("floors")
    for name, value in seconds.items():
        references[name]["seconds_per_frame"] = _round(value, COST_DIGITS)
    content["solver_seconds_per_frame"] = _round(solver, COST_DIGITS)
    content["floors"] = references
    return _write(size, content, folder)


def _write(size: Size, content: Mapping[str, Any], folder: Path) -> Path:
    path = shipped_path(size, folder)
    write_atomically(path, f"{_format(content)}\n".encode(), option="--folder")
    return path


def _record_of(reference: ReferenceScores, reported: Sequence[int]) -> dict[str, Any]:
    """Return the scores and the cost of a reference as the file holds them."""
    values = {}
    undefined = {}
    means_at_frames = {}
    curves = {}
    for name, score in reference.scores.items():
        values[name] = _round_all(score.values.tolist(), DIGITS)
        if any(score.undefined):
            undefined[name] = list(score.undefined)
        if not score.metric.per_frame:
            continue
        means = [_finite_mean(score.at(frame)) for frame in reported]
        means_at_frames[name] = _round_all(means, FRAME_DIGITS)
    for name in CURVES:
        if name in means_at_frames:
            score = reference.scores[name]
            knots = _knots(score.frames).tolist()
            curve = [_finite_mean(score.at(frame)) for frame in knots]
            curves[name] = _round_all(curve, CURVE_DIGITS)
    correlation = reference.correlation.tolist()
    return {
        "seconds_per_frame": _round(reference.seconds_per_frame, COST_DIGITS),
        "correlation": _round_all(correlation, FRAME_DIGITS),
        "values": values,
        "undefined": undefined,
        "at": means_at_frames,
        "curves": curves,
    }


def _finite_mean(values: NDArray[np.float64]) -> float:
    return mean(values[np.isfinite(values)])


def _round_all(values: Sequence[float], digits: int) -> list[float | None]:
    return [_round(value, digits) for value in values]


def _round(value: float, digits: int) -> float | None:
    if math.isfinite(value):
        return round_digits(value, digits)
    return None


def _format(value: object, depth: int = 0) -> str:
    """Return JSON with one line per entry of a mapping, for readable changes."""
    if not isinstance(value, dict) or not value:
        return json.dumps(value, allow_nan=False, separators=(",", ":"))
    lines = []
    for key, member in value.items():
        indent = " " * (depth + 1)
        lines.append(f"{indent}{json.dumps(key)}: {_format(member, depth + 1)}")
    return "{\n" + ",\n".join(lines) + f"\n{' ' * depth}}}"
