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
    """One metric of one row over the horizon."""

    mean: float  # mean over scenarios, then over seeds; NaN where undefined
    std: float  # sample standard deviation over seeds; NaN for a single seed
    low: float  # lower bound of the 95 % interval over scenarios
    high: float  # upper bound
    per_scenario: tuple[float, ...]  # mean over seeds of each scenario, in the order of Tab.scenarios
    # mean over scenarios and seeds at Tab.frames_of_interest; empty for metrics that mean
    # nothing at a single frame
    at: Mapping[int, float]
    undefined: int  # frames without a value, all scenarios and seeds together


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A metric over frames: mean over scenarios and seeds, with its band."""

    frames: tuple[int, ...]  # absolute frame numbers, at most 120, first and last included, shape [frame]
    mean: Floats  # mean over scenarios, NaN where undefined, shape [frame]
    low: Floats  # lowest scenario, shape [frame]
    high: Floats  # highest scenario, shape [frame]


@dataclass(frozen=True, kw_only=True, eq=False)
class Histogram:
    """Shares of equally wide bins."""

    low: float  # lower edge of the first bin
    high: float  # upper edge of the last bin
    shares: Floats  # share of each bin, NaN where there is no field, shape [bin]


@dataclass(frozen=True, kw_only=True, eq=False)
class Pictures:
    """What is drawn of one scenario, of the truth or of one prediction."""

    scenario: int  # id of the scenario
    map_frames: tuple[int, ...]  # absolute frames of the maps; frames of interest and the last one
    # at the compared nodes, NaN elsewhere [1/frame], shape [map frame, x node, y node]
    vorticity: NDArray[np.float32]
    histograms: tuple[Histogram, ...]  # of that vorticity over the truth's range, by map frame
    film_frames: tuple[int, ...]  # absolute frames of the film, at most 45
    material: NDArray[np.int8]  # of each film particle: 0 liquid, 1 jelly, 2 snow, 3 rope, shape [particle]
    film: NDArray[np.float32]  # positions, clipped to [-0.5, 1.5] [length], shape [film frame, particle, 2]


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a predicted frame costs."""

    seconds_per_frame: float  # of the model [s]
    device: str  # machine of both times
    solver_seconds_per_frame: float | None  # of the solver on the same machine [s]; None where not measured
    speed_up: float | None  # solver time over model time; None without the former


@dataclass(frozen=True, kw_only=True)
class RaisedFlag:
    """A flag that the scorer raised, or a warning of the validation."""

    name: str  # such as "copy_suspect"; a warning has the name of its check
    reasons: tuple[str, ...]  # why, in words


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """One predictions.nc and its score file; a row has one per seed."""

    seed: int | None  # seed of the training, None where it has none
    sha256: str  # content hash of the predicted positions, 64 hex digits
    url: str | None  # http(s) address, if there is one
    path: str | None  # path in the repository, if it lies there
    size: int | None  # length of the file [bytes], None where it is not kept
    score_file: str  # path of the score file, relative to the board's folder
    mean: float  # of the ranking metric


@dataclass(frozen=True, kw_only=True, eq=False)
class Detail:
    """What opens under a row."""

    curves: Mapping[str, Curve]  # by metric, those of Tab.curves that the row has
    energy: Curve  # predicted kinetic energy, mean over scenarios; the truth's is Tab.energy
    pictures: Pictures  # of the prediction of the first seed
    # of predicted minus true vorticity in the pictured scenario, by map frame, over the
    # range +-max abs residual
    residuals: tuple[Histogram, ...]
    command: str  # shell command that makes the predictions again
    training: str  # what the model was trained on, in words
    hardware: str  # machine of the training, in words
    notes: str  # free text, may be empty
    predictions: tuple[Prediction, ...]  # one per seed
    scored_by: str  # who ran the scorer
    lagbench_version: str  # version of the scorer


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """One method on one split and size."""

    id: str  # unique in its tab, [a-z0-9-], usable in a URL and as an HTML id
    name: str  # what the method is called
    authors: tuple[str, ...]  # who made it
    affiliation: str  # of the authors, may be empty
    licence: str  # SPDX name, such as "MIT"
    code: str | None  # http(s) address, or None
    paper: str | None  # http(s) address, or None
    date: str  # ISO date of the submission, as in "2026-11-20"
    floor: bool  # whether it is one of the scorer's own floors, which are pinned
    status: str  # "active", "superseded" or "withdrawn"; only active rows are ranked
    superseded_by: str | None  # id of the row that replaces it, or None
    reason: str  # why it was withdrawn or superseded, may be empty
    current: bool  # whether it was scored on the data set version of today; others are not ranked
    dataset_version: str  # version that it was scored on
    rank: int | None  # shared by all that cannot be told from the leader at 5 %; None where not ranked
    shared: bool  # whether another row has the same rank
    # of the sign-flip test against the leader; NaN for the leader itself and where fewer than six
    # scenarios allow no claim
    p: float
    seeds: int  # how many seeds stand behind it
    parameters: int | None  # trainable parameters, or None
    cost: Cost | None  # None where not measured
    flags: tuple[RaisedFlag, ...]  # what the scorer raised
    warnings: tuple[RaisedFlag, ...]  # what the validation warned of
    diverged: int  # scenarios whose rollout is frozen, all seeds together
    values: Mapping[str, Value]  # by metric
    detail: Detail  # what opens under the row


@dataclass(frozen=True, kw_only=True, eq=False)
class Tab:
    """One split and size."""

    split: str  # name of the split
    size: str  # name of the size
    title: str  # title of the split
    dataset_version: str  # version of today
    dataset_sha256: str  # hash of the data set of today
    particles: int  # particles in a scenario
    input_frames: int  # frames given
    frames: tuple[int, ...]  # absolute predicted frames
    frames_of_interest: tuple[int, ...]  # absolute frames that are reported, the last one included
    frame_interval: float  # time between frames [s]
    scenarios: tuple[int, ...]  # ids of the test scenarios, ascending
    ranking: str  # name of the metric that ranks
    decided: bool  # whether there are scenarios enough for a p-value; else all share rank 1
    columns: tuple[str, ...]  # names of metrics to show at first, the ranking one first
    # names of metrics that details have curves of, the ranking one or what stands for it per frame first
    curves: tuple[str, ...]
    energy: Curve  # true kinetic energy, mean over scenarios
    truth: Pictures  # pictures of the truth; those of the rows have the same scenario and frames
    rows: tuple[Row, ...]  # by rank and mean; floors, superseded and withdrawn rows included


@dataclass(frozen=True, kw_only=True, eq=False)
class Board:
    """Everything that a page draws; equal submissions give equal boards, in any file order."""

    tabs: tuple[Tab, ...]  # in the order of the registry, those without submissions left out
    # metrics that occur, by name, in the table's order: name, family, unit, direction,
    # perfect, summary, source
    metrics: Mapping[str, Metric]
