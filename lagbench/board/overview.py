"""The methods of a board over all data sets of a size, and what the board concludes."""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lagbench.data.checksums import round_digits
from lagbench.figures.html import text
from lagbench.metrics.significance import rank_ranges
from lagbench.references.predictor import Kind

from .columns import SOLVER_COSTS_MORE, cost_of
from .model import Board, BoardRow, Floats, ReferenceRow, Tab, Value

LEARNS = (Kind.LEARNED, Kind.HYBRID)
"""Kinds of entries of which the board asks whether learning pays."""

RATIO_DIGITS = 2
"""Digits of a ratio in sentences and in the tables of a size."""


class LearningVerdict(enum.Enum):
    """Whether the most accurate model of a data set beats the classical solvers that
    cost no more per frame.
    """

    PAYS = enum.auto()  # the interval of the ratio lies below 1
    OPEN = enum.auto()  # it contains 1, or there is none
    DOES_NOT_PAY = enum.auto()
    # every classical solver costs more, and the cheapest one is not clearly less
    # accurate
    NO_SOLVER = enum.auto()


ANSWERS = {
    LearningVerdict.PAYS: "yes",
    LearningVerdict.OPEN: "open",
    LearningVerdict.DOES_NOT_PAY: "no",
    LearningVerdict.NO_SOLVER: "no solver is as cheap",
}
"""Whether learning pays, in the table of the data sets of a size."""

OTHER_VERDICTS = {
    LearningVerdict.DOES_NOT_PAY: "Learning does not pay on {}.",
    LearningVerdict.OPEN: "Whether learning pays is open on {}.",
    LearningVerdict.NO_SOLVER: (
        "There is no verdict on {}: there every classical solver takes more time per "
        "frame than the most accurate model."
    ),
}
"""Sentences about data sets where learning does not clearly pay; {} stands for them."""


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


@dataclass(frozen=True, kw_only=True, eq=False)
class Conclusion:
    """What a data set says about learning: how its most accurate model compares."""

    tab: Tab
    row: BoardRow  # the most accurate model: an active entry that learns, of known cost
    verdict: LearningVerdict
    # whether a model whose cost is not known has less error: it decides nothing
    better_has_no_cost: bool
    # the most accurate of the models of known cost that contain no solver
    learned: BoardRow | None

    @property
    def model(self) -> str:
        """What the model is among those of the data set, in words."""
        if self.better_has_no_cost:
            return "the most accurate model of known cost"
        return "the most accurate model"

    @property
    def is_hybrid(self) -> bool:
        """Whether the most accurate model contains a solver."""
        return self.row.entry.kind is Kind.HYBRID

    @property
    def slowdown(self) -> float | None:
        """Time of a frame of the model over that of the simulator; None if unknown."""
        cost = cost_of(self.row)
        if cost is None or cost.speed_up is None:
            return None
        return 1.0 / cost.speed_up

    @property
    def is_slow(self) -> bool:
        """Whether a frame of the model costs more, in the digits that are shown."""
        if self.slowdown is None:
            return False
        return round_digits(self.slowdown, RATIO_DIGITS) > 1.0

    @property
    def learned_verdict(self) -> LearningVerdict | None:
        """Whether the most accurate purely learned model beats the solvers that cost no
        more per frame.
        """
        if self.learned is None:
            return None
        return _verdict_on(self.learned)


def judge(tab: Tab) -> Conclusion | None:
    """Return what a data set says about learning; None where no cost is known.

    The most accurate model decides, as in docs/results.md. Variants count; entries
    whose weights fail a gate take part in no claim.
    """
    models = []
    for row in _models_of(tab):
        if row.against_classical is not None or row.solver_costs_more:
            models.append(row)
    if not models:
        return None
    best = _most_accurate(models, tab)
    learned_models = [row for row in models if row.entry.kind is Kind.LEARNED]
    learned = None
    if learned_models:
        learned = _most_accurate(learned_models, tab)
    least_error = min(_error_of(row, tab) for row in _models_of(tab))
    return Conclusion(
        tab=tab,
        row=best,
        verdict=_verdict_on(best),
        better_has_no_cost=least_error < _error_of(best, tab),
        learned=learned,
    )


