"""The board in a terminal: ``lagbench leaderboard show``."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from typing import Any

from lagbench.errors import UsageError, nearest
from lagbench.scoring.card import digits
from lagbench.scoring.tables import Table

from .model import Board, Row, Tab, Value

__all__ = ["as_plain", "chosen_tabs", "tables"]

SHOWN = 5
"""Metrics in a table unless some are named."""


def chosen_tabs(board: Board, split: str | None, size: str | None) -> tuple[Tab, ...]:
    """Return the tabs of a split, of a size, or all.

    Raises:
        UsageError: there is none.
    """
    found = tuple(tab for tab in board.tabs if split in (None, tab.split) and size in (None, tab.size))
    if found:
        return found
    known = [f"{tab.split} {tab.size}" for tab in board.tabs]
    wanted = " ".join(name for name in (split, size) if name)
    fix = nearest(wanted, known) if known else "submit something: lagbench submit"
    raise UsageError("no entries there", where=f"leaderboard {wanted}".strip(), fix=fix)


def tables(board: Board, tabs: Collection[Tab], metrics: Collection[str] = ()) -> Iterator[Table]:
    """Yield a table per tab: ranked rows, then floors, then what is not ranked.

    Args:
        board: the board.
        tabs: its tabs to show.
        metrics: names of metrics to show beside the ranking one; the tab's first ones by default.

    Raises:
        UsageError: a metric that the board does not have.
    """
    for name in metrics:
        if name not in board.metrics:
            raise UsageError(f"no metric {name!r} here", where="--metric", fix=nearest(name, board.metrics))
    for tab in tabs:
        yield _table(tab, list(dict.fromkeys((tab.ranking, *(metrics or tab.columns[:SHOWN])))))


def as_plain(tabs: Collection[Tab]) -> dict[str, Any]:
    """Return tabs as JSON may hold them; what is undefined is None."""
    return {
        "tabs": [
            {
                "split": tab.split,
                "size": tab.size,
                "dataset_version": tab.dataset_version,
                "ranking_metric": tab.ranking,
                "rows": [_plain_row(row) for row in tab.rows],
            }
            for tab in tabs
        ]
    }


def _plain_row(row: Row) -> dict[str, Any]:
    fields = ("id", "name", "rank", "floor", "status", "current", "seeds", "parameters", "diverged")
    return {
        **{name: getattr(row, name) for name in fields},
        "flags": [flag.name for flag in row.flags],
        "cost": row.cost,
        "metrics": {
            name: {key: digits(getattr(value, key)) for key in ("mean", "std", "low", "high")}
            for name, value in row.values.items()
        },
    }


def _table(tab: Tab, names: list[str]) -> Table:
    claim = "" if tab.decided else ", too few scenarios to tell ranks apart"
    cost = "; cost self-reported" if any(row.cost for row in tab.rows) else ""
    title = f"{tab.split} {tab.size} {tab.dataset_version}, by {tab.ranking}{claim}{cost}"
    columns = ("rank", "method", *names, "s/frame", "speed-up", "remarks")
    return Table(title, columns, tuple(_cells(row, names) for row in tab.rows))


def _cells(row: Row, names: list[str]) -> tuple[str, ...]:
    rank = "-" if row.rank is None else f"{row.rank}{'=' if row.shared else ''}"
    cost = row.cost
    return (
        rank,
        row.id,
        *(_value(row.values.get(name)) for name in names),
        "" if cost is None else f"{cost.seconds_per_frame:.3g}",
        "" if cost is None or cost.speed_up is None else f"{cost.speed_up:.3g}",
        ", ".join(_remarks(row)),
    )


def _value(value: Value | None) -> str:
    """Return a mean, with its deviation over seeds where there are several."""
    if value is None or math.isnan(value.mean):
        return "-"
    return f"{value.mean:.4g}" + ("" if math.isnan(value.std) else f" ± {value.std:.2g}")


def _remarks(row: Row) -> Iterator[str]:
    if row.floor:
        yield "floor"
    if row.status != "active":
        yield row.status
    if not row.current:
        yield f"data set {row.dataset_version}"
    if row.seeds > 1:
        yield f"{row.seeds} seeds"
    if row.diverged:
        yield f"{row.diverged} diverged"
    yield from (flag.name for flag in row.flags)
