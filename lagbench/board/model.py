"""What a board shows: tabs, rows and details, every number formed from score files.

Plain values only, so that a page, a table in the terminal and a test read the same thing.
Undefined numbers are NaN. Text of rows comes from strangers: it is data, never markup.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics import Metric

__all__ = [
    "Board",
    "Cost",
    "Curve",
    "Detail",
    "Histogram",
    "Pictures",
    "Prediction",
    "RaisedFlag",
    "Row",
    "Tab",
    "Value",
]

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Value:
    """One metric of one row over the horizon.

    Attributes:
        mean: mean over scenarios, then over seeds; NaN where undefined.
        std: sample standard deviation over seeds; NaN for a single seed.
        low: lower bound of the 95 % interval over scenarios.
        high: upper bound.
        per_scenario: mean over seeds of each scenario, in the order of ``Tab.scenarios``.
        at: mean over scenarios and seeds at ``Tab.frames_of_interest``; empty for metrics that
            mean nothing at a single frame.
        undefined: frames without a value, all scenarios and seeds together.
    """

    mean: float
    std: float
    low: float
    high: float
    per_scenario: tuple[float, ...]
    at: Mapping[int, float]
    undefined: int


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A metric over frames: mean over scenarios and seeds, with its band.

    Attributes:
        frames: absolute frame numbers, at most 120, first and last included, shape [frame].
        mean: mean over scenarios, NaN where undefined, shape [frame].
        low: lowest scenario, shape [frame].
        high: highest scenario, shape [frame].
    """

    frames: tuple[int, ...]
    mean: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True, kw_only=True, eq=False)
class Histogram:
    """Shares of equally wide bins.

    Attributes:
        low: lower edge of the first bin.
        high: upper edge of the last bin.
        shares: share of each bin, NaN where there is no field, shape [bin].
    """

    low: float
    high: float
    shares: Floats