def _most_accurate(rows: Sequence[BoardRow], tab: Tab) -> BoardRow:
    """Return the row with the least error; the first of several."""
    return min(rows, key=lambda row: _error_of(row, tab))


def _verdict_on(row: BoardRow) -> LearningVerdict:
    """Return the verdict of a row's ratio to a classical solver."""
    ratio = row.against_classical
    if ratio is None:
        return LearningVerdict.NO_SOLVER
    return verdict_of_interval(
        ratio.low, ratio.high, solver_costs_more=row.solver_costs_more
    )


def verdict_of_interval(
    low: float, high: float, *, solver_costs_more: bool = False
) -> LearningVerdict:
    """Return the verdict of the interval of a ratio; NaN where there is none.

    A solver that costs more than the model can show that learning pays, but not that it
    does not.

    >>> verdict_of_interval(0.8, 0.9).name, verdict_of_interval(0.8, 1.1).name
    ('PAYS', 'OPEN')
    >>> verdict_of_interval(1.1, 1.2, solver_costs_more=True).name
    'NO_SOLVER'
    """
    if high < 1.0:
        return LearningVerdict.PAYS
    if solver_costs_more:
        return LearningVerdict.NO_SOLVER
    if low > 1.0:
        return LearningVerdict.DOES_NOT_PAY
    return LearningVerdict.OPEN


def _models_of(tab: Tab) -> list[BoardRow]:
    """Return the active entries that learn and fail no gate."""
    models = []
    for row in tab.rows:
        learns = row.entry.kind in LEARNS
        if row.active and learns and not row.failed_gates:
            models.append(row)
    return models


def _error_of(row: BoardRow | ReferenceRow, tab: Tab) -> float:
    """Return the mean of the ranking metric; infinite where there is none."""
    if tab.ranking not in row.values or math.isnan(row.values[tab.ranking].mean):
        return math.inf
    return row.values[tab.ranking].mean


def _format_ratio(ratio: Value) -> str:
    return f"{text(ratio.mean)}×"


def is_open(ratio: Value) -> bool:
    """Tell whether the interval of a ratio contains 1, or is missing."""
    return verdict_of_interval(ratio.low, ratio.high) is LearningVerdict.OPEN


def format_comparison(row: BoardRow) -> str:
    """Return the ratio to a classical solver, as in "0.863× (0.812 to 0.915)".

    The sign ‡ says that the solver costs more.
    """
    ratio = row.against_classical
    if ratio is None:
        return "no solver is as cheap"
    sign = SOLVER_COSTS_MORE if row.solver_costs_more else ""
    if math.isnan(ratio.low + ratio.high):
        return f"{_format_ratio(ratio)}{sign}"
    interval = f"({text(ratio.low)} to {text(ratio.high)})"
    return f"{_format_ratio(ratio)}{sign} {interval}"


def _compare(row: BoardRow, ratio: Value) -> str:
    """Return a ratio with its interval and its solver, in words."""
    interval = ""
    if not math.isnan(ratio.low + ratio.high):
        interval = f" (95\u00a0%: {text(ratio.low)} to {text(ratio.high)})"
    solver = f"{row.solver}, the best classical solver that costs no more per frame"
    if row.solver_costs_more:
        solver = f"{row.solver}, the cheapest classical solver, which costs more"
    return f"{_format_ratio(ratio)}{interval} the error of {solver}"


def describe_slowdown(slowdown: float) -> str:
    """Return the time of a model over that of the simulator, and what it means.

    >>> describe_slowdown(2.0), describe_slowdown(0.5), describe_slowdown(1.004)
    ('2×, slower', '0.50×, faster', '1.0×, as fast')
    """
    shown = round_digits(slowdown, RATIO_DIGITS)
    word = "as fast"
    if shown > 1.0:
        word = "slower"
    elif shown < 1.0:
        word = "faster"
    return f"{text(slowdown, RATIO_DIGITS)}×, {word}"


