"""Scores of the floors, measured once per data set and shipped with the package.

``measured/<split>-<size>.json`` is bound to the hash of the data set. It has the value
of every metric per scenario, and of what is told frame by frame the mean over
scenarios: at the reported frames, and for the metrics in :data:`CURVES` at all frames
(of long rollouts at a hundred, linear between). Numbers have five significant digits,
means at frames four, curves three. Beside them stands what a frame costs the floors and
the solver itself on the machine that measured.
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
    *("vorticity_nrmse", "cloud_distance"),
    *("vorticity_mse", "vorticity_rmse", "vorticity_pearson", "attribute_mse"),
    *(
        "position_rmse",
        "velocity_rmse",
        "energy_ratio",
        "energy_retention",
        "density_rmse",
    ),
    *("divergence_rms", "shape_error", "connectivity"),
)
"""Metrics of which reports and boards draw curves."""

DIGITS = 5
FRAME_DIGITS = 4
CURVE_DIGITS = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceScores:
    """What a floor scores on one split and size."""

    name: str  # name of the floor
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
    """Return the file with the scores of the floors of a split and size."""
    return folder / f"{size.split}-{size.name}.json"


def shipped(size: Size, folder: Path = FOLDER) -> Mapping[str, ReferenceScores] | None:
    """Return what the floors of a split and size score, by name.

    None where none were measured on the data set that the registry describes.
    """
    held = _held(size, folder)
    if held is None:
        return None
    first, last = held["frames"]
    scenarios = tuple(held["scenarios"])
    frames = range(first, last + 1)
    known = available()
    none = [0] * len(scenarios)
    found = {}
    for floor, said in held["floors"].items():
        scores = {}
        for name, values in said["values"].items():
            if name not in known:
                continue  # of a package that is not installed here
            per_frame = np.full((1, len(frames)), np.nan)
            if name in said["curves"]:
                per_frame[0] = np.interp(
                    frames, _knots(frames), _floats(said["curves"][name])
                )
            if name in said["at"]:
                reported = [frames.index(frame) for frame in held["reported_frames"]]
                per_frame[0, reported] = _floats(said["at"][name])
            undefined = tuple(said["undefined"].get(name, none))
            scores[name] = Score(
                known[name],
                scenarios,
                tuple(frames),
                per_frame,
                _floats(values),
                undefined,
            )
        found[floor] = ReferenceScores(
            name=floor,
            scores=scores,
            seconds_per_frame=said["seconds_per_frame"],
            correlation=_floats(said["correlation"]),
        )
    return found


def solver_seconds(size: Size, folder: Path = FOLDER) -> float | None:
    """Return the processor time that a frame costs the solver itself, where the floors
    were measured [s].
    """
    held = _held(size, folder)
    if held is None:
        return None
    return held.get("solver_seconds_per_frame")


def _held(size: Size, folder: Path) -> dict[str, Any] | None:
    path = shipped_path(size, folder)
    if size.measured is None or not path.is_file():
        return None
    held: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    same = (
        held["lagbench_floors"] == FORMAT
        and held["dataset_sha256"] == size.measured.dataset_sha256
    )
    if same:
        return held
    return None


def _measured(size: Size, folder: Path) -> dict[str, Any]:
    held = _held(size, folder)
    if held is None:
        raise DataError(
            "no floors were measured on this data set",
            where=str(shipped_path(size, folder)),
        )
    return held


def _knots(frames: Sequence[int]) -> NDArray[np.intp]:
    """Return the frames at which a curve is kept, first and last included."""
    return np.rint(np.linspace(frames[0], frames[-1], min(len(frames), 100))).astype(
        np.intp
    )


def _floats(values: Sequence[float | None]) -> NDArray[np.float64]:
    return np.array([math.nan if value is None else value for value in values])


def write_shipped(
    size: Size,
    floors: Mapping[str, ReferenceScores],
    *,
    dataset_sha256: str,
    reported: Sequence[int],
    folder: Path = FOLDER,
    partial: bool = False,
) -> Path:
    """Write what the floors of a data set score, equal bytes for equal scores and
    costs.

    With ``partial`` the other floors stay as they are, and so do all costs, which
    compare only within one run on one machine.
    """
    first = next(iter(next(iter(floors.values())).scores.values()))
    said = {name: _said(floor, reported) for name, floor in floors.items()}
    kept: dict[str, Any] = {}
    if partial:
        earlier = _measured(size, folder)
        known = earlier["floors"]
        for name in said.keys() & known.keys():
            said[name]["seconds_per_frame"] = known[name]["seconds_per_frame"]
        said = {**known, **said}
        kept = {
            name: cost
            for name, cost in earlier.items()
            if name == "solver_seconds_per_frame"
        }
    held = {
        "lagbench_floors": FORMAT,
        "split": size.split,
        "size": size.name,
        "dataset_version": size.version,
        "dataset_sha256": dataset_sha256,
        "scenarios": list(first.scenarios),
        "frames": [first.frames[0], first.frames[-1]],
        "reported_frames": list(reported),
        **kept,
        "floors": said,
    }
    return _write(size, held, folder)


def write_solver_seconds(size: Size, seconds: float, folder: Path = FOLDER) -> Path:
    """Add what a frame costs the solver itself to the measured floors of a data set
    [s].
    """
    held = _measured(size, folder)
    floors = held.pop("floors")
    return _write(
        size,
        held | {"solver_seconds_per_frame": _number(seconds, 3), "floors": floors},
        folder,
    )


def _write(size: Size, held: Mapping[str, Any], folder: Path) -> Path:
    path = shipped_path(size, folder)
    write_atomically(path, f"{_spelled(held)}\n".encode(), option="--folder")
    return path


def _said(floor: ReferenceScores, reported: Sequence[int]) -> dict[str, Any]:
    scores = floor.scores
    told = {name: score for name, score in scores.items() if score.metric.per_frame}
    return {
        "seconds_per_frame": _number(floor.seconds_per_frame, 3),
        "correlation": [
            _number(value, FRAME_DIGITS) for value in floor.correlation.tolist()
        ],
        "values": {
            name: [_number(v, DIGITS) for v in s.values.tolist()]
            for name, s in scores.items()
        },
        "undefined": {
            name: list(s.undefined) for name, s in scores.items() if any(s.undefined)
        },
        "at": {
            name: [_number(_mean(s.at(f)), FRAME_DIGITS) for f in reported]
            for name, s in told.items()
        },
        "curves": {
            name: [
                _number(_mean(told[name].at(f)), CURVE_DIGITS)
                for f in _knots(told[name].frames).tolist()
            ]
            for name in CURVES
            if name in told
        },
    }


def _mean(values: NDArray[np.float64]) -> float:
    return mean(values[np.isfinite(values)])


def _number(value: float, digits: int) -> float | None:
    if math.isfinite(value):
        return round_digits(value, digits)
    return None


def _spelled(value: object, depth: int = 0) -> str:
    """Return JSON with an entry of a mapping in a line, so that a change shows where it
    is.
    """
    if not isinstance(value, dict) or not value:
        return json.dumps(value, allow_nan=False, separators=(",", ":"))
    inner = (
        f"{' ' * (depth + 1)}{json.dumps(k)}: {_spelled(v, depth + 1)}"
        for k, v in value.items()
    )
    return "{\n" + ",\n".join(inner) + f"\n{' ' * depth}}}"
