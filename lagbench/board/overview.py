"""The methods of a board over all data sets of a size, and what the board concludes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lagbench.figures.numbers import text
from lagbench.metrics.significance import rank_ranges
from lagbench.references.predictor import Kind

from .model import Board, BoardRow, Floats, ReferenceRow, Tab, Value

FINDING = (
    "It is not shown on any data set that learning pays.",
    "The truth and the classical rows of version 3 of the data are too weak for that. "
    "The simulator itself, restarted from the given frames, is not among the rows: on "
    "three of the five data sets on which it was tried it has less error than the best "
    "entry at less cost (fluid mini: 0.0102 at 0.83 ms a frame, best entry 0.0245 at "
    "1.31 ms; cavity mini: 0.0085 at 4.86 ms, best entry 0.0441 at 12.4 ms; cylinder "
    "mini: 0.0565 at 11.6 ms, best entry 0.233 at 65 ms), on curl-noise mini it equals "
    "the best entry at half the cost, and on fluid-3d mini a calibrated coarse solver "
    "is a fair trade, a network is not. The hybrids fit three to five numbers, so they "
    "are calibrated solvers. On cavity mini a converged solution of the stated "
    "equations has an error of 0.062 against the truth, more than the best entry: "
    "smaller differences mean nothing. Version 4 of the data mends both.",
)
"""What the numbers of the board show about learning: a statement and its reasons.

A referee measured the figures on commit 5c959f01 with solvers of their own.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class MethodOverview:
    """A method, or a variant of one, on the data sets of a size."""

    method: str
    rows: Mapping[str, BoardRow]  # active rows by id of the tab
    mean_skill: float  # over the data sets with a skill; NaN without any
    missing: tuple[str, ...]  # splits that it did not run
    rank: int | None = None  # by mean skill; None where a data set is missing
    # best and worst rank in 95 % of the resamples; None where nothing is claimed
    rank_range: tuple[int, int] | None = None
    variants: tuple[MethodOverview, ...] = ()

    @property
    def first_row(self) -> BoardRow:
        """The row on the first data set."""
        return next(iter(self.rows.values()))

    @property
    def name(self) -> str:
        """Name of the method."""
        return self.first_row.entry.name

    @property
    def kind(self) -> Kind:
        """Whether it learns."""
        return self.first_row.entry.kind


@dataclass(frozen=True, kw_only=True, eq=False)
class SizeOverview:
    """All methods on the data sets of one size."""

    size: str
    tabs: tuple[Tab, ...]
    # those with a place by mean skill; behind them those that did not run everything
    methods: tuple[MethodOverview, ...]

    @property
    def has_places(self) -> bool:
        """Whether any method has a place."""
        return any(method.rank is not None for method in self.methods)


def make_overviews(board: Board) -> tuple[SizeOverview, ...]:
    """Return an overview of each size that the board has.

    Sizes at which a method has a place come first.
    """
    tabs_by_size: dict[str, list[Tab]] = {}
    for tab in board.tabs:
        tabs_by_size.setdefault(tab.size.name, []).append(tab)
    overviews = []
    for size, tabs in tabs_by_size.items():
        methods = _order_methods(_collect_methods(tabs), tabs)
        overviews.append(
            SizeOverview(size=size, tabs=tuple(tabs), methods=tuple(methods))
        )
    overviews.sort(key=lambda overview: not overview.has_places)
    return tuple(overviews)


def _collect_methods(tabs: Sequence[Tab]) -> list[MethodOverview]:
    """Return the methods of some tabs with their variants, in no order.

    An entry that is a variant on one data set has the line of a variant, also where it
    stands alone on another.
    """
    rows_by_entry: dict[str, dict[str, BoardRow]] = {}
    for tab in tabs:
        for row in tab.rows:
            is_variant = row.variant_of is not None and row.active
            if is_variant or row.rank is not None:
                rows_by_entry.setdefault(row.id, {})[tab.id] = row

    method_of_variant = _find_methods_of_variants(tabs)
    variants: dict[str, list[MethodOverview]] = {}
    for variant, method in method_of_variant.items():
        overview = _make_overview(variant, rows_by_entry[variant], tabs)
        variants.setdefault(method, []).append(overview)

    methods = []
    for method, rows in rows_by_entry.items():
        if method in method_of_variant:
            continue
        variants_of_method = sorted(variants.get(method, []), key=_order)
        methods.append(
            _make_overview(method, rows, tabs, variants=tuple(variants_of_method))
        )
    return methods


