"""The methods of a board over all data sets of a size, and what the board concludes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lagbench.figures.html import text
from lagbench.metrics.significance import rank_ranges
from lagbench.references.predictor import Kind

from .model import Board, BoardRow, Floats, Tab

LEARNS = (Kind.LEARNED, Kind.HYBRID)
"""Kinds of entries of which the board asks whether learning pays."""


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


def make_overviews(board: Board) -> tuple[SizeOverview, ...]:
    """Return an overview of each size that the board has."""
    tabs_by_size: dict[str, list[Tab]] = {}
    for tab in board.tabs:
        tabs_by_size.setdefault(tab.size.name, []).append(tab)
    overviews = []
    for size, tabs in tabs_by_size.items():
        methods = _order_methods(_collect_methods(tabs), tabs)
        overviews.append(
            SizeOverview(size=size, tabs=tuple(tabs), methods=tuple(methods))
        )
    return tuple(overviews)


def _collect_methods(tabs: Sequence[Tab]) -> list[MethodOverview]:
    """Return the methods of some tabs with their variants, in no order."""
    rows_by_method: dict[str, dict[str, BoardRow]] = {}
    variant_rows: dict[str, dict[str, dict[str, BoardRow]]] = {}
    for tab in tabs:
        for row in tab.rows:
            if row.variant_of is not None and row.active:
                variants = variant_rows.setdefault(row.variant_of, {})
                variants.setdefault(row.id, {})[tab.id] = row
            elif row.rank is not None:
                rows_by_method.setdefault(row.id, {})[tab.id] = row

    methods = []
    for method, rows in rows_by_method.items():
        variants_of_method = []
        for variant, rows_of_variant in variant_rows.get(method, {}).items():
            variants_of_method.append(_make_overview(variant, rows_of_variant, tabs))
        variants_of_method.sort(key=_order)
        methods.append(
            _make_overview(method, rows, tabs, variants=tuple(variants_of_method))
        )
    return methods


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
        mean_skill = sum(skills) / len(skills)
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


def conclude(tab: Tab) -> str:
    """Return the sentence about whether learning pays; empty where nothing tells.

    It speaks of all active entries that learn, variants too.
    """
    best = None
    for row in tab.rows:
        ratio = row.against_classical
        if not row.active or row.entry.kind not in LEARNS or ratio is None:
            continue
        least = math.inf
        if best is not None and best.against_classical is not None:
            least = best.against_classical.mean
        if ratio.mean < least:
            best = row
    name = f"{tab.size.split} {tab.size.name}"
    if best is None or best.against_classical is None:
        return ""
    ratio = best.against_classical
    measure = f"{text(ratio.mean, 2)}× the error of {best.solver}"
    if ratio.low > 1.0:
        return (
            f"Learning does not pay on {name}: no learned entry is more accurate than "
            "the best classical solver that costs no more per frame (nearest: "
            f"{best.entry.name}, {measure})."
        )
    if ratio.high >= 1.0:
        return (
            f"Whether learning pays on {name} is open: {best.entry.name} has "
            f"{measure}, the best classical solver that costs no more per frame, and "
            "the interval contains 1."
        )
    return (
        f"Learning pays on {name}: {best.entry.name} has {measure}, the best classical "
        "solver that costs no more per frame."
    )


def summarise(overview: SizeOverview) -> str:
    """Return who leads over all data sets, and by how much; empty without a leader."""
    ranked = []
    for method in overview.methods:
        if method.rank is not None:
            ranked.append(method)
    if not ranked:
        return ""
    leader = ranked[0]
    sentence = (
        f"{leader.name} leads over {_count_sets(len(overview.tabs))} with a mean skill "
        f"of {text(leader.mean_skill)}"
    )
    if len(ranked) > 1:
        second = ranked[1]
        sentence += f"; next is {second.name} with {text(second.mean_skill)}"
    return f"{sentence}."


def _count_sets(count: int) -> str:
    if count == 1:
        return "1 data set"
    return f"{count} data sets"


def find_hero(board: Board) -> tuple[Tab, BoardRow] | None:
    """Return the data set whose film stands first, and its best entry.

    Data sets whose best entry has skill come first, then those with the most materials,
    then those with the most skill. Variants count.
    """
    best: tuple[Tab, BoardRow] | None = None
    most = (False, 0, -math.inf)
    for tab in board.tabs:
        row = _find_best(tab)
        if row is None or tab.truth is None:
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


def _find_best(tab: Tab) -> BoardRow | None:
    """Return the active row with the least error that has pictures."""
    best = None
    least = math.inf
    for row in tab.rows:
        if not row.active or row.pictures is None or tab.ranking not in row.values:
            continue
        error = row.values[tab.ranking].mean
        if best is None or error < least:
            best = row
            least = error
    return best