def conclude(tab: Tab) -> str:
    """Return the sentences about whether learning pays; empty where nothing tells."""
    conclusion = judge(tab)
    if conclusion is None:
        return ""
    data_set = f"{tab.size.split} {tab.size.name}"
    row = conclusion.row
    model = f"{row.entry.name}, {conclusion.model}"
    ratio = row.against_classical
    if ratio is None or conclusion.verdict is LearningVerdict.NO_SOLVER:
        sentences = [
            f"On {data_set} no classical solver is as cheap as {model}.",
            *_place_among_solvers(row, tab),
        ]
    else:
        sentences = [_state_verdict(conclusion.verdict, data_set, model, row, ratio)]
    if conclusion.verdict is LearningVerdict.PAYS:
        slowdown = conclusion.slowdown
        if slowdown is not None and conclusion.is_slow:
            times = text(slowdown, RATIO_DIGITS)
            sentences.append(
                f"A frame of the model costs {times} times as much as a frame of the "
                "simulator that made the data."
            )
    else:
        sentences += _name_exception(tab)
    return " ".join(sentences)


def _state_verdict(
    verdict: LearningVerdict, data_set: str, model: str, row: BoardRow, ratio: Value
) -> str:
    """Return the first sentence; ``model`` reads "GNS, the most accurate model"."""
    comparison = f"{model}, has {_compare(row, ratio)}"
    if verdict is LearningVerdict.PAYS:
        return f"Learning pays on {data_set}: {comparison}."
    if verdict is LearningVerdict.DOES_NOT_PAY:
        return f"Learning does not pay on {data_set}: {comparison}."
    reason = "the interval contains 1"
    if math.isnan(ratio.low + ratio.high):
        reason = "there are too few scenarios for an interval"
    return f"Whether learning pays on {data_set} is open: {comparison}, and {reason}."


def _place_among_solvers(row: BoardRow, tab: Tab) -> list[str]:
    """Return which classical solvers have a greater, equal or smaller mean error."""
    behind = []
    equal = []
    ahead = []
    for reference in sorted(tab.references, key=lambda other: _error_of(other, tab)):
        if reference.kind is not Kind.CLASSICAL or tab.ranking not in reference.values:
            continue
        if _error_of(reference, tab) > _error_of(row, tab):
            behind.append(reference.name)
        elif _error_of(reference, tab) < _error_of(row, tab):
            ahead.append(reference.name)
        else:
            equal.append(reference.name)
    return place_among_solvers(row.entry.name, behind=behind, equal=equal, ahead=ahead)


def place_among_solvers(
    model: str,
    *,
    behind: Sequence[str],
    equal: Sequence[str],
    ahead: Sequence[str],
) -> list[str]:
    """Return sentences about the mean error of a model beside those of solvers.

    >>> for sentence in place_among_solvers(
    ...     "GNS", behind=["coarse"], equal=[], ahead=["fine"]
    ... ):
    ...     print(sentence)
    The mean error of GNS is less than that of coarse.
    It is greater than that of fine.
    """
    comparisons = []
    if behind:
        comparisons.append(f"is less than that of {join_names(behind)}")
    if equal:
        comparisons.append(f"equals that of {join_names(equal)}")
    if ahead:
        comparisons.append(f"is greater than that of {join_names(ahead)}")
    sentences = []
    for number, comparison in enumerate(comparisons):
        subject = "It" if number else f"The mean error of {model}"
        sentences.append(f"{subject} {comparison}.")
    return sentences


def _name_exception(tab: Tab) -> list[str]:
    """Return the model that beats the solvers that cost no more per frame, where
    another one decides.

    Of several the most accurate one.
    """
    best = None
    for row in _models_of(tab):
        if _verdict_on(row) is not LearningVerdict.PAYS:
            continue
        if best is None or _error_of(row, tab) < _error_of(best, tab):
            best = row
    if best is None or best.against_classical is None:
        return []
    comparison = _compare(best, best.against_classical)
    return [f"Yet {best.entry.name}, which is less accurate, has {comparison}."]