@dataclass(frozen=True, kw_only=True, eq=False)
class Pictures:
    """What is drawn of one scenario, of the truth or of one prediction.

    Attributes:
        scenario: id of the scenario.
        map_frames: absolute frames of the maps; frames of interest and the last one.
        vorticity: at the compared nodes, NaN elsewhere [1/frame], shape [map frame, x node,
            y node].
        histograms: of that vorticity over the truth's range, by map frame.
        film_frames: absolute frames of the film, at most 45.
        material: of each film particle: 0 liquid, 1 jelly, 2 snow, 3 rope, shape [particle].
        film: positions, clipped to [-0.5, 1.5] [length], shape [film frame, particle, 2].
    """

    scenario: int
    map_frames: tuple[int, ...]
    vorticity: NDArray[np.float32]
    histograms: tuple[Histogram, ...]
    film_frames: tuple[int, ...]
    material: NDArray[np.int8]
    film: NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a predicted frame costs.

    Attributes:
        seconds_per_frame: of the model [s].
        device: machine of both times.
        solver_seconds_per_frame: of the solver on the same machine [s]; None where not measured.
        speed_up: solver time over model time; None without the former.
    """

    seconds_per_frame: float
    device: str
    solver_seconds_per_frame: float | None
    speed_up: float | None


@dataclass(frozen=True, kw_only=True)
class RaisedFlag:
    """A flag that the scorer raised, or a warning of the validation.

    Attributes:
        name: such as "copy_suspect"; a warning has the name of its check.
        reasons: why, in words.
    """

    name: str
    reasons: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """One predictions.nc and its score file; a row has one per seed.

    Attributes:
        seed: seed of the training, None where it has none.
        sha256: content hash of the predicted positions, 64 hex digits.
        url: http(s) address, if there is one.
        path: path in the repository, if it lies there.
        size: length of the file [bytes], None where it is not kept.
        score_file: path of the score file, relative to the board's folder.
        mean: of the ranking metric.
    """

    seed: int | None
    sha256: str
    url: str | None
    path: str | None
    size: int | None
    score_file: str
    mean: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Detail:
    """What opens under a row.

    Attributes:
        curves: by metric, those of ``Tab.curves`` that the row has.
        energy: predicted kinetic energy, mean over scenarios; the truth's is ``Tab.energy``.
        pictures: of the prediction of the first seed.
        residuals: of predicted minus true vorticity in the pictured scenario, by map frame,
            over the range +-max abs residual.
        command: shell command that makes the predictions again.
        training: what the model was trained on, in words.
        hardware: machine of the training, in words.
        notes: free text, may be empty.
        predictions: one per seed.
        scored_by: who ran the scorer.
        lagbench_version: version of the scorer.
    """

    curves: Mapping[str, Curve]
    energy: Curve
    pictures: Pictures
    residuals: tuple[Histogram, ...]
    command: str
    training: str
    hardware: str
    notes: str
    predictions: tuple[Prediction, ...]
    scored_by: str
    lagbench_version: str


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """One method on one split and size.

    Attributes:
        id: unique in its tab, ``[a-z0-9-]``, usable in a URL and as an HTML id.
        name: what the method is called.
        authors: who made it.
        affiliation: of the authors, may be empty.
        licence: SPDX name, such as "MIT".
        code: http(s) address, or None.
        paper: http(s) address, or None.
        date: ISO date of the submission, as in "2026-11-20".
        floor: whether it is one of the scorer's own floors, which are pinned.
        status: "active", "superseded" or "withdrawn"; only active rows are ranked.
        superseded_by: id of the row that replaces it, or None.
        reason: why it was withdrawn or superseded, may be empty.
        current: whether it was scored on the data set version of today; others are not ranked.
        dataset_version: version that it was scored on.
        rank: shared by all that cannot be told from the leader at 5 %; None where not ranked.
        shared: whether another row has the same rank.
        p: of the sign-flip test against the leader; NaN for the leader itself and where fewer
            than six scenarios allow no claim.
        seeds: how many seeds stand behind it.
        parameters: trainable parameters, or None.
        cost: None where not measured.
        flags: what the scorer raised.
        warnings: what the validation warned of.
        diverged: scenarios whose rollout is frozen, all seeds together.
        values: by metric.
        detail: what opens under the row.
    """

    id: str
    name: str
    authors: tuple[str, ...]
    affiliation: str
    licence: str
    code: str | None
    paper: str | None
    date: str
    floor: bool
    status: str
    superseded_by: str | None
    reason: str
    current: bool
    dataset_version: str
    rank: int | None
    shared: bool
    p: float
    seeds: int
    parameters: int | None
    cost: Cost | None
    flags: tuple[RaisedFlag, ...]
    warnings: tuple[RaisedFlag, ...]
    diverged: int
    values: Mapping[str, Value]
    detail: Detail


@dataclass(frozen=True, kw_only=True, eq=False)
class Tab:
    """One split and size.

    Attributes:
        split: name of the split.
        size: name of the size.
        title: title of the split.
        dataset_version: version of today.
        dataset_sha256: hash of the data set of today.
        particles: particles in a scenario.
        input_frames: frames given.
        frames: absolute predicted frames.
        frames_of_interest: absolute frames that are reported, the last one included.
        frame_interval: time between frames [s].
        scenarios: ids of the test scenarios, ascending.
        ranking: name of the metric that ranks.
        decided: whether there are scenarios enough for a p-value; else all share rank 1.
        columns: names of metrics to show at first, the ranking one first.
        curves: names of metrics that details have curves of, the ranking one or what stands
            for it per frame first.
        energy: true kinetic energy, mean over scenarios.
        truth: pictures of the truth; those of the rows have the same scenario and frames.
        rows: by rank and mean; floors, superseded and withdrawn rows included.
    """

    split: str
    size: str
    title: str
    dataset_version: str
    dataset_sha256: str
    particles: int
    input_frames: int
    frames: tuple[int, ...]
    frames_of_interest: tuple[int, ...]
    frame_interval: float
    scenarios: tuple[int, ...]
    ranking: str
    decided: bool
    columns: tuple[str, ...]
    curves: tuple[str, ...]
    energy: Curve
    truth: Pictures
    rows: tuple[Row, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Board:
    """Everything that a page draws; equal submissions give equal boards, in any file order.

    Attributes:
        tabs: in the order of the registry, those without submissions left out.
        metrics: metrics that occur, by name, in the table's order: name, family, unit,
            direction, perfect, summary, source.
    """

    tabs: tuple[Tab, ...]
    metrics: Mapping[str, Metric]
