"""The board in a terminal and as JSON: ``lagbench leaderboard show``."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from typing import Any

from lagbench.errors import UsageError, suggest_name
from lagbench.figures.tables import Table
from lagbench.metrics.table import METRICS
from lagbench.scoring.front import digits

from .columns import MAIN_COLUMNS, columns_of, describe_check, format_number
from .rows import Board, Row, Value, conclude

SHOWN = ("rank", "method", "score", "skill", "milliseconds", "speedup", "breakeven")
"""Columns of a table in the terminal."""


def tables(board: Board, metrics: Collection[str] = ()) -> Iterator[Table]:
    """Yield a table per tab: all rows in the order of the ranking metric.

    Args:
        board: the board.
        metrics: metrics to show beside the ranking one.

    Raises:
        UsageError: an unknown metric.
    """
    for name in metrics:
        if name not in METRICS:
            raise UsageError(f"no metric {name!a}; {suggest_name(name, METRICS)}")
    for tab in board.tabs:
        shown = {column.key for column in columns_of(tab.rows)}
        columns = [one for one in MAIN_COLUMNS if one.key in shown.intersection(SHOWN)]
        rows = []
        for row in tab.rows:
            cells = [column.read(row).text for column in columns]
            for name in metrics:
                value = row.metrics.get(name)
                cells.append(format_number(None if value is None else value.mean))
            remarks = [str(row.kind)]
            if row.entry is not None:
                remarks.append(describe_check(row))
            if row.failed_gates:
                remarks.append("under-trained")
            if row.diverged:
                remarks.append(f"{row.diverged} diverged")
            rows.append((*cells, ", ".join([*remarks, *row.flags])))
        title = f"{tab.name} {tab.size.version}, score: {tab.ranking}"
        if tab.truth_error:
            title += f", truth error {format_number(tab.truth_error)}"
        headings = [column.label for column in columns]
        yield Table(title, (*headings, *metrics, "remarks"), tuple(rows), keys=2)


def to_plain(board: Board) -> dict[str, Any]:
    """Return a board as values for JSON; undefined numbers are None."""
    tabs = []
    for tab in board.tabs:
        hull = []
        for corner in tab.hull:
            hull.append(
                {
                    "id": corner.name,
                    "error": digits(corner.error),
                    "seconds_per_frame": corner.seconds,
                }
            )
        tabs.append(
            {
                "split": tab.size.split,
                "size": tab.size.name,
                "dataset_version": tab.size.version,
                "ranking_metric": tab.ranking,
                "truth_error": tab.truth_error,
                "hull": hull,
                "rows": [_plain_row(row) for row in tab.rows if row.entry is not None],
                "references": [
                    _plain_row(row) for row in tab.rows if row.entry is None
                ],
            }
        )
    return {"conclusion": conclude(board), "tabs": tabs}


def _plain_row(row: Row) -> dict[str, Any]:
    after: float | str | None = row.breakeven
    if row.breakeven is not None:
        after = "never" if math.isinf(row.breakeven) else digits(row.breakeven)
    plain: dict[str, Any] = {
        "id": row.id,
        "name": row.name,
        "kind": str(row.kind),
        "rank": row.rank,
        "rank_range": row.rank_range,
        "tied": row.tied,
        "skill": _plain_value(row.skill),
        "skill_on_shift": _plain_value(row.shift_skill),
        "seconds_per_frame": row.seconds,
        "speedup": row.speedup and row.speedup.as_json(),
        "why_no_speedup": row.why_no_speedup and str(row.why_no_speedup),
        "breakeven": after,
        "metrics": {name: _plain_value(one) for name, one in row.metrics.items()},
    }
    if row.entry is not None:
        budget = row.entry.budget
        plain |= {
            "checked": describe_check(row),
            "seeds": len(row.seeds),
            "parameters": row.entry.parameters,
            "budget": None if budget is None else budget.model_dump(mode="json"),
            "flags": list(row.flags),
            "failed_gates": list(row.failed_gates),
            "diverged": row.diverged,
        }
    return plain


def _plain_value(value: Value | None) -> dict[str, float | None] | None:
    if value is None:
        return None
    return {
        name: digits(getattr(value, name)) for name in ("mean", "std", "low", "high")
    }
