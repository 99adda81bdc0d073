"""The board in a terminal: ``lagbench leaderboard show``."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from typing import Any

from lagbench.errors import UsageError, nearest
from lagbench.figures.tables import Table
from lagbench.scoring.card import digits

from .columns import held
from .model import Board, ReferenceRow, Row, Value


def chosen_data_sets(
    known: Collection[tuple[str, str]], split: str | None, size: str | None
) -> tuple[tuple[str, str], ...]:
    """Return those of a split, of a size, or all of the (split, size) that have
    entries; refuse none.
    """
    found = tuple(
        one for one in known if split in (None, one[0]) and size in (None, one[1])
    )
    if found or (split is None and size is None):
        return found
    wanted = " ".join(name for name in (split, size) if name)
    if known:
        fix = nearest(wanted, map(" ".join, known))
    else:
        fix = "submit something: lagbench submit"
    raise UsageError("no entries there", where=f"leaderboard {wanted}", fix=fix)


def tables(
    board: Board, metrics: Collection[str] = (), *, wide: bool = False
) -> Iterator[Table]:
    """Yield a table per tab: ranked rows, floors, the rest; with ``wide`` the tab's
    first metrics too.
    """
    for name in metrics:
        if name not in board.metrics:
            raise UsageError(
                f"no metric {name!r} here",
                where="--metric",
                fix=nearest(name, board.metrics),
            )
    for tab in board.tabs:
        skill = ("skill",) if any(row.skill for row in tab.rows) else ()
        names = list(
            dict.fromkeys(
                (*skill, tab.ranking, *metrics, *(tab.columns if wide else ()))
            )
        )
        if tab.decided:
            claim = ""
        else:
            claim = ", too few scenarios to tell entries apart"
        if any(row.entry.cost for row in tab.rows):
            cost = "; cost self-reported"
        else:
            cost = ""
        title = f"{tab.size.split} {tab.size.name} {tab.size.version}, by {tab.ranking}{claim}{cost}"
        ranked = [row for row in tab.rows if row.rank is not None]
        rest = [row for row in tab.rows if row.rank is None]
        shown: list[Row | ReferenceRow] = [*ranked, *tab.floors, *rest]
        yield Table(
            title,
            ("rank", "method", *names, "s/frame", "speed-up", "remarks"),
            tuple(_cells(row, names) for row in shown),
            keys=2,
        )


def as_plain(board: Board) -> dict[str, Any]:
    """Return a board as JSON may hold it; what is undefined is None."""
    return {
        "tabs": [
            {
                "split": tab.size.split,
                "size": tab.size.name,
                "dataset_version": tab.size.version,
                "ranking_metric": tab.ranking,
                "rows": [_plain_row(row) for row in tab.rows],
                "floors": [
                    {
                        "id": floor.name,
                        "metrics": {n: _plain(v) for n, v in floor.values.items()},
                    }
                    for floor in tab.floors
                ],
            }
            for tab in board.tabs
        ]
    }


def _plain_row(row: Row) -> dict[str, Any]:
    entry = row.entry
    return {
        **{
            name: getattr(row, name)
            for name in ("id", "rank", "tied", "current", "diverged")
        },
        "name": entry.name,
        "status": str(entry.status),
        "verified": row.verified is not None,
        "seeds": len(entry.predictions),
        "parameters": entry.parameters,
        "flags": [flag.name for flag in row.flags],
        "cost": entry.cost
        and {**entry.cost.model_dump(), "speed_up": entry.cost.speed_up},
        "budget": entry.budget and entry.budget.model_dump(),
        "skill": row.skill and _plain(row.skill),
        "metrics": {name: _plain(value) for name, value in row.values.items()},
    }


def _plain(value: Value) -> dict[str, float | None]:
    return {
        name: digits(getattr(value, name)) for name in ("mean", "std", "low", "high")
    }


def _cells(row: Row | ReferenceRow, names: list[str]) -> tuple[str, ...]:
    values = [
        "-"
        if (value := held(row, name)) is None or math.isnan(value.mean)
        else f"{value.mean:.4g}"
        + ("" if math.isnan(value.std) else f" ± {value.std:.2g}")
        for name in names
    ]
    if isinstance(row, ReferenceRow):
        cost = row.cost
    else:
        cost = row.entry.cost
    if cost:
        time = f"{cost.seconds_per_frame:.3g}"
    else:
        time = ""
    if cost and cost.speed_up is not None:
        speed_up = f"{cost.speed_up:.3g}"
    else:
        speed_up = ""
    if isinstance(row, ReferenceRow):
        return ("-", row.name, *values, time, speed_up, "floor")
    if row.rank is None:
        rank = "-"
    else:
        rank = f"{row.rank}{'≈' if row.tied else ''}"
    if row.entry.budget:
        track = row.entry.budget.track
    else:
        track = None
    entry = row.entry
    remarks = [
        "verified" if row.verified else "",
        "" if str(entry.status) == "active" else str(entry.status),
        "" if row.current else f"data set {entry.dataset.version}",
        track or "",
        f"{len(entry.predictions)} seeds" if len(entry.predictions) > 1 else "",
        f"{row.diverged} diverged" if row.diverged else "",
        *(flag.name for flag in row.flags),
    ]
    return (rank, row.id, *values, time, speed_up, ", ".join(filter(None, remarks)))
