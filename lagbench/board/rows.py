"""The content of a board: a tab for each data set, a row for each method.

Every number is formed anew from score files. Reference predictors are rows as entries
are, without an entry. Undefined numbers are NaN. Text of entries comes from strangers:
it is data, never markup.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size
from lagbench.metrics.aggregate import Score
from lagbench.references.predictor import Kind
from lagbench.scoring.front import (
    FrontRow,
    NoSpeedup,
    Speedup,
    classical_hull,
    front_row,
    pays_after_holm,
)

from .entry import Entry
from .verified import Verification

Floats = NDArray[np.float64]

RESTARTED = "restarted"
"""Begins the names of the rows of the simulator that is restarted from given frames."""

TRIAL = "tiny"  # the size for trying out


UNJUDGED = (
    "There the truth is the coarse one of an older version, or no network was trained "
    "on the new one. At commit 5c959f01 the simulator, restarted from the given "
    "frames, was tried on two of them: on cylinder mini it has less error than the "
    "best entry at less cost (0.0565 at 11.6 ms a frame, best entry 0.233 at 65 "
    "ms), and on fluid-3d mini a calibrated coarse solver is a fair trade, a network "
    "is not. The hybrids fit three to five numbers, so they are calibrated solvers."
)
"""What is said of the data sets that are not judged."""


@dataclass(frozen=True, kw_only=True)
class Value:
    """A number of one row; NaN where undefined."""

    mean: float
    low: float = math.nan  # lower bound of the 95 % interval
    high: float = math.nan
    std: float = math.nan  # sample standard deviation over seeds; NaN for a single seed


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """The ranking metric over frames, mean over scenarios and seeds."""

    frames: tuple[int, ...]  # absolute numbers
    mean: Floats


@dataclass(frozen=True, kw_only=True, eq=False)
class Row:
    """One method on one split and size: an entry, or a reference predictor."""

    id: str  # of the method, [a-z0-9-]; unique in its tab
    name: str  # for readers
    kind: Kind
    entry: Entry | None  # None for a reference predictor
    verified: Verification | None
    metrics: Mapping[str, Value]
    seeds: Sequence[Score]  # ranking metric of each seed, without values per frame
    curve: Curve | None
    # processor time of a frame on the machine and in the run of the tab [s]; None where
    # it is unknown, or was measured elsewhere without our solver beside it
    seconds: float | None
    # 1 - score / score of the best naive baseline
    skill: Value | None
    shift_skill: Value | None  # skill on the subset shift, which lies outside train
    failed_gates: tuple[str, ...] = ()  # of its weights; such a row is under-trained
    speedup: Speedup | None = None
    why_no_speedup: NoSpeedup | None = None
    # scenarios after which the model was worth it; infinite for never
    breakeven: float | None = None
    rank: int | None = None  # entries that differ by less than the truth error share it
    rank_range: tuple[int, int] | None = None  # in 95 % of the resamples
    tied: bool = False  # cannot be told from the leader at 5 %

    @property
    def score(self) -> Value:
        """The ranking metric."""
        return self.metrics[self.seeds[0].metric.name]

    @property
    def flags(self) -> tuple[str, ...]:
        """Names of the flags that the scorer raised for any seed."""
        return () if self.entry is None else self.entry.flags

    @property
    def diverged(self) -> int:
        """Scenarios whose rollout is frozen, all seeds together."""
        if self.entry is None:
            return 0
        return sum(len(file.diverged_at) for file in self.entry.score.files)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tab:
    """One split and size: its active entries and its reference predictors."""

    size: Size
    title: str  # of the split
    ranking: str  # name of the metric that ranks
    scenarios: tuple[int, ...]  # ids of the test scenarios, ascending
    rows: tuple[Row, ...]  # by the ranking metric, best first
    # processor time of a frame of the solver that made the data [s]
    solver_seconds: float | None

    @property
    def id(self) -> str:
        """Name in addresses."""
        return f"{self.size.split}-{self.size.name}"

    @property
    def name(self) -> str:
        """Split and size."""
        return f"{self.size.split} {self.size.name}"

    @property
    def truth_error(self) -> float | None:
        """Ranking metric between the truth and a run of twice its refinement."""
        return self.size.truth_error

    @property
    def front_rows(self) -> list[FrontRow]:
        """The rows as the front takes them."""
        return [
            front_row(
                name=row.id,
                kind=row.kind,
                seconds=row.seconds,
                seeds=row.seeds,
                scenarios=self.scenarios,
            )
            for row in self.rows
        ]

    @property
    def hull(self) -> list[FrontRow]:
        """Corners of the classical side's hull, the cheapest row first."""
        return classical_hull(self.front_rows)

    @property
    def is_judged(self) -> bool:
        """Whether the restarted simulator stands on the classical side."""
        return any(row.id.startswith(RESTARTED) for row in self.rows)

    @property
    def models(self) -> list[Row]:
        """Active entries with a network that passed their gates, best first."""
        rows = []
        for row in self.rows:
            if row.kind.has_network and row.rank and not row.failed_gates:
                rows.append(row)
        return rows

    @property
    def best_model(self) -> Row | None:
        """The model of the greatest speedup, which decides whether learning pays."""
        best = None
        greatest = 0.0
        for row in self.models:
            if row.speedup is not None and row.speedup.value > greatest:
                best = row
                greatest = row.speedup.value
        return best


@dataclass(frozen=True, kw_only=True, eq=False)
class Board:
    """All tabs, in the order of the registry."""

    tabs: tuple[Tab, ...]

    def pays(self) -> list[Tab]:
        """Return the tabs where learning pays, corrected by Holm for their number."""
        speedups = {}
        for tab in self.tabs:
            best = tab.best_model
            if not tab.is_judged or best is None or best.speedup is None:
                continue
            if not math.isnan(best.speedup.p):
                speedups[tab.id] = best.speedup
        names = pays_after_holm(speedups)
        return [tab for tab in self.tabs if tab.id in names]


def conclude(board: Board) -> list[str]:
    """Return the sentences that begin the page: on how many data sets learning pays.

    A data set counts if the restarted simulator stands on its classical side and a
    model with a network has a known speedup.
    """
    judged = []
    for tab in board.tabs:
        if tab.size.name != TRIAL and tab.is_judged and tab.best_model is not None:
            judged.append(tab)
    open_count = sum(tab.size.name != TRIAL for tab in board.tabs) - len(judged)
    pays = [tab for tab in board.pays() if tab in judged]
    total = len(judged)
    if not judged:
        result = "It is not shown on any data set that learning pays."
    elif pays:
        names = ", ".join(tab.name for tab in pays)
        result = (
            f"Learning pays on {len(pays)} of {total} data sets ({names}): there a "
            "network reaches its accuracy in less time than any classical or "
            "calibrated solver here."
        )
    else:
        result = (
            f"It is not shown that learning pays on any of {total} judged data sets: "
            "on each a classical or calibrated solver is as accurate as the best "
            "network in the same time or less, or the difference is within the 95 % "
            "interval or the noise of measured times."
        )
    if not open_count:
        return [result]
    return [
        result,
        f"{open_count} data sets are not judged: they lack a model with a known "
        f"speedup, or the restarted simulator. {UNJUDGED}",
    ]
