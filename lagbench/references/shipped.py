"""Scores of reference predictors, measured once per data set, shipped with the package.

``measured/<split>-<size>.json`` is bound to the hash of the data set. It has the value
of every metric per scenario. For metrics with a value per frame it has the mean over
scenarios too: at the reported frames, and for the metrics in :data:`CURVES` at all
frames (of long rollouts at a hundred, linear between). Numbers have five significant
digits, means at frames four, curves three. The file also has what a frame costs the
reference predictors and the solver itself on the machine that measured.
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

KNOTS = 100  # most frames of a curve

DIGITS = 5
FRAME_DIGITS = 4
CURVE_DIGITS = 3
COST_DIGITS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceScores:
    """Scores of a reference predictor on one split and size."""

    name: str  # name of the reference predictor
    # scores by metric; per_frame has one row, the mean over scenarios, NaN where it is
    # not kept
    scores: Mapping[str, Score]
    # CPU time to predict a frame on the machine that measured [s], which is no score
    seconds_per_frame: float
    # of vorticity at frame 54 [1], NaN where undefined, shape [scenario]
    correlation: NDArray[np.float64]


def correlation_of(scores: Mapping[str, Score]) -> NDArray[np.float64]:
    """Return the correlation of vorticity at frame 54, or the last one, shape
    [scenario].
    """
    pearson = scores["vorticity_pearson"]
    return pearson.at(min(54, pearson.frames[-1]))


def shipped_path(size: Size, folder: Path = FOLDER) -> Path:
    """Return the file with the shipped scores of a split and size."""
    return folder / f"{size.split}-{size.name}.json"


def shipped(size: Size, folder: Path = FOLDER) -> Mapping[str, ReferenceScores] | None:
    """Return the scores of the reference predictors of a split and size, by name.

    None where none were measured on the data set that the registry describes.
    """
    content = _read(size, folder)
    if content is None:
        return None

    references = {}
    for name, reference in content["floors"].items():
        references[name] = ReferenceScores(
            name=name,
            scores=_scores_from_json(reference, content),
            seconds_per_frame=reference["seconds_per_frame"],
            correlation=_floats(reference["correlation"]),
        )
    return references


def _scores_from_json(
    reference: Mapping[str, Any], content: Mapping[str, Any]
) -> dict[str, Score]:
    """Return the scores of a reference predictor; content is that of the whole file."""
    first, last = content["frames"]
    frames = range(first, last + 1)
    scenarios = tuple(content["scenarios"])
    reported = [frames.index(frame) for frame in content["reported_frames"]]
    always_defined = [0] * len(scenarios)

    metrics = available()
    scores = {}
    for name, values in reference["values"].items():
        if name not in metrics:
            continue  # of a package that is not installed here
        per_frame = np.full((1, len(frames)), np.nan)
        if name in reference["curves"]:
            curve = _floats(reference["curves"][name])
            per_frame[0] = np.interp(frames, _knots(frames), curve)
        if name in reference["at"]:
            per_frame[0, reported] = _floats(reference["at"][name])
        scores[name] = Score(
            metrics[name],
            scenarios,
            tuple(frames),
            per_frame,
            _floats(values),
            tuple(reference["undefined"].get(name, always_defined)),
        )
    return scores


def solver_seconds(size: Size, folder: Path = FOLDER) -> float | None:
    """Return the processor time of a frame of the solver itself [s].

    It was measured on the machine that measured the reference predictors.
    """
    content = _read(size, folder)
    if content is None:
        return None
    return content.get("solver_seconds_per_frame")


def _read(size: Size, folder: Path) -> dict[str, Any] | None:
    """Return the content of the file of a data set; None without one that fits it."""
    path = shipped_path(size, folder)
    if size.measured is None or not path.is_file():
        return None
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    has_format = content["lagbench_floors"] == FORMAT
    if has_format and content["dataset_sha256"] == size.measured.dataset_sha256:
        return content
    return None


def _require(size: Size, folder: Path) -> dict[str, Any]:
    content = _read(size, folder)
    if content is None:
        raise DataError(
            "no reference predictors were measured on this data set",
            where=str(shipped_path(size, folder)),
        )
    return content


def _knots(frames: Sequence[int]) -> NDArray[np.intp]:
    """Return the frames at which the file has a curve, first and last included."""
    count = min(len(frames), KNOTS)
    return np.rint(np.linspace(frames[0], frames[-1], count)).astype(np.intp)


def _floats(values: Sequence[float | None]) -> NDArray[np.float64]:
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
    """Write the scores of a data set: equal bytes for equal scores and costs.

    With ``partial`` the other reference predictors stay as they are, and so do all
    costs, which compare only within one run on one machine.
    """
    entries = {}
    for name, reference in references.items():
        entries[name] = _reference_as_json(reference, reported)

    costs: dict[str, Any] = {}
    if partial:
        earlier = _require(size, folder)
        earlier_entries = earlier["floors"]
        for name in entries.keys() & earlier_entries.keys():
            seconds = earlier_entries[name]["seconds_per_frame"]
            entries[name]["seconds_per_frame"] = seconds
        entries = {**earlier_entries, **entries}
        if "solver_seconds_per_frame" in earlier:
            seconds = earlier["solver_seconds_per_frame"]
            costs["solver_seconds_per_frame"] = seconds

    first_reference = next(iter(references.values()))
    first_score = next(iter(first_reference.scores.values()))
    content = {
        "lagbench_floors": FORMAT,
        "split": size.split,
        "size": size.name,
        "dataset_version": size.version,
        "dataset_sha256": dataset_sha256,
        "scenarios": list(first_score.scenarios),
        "frames": [first_score.frames[0], first_score.frames[-1]],
        "reported_frames": list(reported),
        **costs,
        "floors": entries,
    }
    return _write(size, content, folder)


def write_solver_seconds(size: Size, seconds: float, folder: Path = FOLDER) -> Path:
    """Add the processor time of a frame of the solver itself to a file [s]."""
    content = _require(size, folder)
    entries = content.pop("floors")
    content["solver_seconds_per_frame"] = _number(seconds, COST_DIGITS)
    content["floors"] = entries
    return _write(size, content, folder)


def _write(size: Size, content: Mapping[str, Any], folder: Path) -> Path:
    path = shipped_path(size, folder)
    write_atomically(path, f"{_format(content)}\n".encode(), option="--folder")
    return path


def _reference_as_json(
    reference: ReferenceScores, reported: Sequence[int]
) -> dict[str, Any]:
    values = {}
    undefined = {}
    at = {}
    for name, score in reference.scores.items():
        values[name] = _numbers(score.values, DIGITS)
        if any(score.undefined):
            undefined[name] = list(score.undefined)
        if score.metric.per_frame:
            at[name] = _means_at(score, reported, FRAME_DIGITS)

    curves = {}
    for name in CURVES:
        score_of_curve = reference.scores.get(name)
        if score_of_curve is not None and score_of_curve.metric.per_frame:
            knots = _knots(score_of_curve.frames).tolist()
            curves[name] = _means_at(score_of_curve, knots, CURVE_DIGITS)
    return {
        "seconds_per_frame": _number(reference.seconds_per_frame, COST_DIGITS),
        "correlation": _numbers(reference.correlation, FRAME_DIGITS),
        "values": values,
        "undefined": undefined,
        "at": at,
        "curves": curves,
    }


def _means_at(score: Score, frames: Sequence[int], digits: int) -> list[float | None]:
    """Return the means over the scenarios that have a value, at some frames."""
    means = []
    for frame in frames:
        values = score.at(frame)
        means.append(_number(mean(values[np.isfinite(values)]), digits))
    return means


def _numbers(values: NDArray[np.float64], digits: int) -> list[float | None]:
    return [_number(value, digits) for value in values.tolist()]


def _number(value: float, digits: int) -> float | None:
    if math.isfinite(value):
        return round_digits(value, digits)
    return None


def _format(value: object, depth: int = 0) -> str:
    """Return JSON with each entry of a mapping in its own line.

    A comparison of two versions then shows which entry changed.
    """
    if not isinstance(value, dict) or not value:
        return json.dumps(value, allow_nan=False, separators=(",", ":"))
    indent = " " * (depth + 1)
    entries = []
    for key, member in value.items():
        entries.append(f"{indent}{json.dumps(key)}: {_format(member, depth + 1)}")
    body = ",\n".join(entries)
    return f"{{\n{body}\n{' ' * depth}}}"
