"""Draw how each kind of method loses on the subset shift, and print the table.

    python -m studies.shift_figure -o docs/figures/shift.svg [--board leaderboard]

Of every kind (naive, classical, learned, hybrid) the method stands there that is best
on ``test`` among those that were scored on ``shift``. A line leads from its score on
``test`` to its score on ``shift``; thin lines are the other methods. Committed files
suffice: the board with shift.yaml, and the shipped scores of the reference predictors.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.board.build import Scope, collect
from lagbench.board.folder import Folder
from lagbench.board.model import OnShift, ReferenceRow, Tab
from lagbench.data.registry import load
from lagbench.errors import LagbenchError, UsageError
from lagbench.figures.chart import AxisScale, Plot, Spot, Tick, close_logarithmic
from lagbench.figures.html import Markup
from lagbench.figures.numbers import words
from lagbench.figures.tables import markdown

from .panels import join_charts

KINDS = ("naive", "classical", "learned", "hybrid")
SHIFT = "shift"  # the subset
HEIGHT = 420
SIDES = AxisScale(-0.2, 2.2, False, 0, (Tick(0.0, "test"), Tick(1.0, "shift")))
"""Test and shift side by side; the names of the methods stand to the right."""


@dataclass(frozen=True, kw_only=True)
class ShiftedRow:
    """A method with its scores on both subsets."""

    name: str
    kind: str
    test: float  # ranking metric, mean over scenarios
    shift: float
    skill: float | None  # on test; None without a naive baseline
    skill_on_shift: float | None


def collect_shifted(board: Path, size: str) -> list[tuple[Tab, list[ShiftedRow]]]:
    """Return the data sets of a size with methods that were scored on shift.

    Raises:
        UsageError: there is no such data set, or no board.
    """
    registry = load()
    places = set()
    for path in Folder(board).entries():
        split = path.parts[1]
        if path.parts[2] == size and SHIFT in registry.size(split, size).subsets:
            places.add((split, size))
    scope = Scope(metrics=(), intervals=(), has_pictures=False)
    chosen = []
    for tab in collect(board, only=places, scope=scope).tabs:
        rows = rows_of(tab)
        if rows:
            chosen.append((tab, rows))
    if not chosen:
        raise UsageError(
            "no method was scored on shift",
            where="--board, --size",
            expected="a size with scores on shift, such as mini",
            got=f"{board}, {size!a}",
            fix="name another size, or another board",
        )
    return chosen


def rows_of(tab: Tab) -> list[ShiftedRow]:
    """Return the active entries and the reference predictors with both scores."""
    rows = []
    for row in tab.rows:
        if not row.active or row.on_shift is None:
            continue
        shifted = ShiftedRow(
            name=row.entry.name,
            kind=str(row.entry.kind),
            test=row.values[tab.ranking].mean,
            shift=row.on_shift.score.mean,
            skill=None if row.skill is None else row.skill.mean,
            skill_on_shift=_skill_of(row.on_shift),
        )
        rows.append(shifted)
    for reference in tab.references:
        if reference.on_shift is not None:
            rows.append(_row_of_reference(reference, tab))
    return sorted(rows, key=lambda row: row.test)


def _row_of_reference(reference: ReferenceRow, tab: Tab) -> ShiftedRow:
    score = reference.values[tab.ranking].mean
    skill = None
    if tab.best_naive is not None:
        skill = 1.0 - score / tab.best_naive
    on_shift = reference.on_shift
    if on_shift is None:
        raise ValueError(f"{reference.name} was not scored on shift")
    return ShiftedRow(
        name=reference.name,
        kind=str(reference.kind),
        test=score,
        shift=on_shift.score.mean,
        skill=skill,
        skill_on_shift=_skill_of(on_shift),
    )


def _skill_of(on_shift: OnShift) -> float | None:
    if on_shift.skill is None:
        return None
    return on_shift.skill.mean


def best_of_kinds(rows: Sequence[ShiftedRow]) -> list[ShiftedRow]:
    """Return the row of each kind that is best on test."""
    best = []
    for kind in KINDS:
        of_kind = [row for row in rows if row.kind == kind]
        if of_kind:
            best.append(min(of_kind, key=lambda row: row.test))
    return best


def draw(tab: Tab, rows: Sequence[ShiftedRow]) -> Markup:
    """Return the chart of a data set."""
    name = f"{tab.size.split} {tab.size.name}"
    values = []
    for row in rows:
        values += [row.test, row.shift]
    plot = Plot(
        SIDES,
        close_logarithmic(min(values), max(values)),
        x_label="",
        y_label=f"{name}: {words(tab.ranking)}",
        height=HEIGHT,
    )
    best = best_of_kinds(rows)
    for row in rows:
        if row not in best:
            title = f"{row.name}: {row.test:.3g} on test, {row.shift:.3g} on shift"
            plot.line([0.0, 1.0], [row.test, row.shift], f"thin {row.kind}", title)
    spots = []
    for row in best:
        plot.line([0.0, 1.0], [row.test, row.shift], row.kind)
        description = f"{row.name}, {row.kind}: {row.test:.3g} on test"
        spots.append(
            Spot(x=0.0, y=row.test, name="", description=description, kind=row.kind)
        )
        description = f"{row.name}, {row.kind}: {row.shift:.3g} on shift"
        spots.append(
            Spot(
                x=1.0,
                y=row.shift,
                name=row.name,
                description=description,
                kind=row.kind,
            )
        )
    plot.spots(spots)
    return plot.svg(name, f"{name}: scores of {len(rows)} methods on test and shift.")


def table(tabs: Sequence[tuple[Tab, Sequence[ShiftedRow]]]) -> str:
    """Return the best method of each kind on test and on shift, as Markdown."""
    heads = (
        "data set",
        "kind",
        "best on test",
        "test",
        "shift",
        "shift / test",
        "skill",
        "skill on shift",
    )
    cells = []
    for tab, rows in tabs:
        for row in best_of_kinds(rows):
            cells.append(
                (
                    f"{tab.size.split} {tab.size.name}",
                    row.kind,
                    row.name,
                    f"{row.test:.3g}",
                    f"{row.shift:.3g}",
                    f"{row.shift / row.test:.2f}",
                    _number(row.skill),
                    _number(row.skill_on_shift),
                )
            )
    return markdown(heads, cells)


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the figure and print the table; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m studies.shift_figure",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--board", type=Path, default=Path("leaderboard"))
    parser.add_argument("--size", default="mini")
    parser.add_argument(
        "--output", "-o", type=Path, default=Path("docs/figures/shift.svg")
    )
    options = parser.parse_args(arguments)
    try:
        chosen = collect_shifted(options.board, options.size)
        charts = [draw(tab, rows) for tab, rows in chosen]
        svg = join_charts(charts, height=HEIGHT)
        write_atomically(options.output, svg.encode(), option="--output")
    except LagbenchError as error:
        sys.stderr.write(f"error: {error}\n")
        return error.exit_code
    sys.stdout.write(f"{table(chosen)}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