def _find_methods_of_variants(tabs: Sequence[Tab]) -> dict[str, str]:
    """Return the method of each entry that is a variant on some data set, by ids.

    No method in the result is a variant itself. Where two entries are variants of each
    other, each on one data set, the first data set decides.
    """
    parents: dict[str, str] = {}
    for tab in tabs:
        for row in tab.rows:
            if row.variant_of is None or not row.active or row.id in parents:
                continue
            method = _follow(parents, row.variant_of)
            if method != row.id:
                parents[row.id] = method
    return {variant: _follow(parents, variant) for variant in parents}


def _follow(parents: Mapping[str, str], entry: str) -> str:
    """Return the last one of a chain of entries."""
    while entry in parents:
        entry = parents[entry]
    return entry


def _make_overview(
    method: str,
    rows: Mapping[str, BoardRow],
    tabs: Sequence[Tab],
    *,
    variants: tuple[MethodOverview, ...] = (),
) -> MethodOverview:
    skills = []
    missing = []
    for tab in tabs:
        row = rows.get(tab.id)
        if row is None:
            missing.append(tab.size.split)
        elif row.skill is not None and math.isfinite(row.skill.mean):
            skills.append(row.skill.mean)
    mean_skill = math.nan
    if skills:
        mean_skill = math.fsum(skills) / len(skills)
    return MethodOverview(
        method=method,
        rows=rows,
        mean_skill=mean_skill,
        missing=tuple(missing),
        variants=variants,
    )


def _order(method: MethodOverview) -> tuple[int, bool, float, str]:
    """Return the key by which methods are sorted: complete ones by mean skill first."""
    has_none = math.isnan(method.mean_skill)
    loss = math.inf if has_none else -method.mean_skill
    return len(method.missing), has_none, loss, method.method


def _order_methods(
    methods: Sequence[MethodOverview], tabs: Sequence[Tab]
) -> list[MethodOverview]:
    """Return methods in order; those that ran everything have ranks."""
    complete = []
    for method in methods:
        if not method.missing and not math.isnan(method.mean_skill):
            complete.append(method)
    losses = {}
    for method in complete:
        relative_losses = _relative_losses(method, tabs)
        if relative_losses is not None:
            losses[method.method] = relative_losses
    ranges = {}
    if len(losses) == len(complete):
        ranges = rank_ranges(losses)

    ordered = []
    rank = 0
    complete_ids = {method.method for method in complete}
    for method in sorted(methods, key=_order):
        place = None
        if method.method in complete_ids:
            rank += 1
            place = rank
        ordered.append(
            MethodOverview(
                method=method.method,
                rows=method.rows,
                mean_skill=method.mean_skill,
                missing=method.missing,
                rank=place,
                rank_range=ranges.get(method.method),
                variants=method.variants,
            )
        )
    return ordered


def _relative_losses(
    method: MethodOverview, tabs: Sequence[Tab]
) -> list[Floats] | None:
    """Return the scores over those of the best naive baseline, by data set.

    Their means order methods as their mean skills do. None where a score is missing.
    """
    losses = []
    for tab in tabs:
        row = method.rows[tab.id]
        if row.losses is None or tab.best_naive is None:
            return None
        losses.append(row.losses / tab.best_naive)
    return losses


def _error_of(row: BoardRow | ReferenceRow, tab: Tab) -> float:
    """Return the mean of the ranking metric; infinite where there is none."""
    if tab.ranking not in row.values or math.isnan(row.values[tab.ranking].mean):
        return math.inf
    return row.values[tab.ranking].mean


