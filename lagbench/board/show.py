"""The board in a terminal: ``lagbench leaderboard show``."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from typing import Any

from lagbench.errors import UsageError, suggest_name
from lagbench.figures.tables import Table
from lagbench.metrics.table import METRICS
from lagbench.references.predictor import Kind
from lagbench.scoring.card import digits

from .build import COLUMNS, Scope
from .columns import (
    AGAINST_CLASSICAL,
    SELF_REPORTED,
    SKILL,
    SKILL_ON_SHIFT,
    SOLVER_COSTS_MORE,
    TableRow,
    comparisons_of,
    cost_of,
    describe_check,
    format_ranks,
    is_beside_dearer_solver,
    level_of,
    metric_value,
    source_of_cost,
)
from .entry import Level
from .model import Board, BoardRow, OnShift, ReferenceRow, Tab, Value

NOTHING = "-"

WIDTH = 80
"""Width that a table without `--wide` keeps to [characters]."""

GAP = 2
"""Spaces between two columns."""

LEAST_REMARKS = 10
"""Width of the remarks below which another column makes room [characters]."""

LEFT_OUT = "…"
"""Stands for remarks that a table has no room for."""

REPORTED = "*"
"""Behind a time of a frame that the submitter states."""


def scope_of_tables(metrics: Collection[str], *, wide: bool) -> Scope:
    """Return how much of the score files the tables need."""
    names = {*metrics}
    if wide:
        names.update(COLUMNS)
    return Scope(metrics=names, intervals=(), has_pictures=False)


SCOPE_OF_JSON = Scope(has_pictures=False)
"""How much of the score files JSON needs."""


def tables(
    board: Board, metrics: Collection[str] = (), *, wide: bool = False
) -> Iterator[Table]:
    """Yield a table per tab: methods by rank, reference predictors, other rows.

    Args:
        board: the board.
        metrics: metrics to show beside the ranking one.
        wide: whether to show variants, the spread over seeds, and the first metrics of
            each tab.

    Raises:
        UsageError: an unknown metric.
    """
    for name in metrics:
        if name not in METRICS:
            raise UsageError(
                f"no metric {name!r} here",
                where="--metric",
                expected="the name of a metric",
                got=ascii(name),
                fix=suggest_name(name, METRICS),
            )
    for tab in board.tabs:
        yield _table_of(tab, metrics, wide=wide)


def _table_of(tab: Tab, metrics: Collection[str], *, wide: bool) -> Table:
    """Return the table of a tab; without ``wide`` it leaves out what does not fit."""
    methods = []
    other_rows = []
    for row in tab.rows:
        if row.rank is not None:
            methods.append(row)
        elif wide or row.variant_of is None:
            other_rows.append(row)
    rows: list[TableRow] = [*methods, *tab.references, *other_rows]

    names = _columns_of(tab, metrics, wide=wide)
    lines = _format_lines(tab, rows, names, wide=wide)
    has_shift = SHIFT in names
    if not wide and has_shift and _room_for_remarks(lines) < LEAST_REMARKS:
        names.remove(SHIFT)
        lines = _format_lines(tab, rows, names, wide=wide)
    room = _room_for_remarks(lines)
    if room < LEAST_REMARKS:
        # they stand in a block of their own, behind rank and method
        room = _room_for_remarks([line[:KEYS] for line in lines])

    table_rows = []
    for table_row, line in zip(rows, lines[1:], strict=True):
        remarks = _join_remarks(table_row, wide=wide)
        if not wide and len(remarks) > room:
            remarks = _shorten_remarks(table_row, room)
        table_rows.append((*line, remarks))
    legend = list(_legend_of(tab, table_rows, wide=wide))
    if AGAINST_CLASSICAL.key in names:
        legend.append(
            f"{HEADINGS[AGAINST_CLASSICAL.key]}: score over that of the best classical "
            "solver that costs no more"
        )
    legend += _legend_of_times(tab)
    if any(is_beside_dearer_solver(row) for row in rows):
        legend.append(
            f"{SOLVER_COSTS_MORE}: all classical solvers cost more than the model"
        )
    if has_shift and SHIFT not in names:
        legend.append(f"{HEADINGS[SHIFT]}: only with --wide")
    return Table(
        "\n".join([_title_of(tab), *legend]),
        (*lines[0], "remarks"),
        tuple(table_rows),
        keys=KEYS,
    )


def _legend_of_times(tab: Tab) -> Iterator[str]:
    """Yield what the column of times means, and which times compare."""
    if tab.run is not None:
        yield "s/frame: time of a frame on one core, measured in one run"
        yield "(naive baselines that read train: converted from another run)"
        return
    yield "s/frame: time of a frame of one scenario"
    if tab.references:
        yield "s/frame of classical and naive rows: measured in other runs"


def _format_lines(
    tab: Tab, rows: Sequence[TableRow], names: Sequence[str], *, wide: bool
) -> list[tuple[str, ...]]:
    """Return the headings and the cells of a table, all but the remarks."""
    headings = [HEADINGS.get(name, name) for name in names]
    headings[names.index(tab.ranking)] = "score"
    lines: list[tuple[str, ...]] = [("rank", "method", *headings, "s/frame")]
    for row in rows:
        lines.append(_format_row(tab, row, names, wide=wide))
    return lines


def _room_for_remarks(lines: Sequence[Sequence[str]]) -> int:
    """Return the width that other columns leave for the remarks [characters]."""
    room = WIDTH
    for column in zip(*lines, strict=True):
        room -= max(map(len, column)) + GAP
    return room


KEYS = 2
"""Columns that say what a row is: rank and method."""

SHIFT = SKILL_ON_SHIFT.key
"""Key of the column that makes room for remarks."""

HEADINGS = {"against_classical": "÷class.", "skill_on_shift": "shift"}
"""Headings of columns that have other names than their keys."""


def _columns_of(tab: Tab, metrics: Collection[str], *, wide: bool) -> list[str]:
    comparisons = [column.key for column in comparisons_of(tab)]
    names = [tab.ranking, *comparisons, *metrics]
    if SKILL.key in comparisons:
        # the skill stands before the score
        names.insert(0, SKILL.key)
    if wide:
        names += tab.columns
    return list(dict.fromkeys(names))


def _title_of(tab: Tab) -> str:
    size = tab.size
    return f"{size.split} {size.name} {size.version}, score: {tab.ranking}"


def _legend_of(tab: Tab, rows: Sequence[Sequence[str]], *, wide: bool) -> Iterator[str]:
    """Yield lines that explain the marks of a table, where it has them."""
    marks = []
    if not wide and any(row.variant_of for row in tab.rows):
        marks.append("+n: variants (--wide)")
    if any(seconds.endswith(REPORTED) for *_, seconds, _ in rows):
        marks.append(f"{REPORTED}: time self-reported")
    if any(remarks.endswith(LEFT_OUT) for *_, remarks in rows):
        marks.append(f"{LEFT_OUT}: more remarks (--wide)")
    if marks:
        yield "; ".join(marks)
    if not tab.decided:
        yield "too few scenarios to tell entries apart"


def to_plain(board: Board) -> dict[str, Any]:
    """Return a board as values for JSON; undefined numbers are None."""
    return {"tabs": [_plain_tab(tab) for tab in board.tabs]}


def _plain_tab(tab: Tab) -> dict[str, Any]:
    references = []
    for reference in tab.references:
        values = reference.values
        metrics = {}
        for name, value in values.items():
            metrics[name] = _plain_value(value)
        references.append(
            {
                "id": reference.name,
                "kind": str(reference.kind),
                "metrics": metrics,
                **_plain_shift(reference.on_shift),
            }
        )
    return {
        "split": tab.size.split,
        "size": tab.size.name,
        "dataset_version": tab.size.version,
        "ranking_metric": tab.ranking,
        "rows": [_plain_row(row) for row in tab.rows],
        "references": references,
    }


def _plain_row(row: BoardRow) -> dict[str, Any]:
    entry = row.entry
    cost = None
    if entry.cost is not None:
        cost = {**entry.cost.model_dump(), "speed_up": entry.cost.speed_up}
    budget = None
    if entry.budget is not None:
        budget = entry.budget.model_dump()
    skill = None
    if row.skill is not None:
        skill = _plain_value(row.skill)
    against_classical = None
    if row.against_classical is not None:
        against_classical = _plain_value(row.against_classical)
    metrics = {}
    for name, value in row.values.items():
        metrics[name] = _plain_value(value)
    return {
        "id": row.id,
        "rank": row.rank,
        "tied": row.tied,
        "current": row.current,
        "diverged": row.diverged,
        "name": entry.name,
        "status": str(entry.status),
        "verified": level_of(row) is not Level.AS_SUBMITTED,
        "level": str(level_of(row)),
        "cost_source": source_of_cost(row) or None,
        "variant_of": row.variant_of,
        "shared_with": list(entry.shared_with),
        "rank_range": row.rank_range,
        "seeds": len(entry.predictions),
        "parameters": entry.parameters,
        "flags": [flag.name for flag in row.flags],
        "cost": cost,
        "budget": budget,
        "kind": str(entry.kind),
        "skill": skill,
        "against_classical": against_classical,
        "classical_solver": row.solver,
        "classical_solver_costs_more": row.solver_costs_more,
        "metrics": metrics,
        **_plain_shift(row.on_shift),
    }


def _plain_shift(on_shift: OnShift | None) -> dict[str, dict[str, float | None] | None]:
    """Return score and skill on ``shift``, None where there is none."""
    score = None
    skill = None
    if on_shift is not None:
        score = _plain_value(on_shift.score)
        if on_shift.skill is not None:
            skill = _plain_value(on_shift.skill)
    return {"score_on_shift": score, "skill_on_shift": skill}


def _plain_value(value: Value) -> dict[str, float | None]:
    return {
        "mean": digits(value.mean),
        "std": digits(value.std),
        "low": digits(value.low),
        "high": digits(value.high),
    }


def _format_row(
    tab: Tab, row: TableRow, names: Sequence[str], *, wide: bool
) -> tuple[str, ...]:
    values = []
    for name in names:
        value = metric_value(row, name)
        is_skill = name in (SKILL.key, SHIFT)
        cell = _format_value(value, wide=wide, is_skill=is_skill)
        if name == AGAINST_CLASSICAL.key and is_beside_dearer_solver(row):
            cell += SOLVER_COSTS_MORE
        values.append(cell)
    seconds = _format_seconds(row)
    if isinstance(row, ReferenceRow):
        return (NOTHING, row.name, *values, seconds)
    name = row.id if wide else _format_name(tab, row)
    return (_format_rank(row), name, *values, seconds)


def _format_name(tab: Tab, row: BoardRow) -> str:
    """Return the id of a method, and how many variants of it are not shown."""
    count = len(tab.variants_of(row))
    if count:
        return f"{row.id} +{count}"
    return row.id


def _format_value(value: Value | None, *, wide: bool, is_skill: bool) -> str:
    if value is None or math.isnan(value.mean):
        return NOTHING
    if is_skill and not wide:
        # less than a thousandth of the naive baseline's score says nothing
        rounded = round(value.mean, 3) + 0.0  # without the sign of -0
        return f"{rounded:.3g}"
    if math.isnan(value.std) or not wide:
        return f"{value.mean:.3g}"
    return f"{value.mean:.4g} ± {value.std:.2g}"


def _format_seconds(row: TableRow) -> str:
    """Return the time of a frame, with a mark where only the submitter took it."""
    cost = cost_of(row)
    if cost is None:
        return NOTHING
    mark = REPORTED if source_of_cost(row) == SELF_REPORTED else ""
    return f"{cost.seconds_per_frame:.2g}{mark}"


def _format_rank(row: BoardRow) -> str:
    if row.rank is None:
        return NOTHING
    return format_ranks(row.rank, row.rank_range)


def _join_remarks(row: TableRow, *, wide: bool) -> str:
    """Return the remarks on a row in full."""
    if isinstance(row, ReferenceRow):
        return str(row.kind)
    return ", ".join(_remarks_on(row, wide=wide))


def _shorten_remarks(row: TableRow, room: int) -> str:
    """Return the first remarks on a row that fit, with a mark where others do not."""
    if isinstance(row, ReferenceRow):
        return str(row.kind)
    remarks = list(_remarks_on(row, is_short=True))
    text = ", ".join(remarks)
    while len(text) > room and remarks:
        remarks.pop()
        text = f"{', '.join(remarks)} {LEFT_OUT}".lstrip()
    return text


def _remarks_on(
    row: BoardRow, *, wide: bool = False, is_short: bool = False
) -> Iterator[str]:
    """Yield remarks; what an entry without a rank misses comes first."""
    entry = row.entry
    if str(entry.status) != "active":
        yield str(entry.status)
    if not row.current:
        yield f"data set {entry.dataset.version}"
    if row.verified is not None:
        yield describe_check(row, is_short=is_short)
    if row.variant_of is not None:
        yield "variant"
    if entry.kind is not Kind.LEARNED:
        yield str(entry.kind)
    if wide and len(entry.predictions) > 1:
        yield f"{len(entry.predictions)} seeds"
    if row.failed_gates:
        yield "under-trained"
    if row.diverged:
        yield f"{row.diverged} diverged"
    for flag in row.flags:
        yield flag.name
