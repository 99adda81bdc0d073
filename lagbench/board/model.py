"""The content of a board: tabs and rows, every number formed from score files.

Plain values only, so that a page, a table in the terminal and a test read the same
thing. Undefined numbers are NaN. Text of entries comes from strangers: it is data,
never markup.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size
from lagbench.metrics.metric import Metric
from lagbench.references.predictor import Kind

from .entry import Entry, EntryCost, EntryFlag, MeasuredCost, Status, Verification

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Value:
    """One metric of one row over the horizon."""

    mean: float  # mean over scenarios, then over seeds; NaN where undefined
    std: float  # sample standard deviation over seeds; NaN for a single seed
    low: float  # lower bound of the 95 % interval
    high: float
    per_scenario: tuple[float, ...]  # mean over seeds, in the order of Tab.scenarios
    # mean at Tab.marked; empty for metrics that mean nothing at one frame
    at: Mapping[int, float]
    undefined: int  # frames without a value, all scenarios and seeds together


@dataclass(frozen=True, kw_only=True, eq=False)
class Curve:
    """A metric over frames: mean over scenarios and seeds, with its band; NaN where
    undefined.
    """

    frames: tuple[int, ...]  # absolute numbers, at most 120, first and last included
    mean: Floats
    low: Floats  # lowest scenario
    high: Floats  # highest scenario


@dataclass(frozen=True, kw_only=True, eq=False)
class Histogram:
    """Shares of equally wide bins from low to high, NaN where there is no field."""

    low: float
    high: float
    shares: Floats


@dataclass(frozen=True, kw_only=True, eq=False)
class Pictures:
    """Maps and film of one scenario, of the truth or of one prediction."""

    scenario: int
    map_frames: tuple[int, ...]  # frames of interest and the last one
    # [1/frame], NaN elsewhere, shape [map frame, x node, y node]
    vorticity: NDArray[np.float32]
    histograms: tuple[Histogram, ...]  # of it over the truth's range, by map frame
    film_frames: tuple[int, ...]
    # of each film particle: 0 liquid, 1 jelly, 2 snow, 3 rope
    material: NDArray[np.int8]
    # positions in [-0.5, 1.5] [length], shape [film frame, particle, 2]
    film: NDArray[np.float32]
    # x, y and radius of a fixed obstacle in the film [length]; None without one
    obstacle: tuple[float, float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class OnShift:
    """A row on the subset ``shift``, which lies outside train on purpose."""

    score: Value  # ranking metric
    # 1 - score / score of the best naive baseline there; None without one
    skill: Value | None


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceRow:
    """A reference predictor: it learns nothing and is never ranked."""

    name: str
    definition: str
    values: Mapping[str, Value]
    curves: Mapping[str, Curve]
    energy: Curve | None
    kind: Kind  # naive or classical
    # 1 - score / score of the best naive baseline; 0 for that one itself
    skill: Value | None = None
    # cost of a frame, and that of the solver: in the run of the tab, or where the
    # reference predictors were timed
    cost: EntryCost | None = None
    on_shift: OnShift | None = None

    @property
    def is_slow(self) -> bool:
        """Whether it is a solver that costs more than the simulator of the data."""
        speed_up = None if self.cost is None else self.cost.speed_up
        return self.kind is Kind.CLASSICAL and speed_up is not None and speed_up < 1.0


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardRow:
    """One method on one split and size."""

    entry: Entry
    current: bool  # scored on the data set version of today; others are not ranked
    # in the order of the ranking metric; None for variants and where not ranked
    rank: int | None
    tied: bool  # cannot be told from the leader at 5 %
    # against the leader, corrected by Holm; NaN for the leader and without a claim
    p: float
    verified: Verification | None  # the maintainers scored these predictions again
    # 1 - score / score of the best naive baseline, where the score files say it
    skill: Value | None
    # score / score of the best classical solver that costs no more per frame, or of
    # the cheapest one where all cost more; None where no cost is stated
    against_classical: Value | None
    solver: str | None  # name of that classical solver
    values: Mapping[str, Value]
    seed_means: tuple[float, ...]  # mean of the ranking metric of each seed
    curves: Mapping[str, Curve]
    energy: Curve  # predicted kinetic energy; the truth's is Tab.energy
    pictures: Pictures | None  # of the prediction of the first seed; None if not read
    residuals: tuple[Histogram, ...]  # of predicted minus true vorticity, by map frame
    # best and worst rank in 95 % of the resamples; None where nothing is claimed
    rank_range: tuple[int, int] | None = None
    variant_of: str | None = None  # id of the method that the row is a variant of
    failed_gates: tuple[str, ...] = ()  # of its weights; such a row is under-trained
    on_shift: OnShift | None = None  # of the seeds whose models lie on the board
    # ranking metric, NaN where undefined, shape [seed, scenario]
    losses: Floats | None = None
    # whether every classical solver costs more per frame; False where a cost is unknown
    solver_costs_more: bool = False

    @property
    def id(self) -> str:
        """Name in addresses, unique in its tab: ``[a-z0-9-]``."""
        return self.entry.method

    @property
    def active(self) -> bool:
        """Whether it takes part in the ranking."""
        return self.entry.status is Status.ACTIVE and self.current

    @property
    def flags(self) -> tuple[EntryFlag, ...]:
        """Flags that the scorer raised for any seed."""
        return _merge_flags([file.flags for file in self.entry.score.files])

    @property
    def warnings(self) -> tuple[EntryFlag, ...]:
        """Warnings of the validation for any seed."""
        return _merge_flags([file.warnings for file in self.entry.score.files])

    @property
    def diverged(self) -> int:
        """Scenarios whose rollout is frozen, all seeds together."""
        return sum(len(file.diverged_at) for file in self.entry.score.files)


def _merge_flags(
    flags_of_seeds: Sequence[Sequence[EntryFlag]],
) -> tuple[EntryFlag, ...]:
    """Return each flag once, with all reasons of the seeds and the greatest share."""
    reasons: dict[str, dict[str, None]] = {}
    shares: dict[str, float | None] = {}
    for flags in flags_of_seeds:
        for flag in flags:
            reasons.setdefault(flag.name, {}).update(dict.fromkeys(flag.reasons))
            share = shares.setdefault(flag.name, flag.share)
            if flag.share is not None and (share is None or flag.share > share):
                shares[flag.name] = flag.share

    merged = []
    for name in reasons:
        # names and reasons were checked when the entries were read
        flag = EntryFlag.model_construct(
            name=name, reasons=tuple(reasons[name]), share=shares[name]
        )
        merged.append(flag)
    return tuple(merged)


@dataclass(frozen=True, kw_only=True, eq=False)
class Tab:
    """One split and size with at least one learned entry."""

    size: Size
    title: str  # of the split
    scenarios: tuple[int, ...]  # ids of the test scenarios, ascending
    frames: tuple[int, ...]  # absolute predicted frames
    marked: tuple[int, ...]  # absolute frames that are reported, the last one included
    ranking: str  # name of the metric that ranks
    decided: bool  # whether there are scenarios enough for a p-value
    columns: tuple[str, ...]  # names of metrics to show at first, the ranking one first
    # names of metrics with curves, the ranking one or what stands for it first
    curves: tuple[str, ...]
    energy: Curve  # true kinetic energy
    # those of the rows have the same scenario and frames; None if not read
    truth: Pictures | None
    rows: tuple[BoardRow, ...]  # ranked ones by rank, then the others
    references: tuple[ReferenceRow, ...]
    # the run in which all active entries that we measured were measured, by the cost of
    # one of them; None if there is no such run
    run: MeasuredCost | None = None
    # processor time of a frame of the solver itself, in the run or where the reference
    # predictors were timed [s]
    solver_seconds: float | None = None
    # methods from the first on that have pictures; None where all rows have them
    pictured: int | None = None

    @property
    def id(self) -> str:
        """Name in addresses."""
        return f"{self.size.split}-{self.size.name}"

    @property
    def best_naive(self) -> float | None:
        """Score of the best naive baseline in the ranking metric; None without one."""
        means = []
        for row in self.references:
            if row.kind is Kind.NAIVE and self.ranking in row.values:
                mean = row.values[self.ranking].mean
                if mean > 0.0:
                    means.append(mean)
        return min(means, default=None)

    def variants_of(self, row: BoardRow) -> tuple[BoardRow, ...]:
        """Return the variants of a method, in the order of the rows."""
        variants = []
        for other in self.rows:
            if other.variant_of == row.id:
                variants.append(other)
        return tuple(variants)

    @property
    def lines(self) -> tuple[BoardRow | ReferenceRow, ...]:
        """All rows of the table."""
        return (*self.rows, *self.references)


@dataclass(frozen=True, kw_only=True, eq=False)
class Board:
    """Everything that a page draws.

    Equal submissions give equal boards, in any order of the files.
    """

    tabs: tuple[Tab, ...]  # in the order of the registry
    # splits and sizes that have no learned entry yet
    empty: tuple[tuple[str, str], ...]
    metrics: Mapping[str, Metric]  # those that occur, in the table's order