def is_open(ratio: Value) -> bool:
    """Tell whether the interval of a ratio contains 1, or is missing."""
    return not (ratio.high < 1.0 or ratio.low > 1.0)


def join_names(names: Sequence[str]) -> str:
    """Return names in words.

    >>> join_names(["cavity", "fluid", "cylinder"])
    'cavity, fluid and cylinder'
    """
    if len(names) == 1:
        return names[0]
    return f"{', '.join(names[:-1])} and {names[-1]}"


def summarise(overview: SizeOverview) -> list[str]:
    """Return the data sets without skill, and who leads over all of a size."""
    sentences = []
    without_skill = _find_data_sets_without_skill(overview)
    if without_skill:
        sentences.append(
            f"No entry has a skill above 0 on {join_names(without_skill)}: the best "
            "naive baseline has less error than every entry."
        )
    sentences.append(_name_leader(overview))
    return sentences


def _find_data_sets_without_skill(overview: SizeOverview) -> list[str]:
    """Return the splits with entries of a known skill, none of them above 0."""
    splits = []
    for tab in overview.tabs:
        skills = []
        for row in tab.rows:
            if row.active and row.skill is not None:
                skills.append(row.skill.mean)
        if skills and max(skills) <= 0.0:
            splits.append(tab.size.split)
    return splits


def _name_leader(overview: SizeOverview) -> str:
    """Return who leads over all data sets of a size, and by how much."""
    ranked = []
    for method in overview.methods:
        if method.rank is not None:
            ranked.append(method)
    data_sets = count_data_sets(overview)
    if not ranked:
        return f"No method was run on {data_sets} of size {overview.size}."
    leader = ranked[0]
    skill = text(leader.mean_skill)
    if len(ranked) == 1:
        return (
            f"{leader.name} is the only method that was run on {data_sets}. Its mean "
            f"skill is {skill}."
        )
    second = ranked[1]
    sentence = (
        f"{leader.name} has the greatest mean skill over {data_sets}: {skill}. Next is "
        f"{second.name} with {text(second.mean_skill)}."
    )
    if leader.rank_range is not None and leader.rank_range[1] > 1:
        sentence += (
            f" When the scenarios are drawn again, {leader.name} has rank "
            f"{leader.rank_range[0]} to {leader.rank_range[1]} (95 %)."
        )
    return sentence


def count_data_sets(overview: SizeOverview) -> str:
    """Return how many data sets a size has, in words."""
    count = len(overview.tabs)
    return "the only data set" if count == 1 else f"all {count} data sets"


def find_hero(overviews: Sequence[SizeOverview]) -> tuple[Tab, BoardRow] | None:
    """Return the data set whose film stands first, and the row of it.

    The film is of the first method of the first table that has a film; there data sets
    with skill come first, then those with the most materials.
    """
    for overview in overviews:
        for method in overview.methods:
            film = _find_film(method, overview.tabs)
            if film is not None:
                return film
    return None


def _find_film(
    method: MethodOverview, tabs: Sequence[Tab]
) -> tuple[Tab, BoardRow] | None:
    """Return the film of a method."""
    films = []
    for tab in tabs:
        if tab.id in method.rows:
            films.append((tab, method.rows[tab.id]))
    return _choose_film(films)


def _choose_film(films: Sequence[tuple[Tab, BoardRow]]) -> tuple[Tab, BoardRow] | None:
    """Return the row with pictures that has skill, most materials, then most skill."""
    best: tuple[Tab, BoardRow] | None = None
    most = (False, 0, -math.inf)
    for tab, row in films:
        if row.pictures is None or tab.truth is None:
            continue
        materials = len(set(tab.truth.material.tolist()))
        skill = -math.inf
        if row.skill is not None and math.isfinite(row.skill.mean):
            skill = row.skill.mean
        merit = (skill > 0.0, materials, skill)
        if best is None or merit > most:
            most = merit
            best = tab, row
    return best