def join_names(names: Sequence[str]) -> str:
    """Return names in words.

    >>> join_names(["cavity", "fluid", "cylinder"])
    'cavity, fluid and cylinder'
    """
    if len(names) == 1:
        return names[0]
    return f"{', '.join(names[:-1])} and {names[-1]}"


def conclusions_of(tabs: Sequence[Tab]) -> list[Conclusion]:
    """Return what data sets say about learning, where they say anything."""
    conclusions = []
    for tab in tabs:
        conclusion = judge(tab)
        if conclusion is not None:
            conclusions.append(conclusion)
    return conclusions


def summarise(overview: SizeOverview) -> list[str]:
    """Return where learning pays at a size, and who leads over all its data sets."""
    sentences = state_verdicts(conclusions_of(overview.tabs))
    without_skill = _find_data_sets_without_skill(overview)
    if without_skill:
        sentences.append(
            f"No entry has a skill above 0 on {join_names(without_skill)}: the best "
            "naive baseline has less error than every entry."
        )
    sentences.append(_name_leader(overview))
    return sentences


def state_verdicts(conclusions: Sequence[Conclusion]) -> list[str]:
    """Return on how many data sets learning pays, by which models, at which cost."""
    total = len(conclusions)
    verdicts = [conclusion.verdict for conclusion in conclusions]
    winners = []
    for conclusion in conclusions:
        if conclusion.verdict is LearningVerdict.PAYS:
            winners.append(conclusion)
    sentences = []
    if winners:
        sentences.append(
            f"Learning pays on {_share(len(winners), total)}: there no single "
            "classical solver of lagbench is both as cheap per frame and as accurate "
            "as the most accurate model."
        )
        sentences += _describe_winners(winners)
    for verdict, statement in OTHER_VERDICTS.items():
        count = verdicts.count(verdict)
        if count:
            data_sets = _share(count, total)
            sentences.append(statement.format(data_sets))

    learned_verdicts = []
    for conclusion in conclusions:
        if conclusion.learned_verdict is not None:
            learned_verdicts.append(conclusion.learned_verdict)
    if learned_verdicts and any(winner.is_hybrid for winner in winners):
        win_count = learned_verdicts.count(LearningVerdict.PAYS)
        open_count = learned_verdicts.count(LearningVerdict.OPEN)
        sentences.append(
            f"Purely learned models pay on {win_count} of {len(learned_verdicts)} data "
            f"sets; on {open_count} the question is open."
        )
    return sentences


def _describe_winners(winners: Sequence[Conclusion]) -> list[str]:
    """Return how many models by which learning pays are hybrids, and how many slow."""
    hybrid_count = 0
    slow_count = 0
    for winner in winners:
        hybrid_count += winner.is_hybrid
        slow_count += winner.is_slow
    sentences = []
    if hybrid_count:
        models = _count_models(hybrid_count, len(winners))
        sentences.append(
            f"{models} hybrid: a classical solver with a few learned numbers."
        )
    if slow_count:
        models = _count_models(slow_count, len(winners))
        sentences.append(f"{models} slower than the simulator that made the data.")
    return sentences


def _share(count: int, total: int) -> str:
    """Return how many of the data sets, in words."""
    if total == 1:
        return "the only data set"
    return f"{count} of {total} data sets"


def _count_models(count: int, total: int) -> str:
    """Return how many models are something.

    >>> _count_models(9, 12), _count_models(12, 12), _count_models(1, 1)
    ('9 of these 12 models are', 'All 12 models are', 'The model is')
    """
    if total == 1:
        return "The model is"
    if count == total:
        return f"All {count} models are"
    verb = "is" if count == 1 else "are"
    return f"{count} of these {total} models {verb}"


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

    The film is of a model by which learning pays: of these the one with the most
    materials, then the one with the most skill. Where there is none, it is of the first
    method of the first table that has a film; there data sets with skill come first.
    """
    for overview in overviews:
        films = []
        for conclusion in conclusions_of(overview.tabs):
            if conclusion.verdict is LearningVerdict.PAYS:
                films.append((conclusion.tab, conclusion.row))
        film = _choose_film(films)
        if film is not None:
            return film
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
