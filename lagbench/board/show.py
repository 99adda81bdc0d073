"""The board in a terminal: ``lagbench leaderboard show``."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from typing import Any

from lagbench.errors import UsageError, suggest_name
from lagbench.figures.tables import Table
from lagbench.scoring.card import digits

from .columns import TableRow, metric_value
from .entry import EntryCost
from .model import Board, BoardRow, ReferenceRow, Tab, Value

NOTHING = "-"


def choose_data_sets(
    known: Collection[tuple[str, str]], split: str | None, size: str | None
) -> tuple[tuple[str, str], ...]:
    """Return the (split, size) with entries that are of a split, of a size, or all.

    Raises:
        UsageError: a split or size is given that has no entries.
    """
    chosen = []
    for known_split, known_size in known:
        if split in (None, known_split) and size in (None, known_size):
            chosen.append((known_split, known_size))
    if chosen or (split is None and size is None):
        return tuple(chosen)

    request = " ".join(name for name in (split, size) if name)
    fix: str | None = "submit something: lagbench submit"
    if known:
        fix = suggest_name(request, [" ".join(data_set) for data_set in known])
    raise UsageError("no entries there", where=f"leaderboard {request}", fix=fix)


def tables(
    board: Board, metrics: Collection[str] = (), *, wide: bool = False
) -> Iterator[Table]:
    """Yield a table per tab: ranked rows, reference predictors, other rows.

    Args:
        board: the board.
        metrics: metrics to show beside the ranking one.
        wide: whether to show the first metrics of each tab.

    Raises:
        UsageError: an unknown metric.
    """
    for name in metrics:
        if name not in board.metrics:
            raise UsageError(
                f"no metric {name!r} here",
                where="--metric",
                fix=suggest_name(name, board.metrics),
            )
    for tab in board.tabs:
        names = _columns_of(tab, metrics, wide=wide)
        ranked_rows = []
        other_rows = []
        for row in tab.rows:
            if row.rank is not None:
                ranked_rows.append(row)
            else:
                other_rows.append(row)
        rows: list[TableRow] = [*ranked_rows, *tab.references, *other_rows]
        cells = []
        for table_row in rows:
            cells.append(_format_row(table_row, names))
        yield Table(
            _title_of(tab),
            ("rank", "method", *names, "s/frame", "speed-up", "remarks"),
            tuple(cells),
            keys=2,
        )


def _columns_of(tab: Tab, metrics: Collection[str], *, wide: bool) -> list[str]:
    names = [tab.ranking, *metrics]
    if any(row.against_classical for row in tab.rows):
        names.insert(0, "against_classical")
    if any(row.skill for row in tab.rows):
        names.insert(0, "skill")
    if wide:
        names += tab.columns
    return list(dict.fromkeys(names))


def _title_of(tab: Tab) -> str:
    size = tab.size
    title = f"{size.split} {size.name} {size.version}, by {tab.ranking}"
    if not tab.decided:
        title += ", too few scenarios to tell entries apart"
    if any(row.entry.cost for row in tab.rows):
        title += "; cost self-reported"
    return title


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
            {"id": reference.name, "kind": str(reference.kind), "metrics": metrics}
        )
    return {
        "split": tab.size.split,
        "size": tab.size.name,
        "dataset_version": tab.size.version,
        "ranking_metric": tab.ranking,
        "rows": [_plain_row(row) for row in tab.rows],
        "floors": references,
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
        "verified": row.verified is not None,
        "seeds": len(entry.predictions),
        "parameters": entry.parameters,
        "flags": [flag.name for flag in row.flags],
        "cost": cost,
        "budget": budget,
        "kind": str(entry.kind),
        "skill": skill,
        "against_classical": against_classical,
        "classical_solver": row.solver,
        "metrics": metrics,
    }


def _plain_value(value: Value) -> dict[str, float | None]:
    return {
        "mean": digits(value.mean),
        "std": digits(value.std),
        "low": digits(value.low),
        "high": digits(value.high),
    }


def _format_row(row: TableRow, names: Sequence[str]) -> tuple[str, ...]:
    values = [_format_value(metric_value(row, name)) for name in names]
    if isinstance(row, ReferenceRow):
        times = _format_times(row.cost)
        return (NOTHING, row.name, *values, *times, f"{row.kind} reference")
    return (
        _format_rank(row),
        row.id,
        *values,
        *_format_times(row.entry.cost),
        ", ".join(_remarks_on(row)),
    )


def _format_value(value: Value | None) -> str:
    if value is None or math.isnan(value.mean):
        return NOTHING
    if math.isnan(value.std):
        return f"{value.mean:.4g}"
    return f"{value.mean:.4g} ± {value.std:.2g}"


def _format_times(cost: EntryCost | None) -> tuple[str, str]:
    """Return time per frame and speed-up."""
    if cost is None:
        return "", ""
    if cost.speed_up is None:
        return f"{cost.seconds_per_frame:.3g}", ""
    return f"{cost.seconds_per_frame:.3g}", f"{cost.speed_up:.3g}"


def _format_rank(row: BoardRow) -> str:
    if row.rank is None:
        return NOTHING
    if row.tied:
        return f"{row.rank}≈"
    return str(row.rank)


def _remarks_on(row: BoardRow) -> Iterator[str]:
    entry = row.entry
    if row.verified:
        yield "verified"
    if str(entry.status) != "active":
        yield str(entry.status)
    if not row.current:
        yield f"data set {entry.dataset.version}"
    if entry.budget is not None and entry.budget.track:
        yield entry.budget.track
    if len(entry.predictions) > 1:
        yield f"{len(entry.predictions)} seeds"
    if row.diverged:
        yield f"{row.diverged} diverged"
    for flag in row.flags:
        yield flag.name
