"""What commands print: JSON for machines, tables and sentences for people.

Progress on stderr: a bar where a person watches, else a line per minute.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from lagbench.figures.tables import Table
from lagbench.work.progress import watched

if TYPE_CHECKING:
    from lagbench.submission.issues import ValidationResult
    from lagbench.work.progress import Progress as State

WIDTH = 80  # characters that a table may be wide; a wider one comes in blocks
GAP = 3  # characters between two columns
LAST = 24  # characters to which the last column, which wraps, may shrink
SECONDS_PER_LINE = 60.0  # time between two lines of progress that go to a file [s]


def counted(number: int, noun: str) -> str:
    """Return a number with its noun.

    >>> counted(1, "finding"), counted(2, "entry")
    ('1 finding', '2 entries')
    """
    if noun.endswith("y"):
        many = f"{noun[:-1]}ies"
    else:
        many = f"{noun}s"
    return f"{number} {noun if number == 1 else many}"


def say(text: str, *, quiet: bool = False) -> None:
    """Print a line on stdout unless the user asked for silence."""
    if not quiet:
        typer.echo(text)


def print_json(value: object) -> None:
    """Print a value, a dataclass too, as one JSON object on stdout."""
    typer.echo(json.dumps(_plain(value), indent=2, sort_keys=True, allow_nan=False))


def show(
    value: object, words: Iterable[str], *, as_json: bool, quiet: bool = False
) -> None:
    """Print a result as one JSON object, or the lines that say it in words, formed only
    then.
    """
    if as_json:
        print_json(value)
    elif not quiet:
        for line in words:
            typer.echo(line)


def complain(result: ValidationResult) -> None:
    """Tell on stderr what rejects a file; the error that follows names the first
    finding only.
    """
    if len(result.errors) > 1:
        typer.echo("\n".join(str(finding) for finding in result.errors), err=True)


def blocks(table: Table, width: int = WIDTH) -> Iterator[Table]:
    """Yield a table in pieces that are no wider, each with the columns that say what a
    row is.
    """
    columns = list(zip(table.columns, *table.rows, strict=True))
    widths = [
        max(len(line) for cell in column for line in cell.split("\n"))
        for column in columns
    ]
    widths[-1] = min(widths[-1], LAST)
    own = sum(widths[: table.keys]) + GAP * table.keys
    chosen = list[list[int]]([[]])
    for i in range(table.keys, len(columns)):
        taken = own + sum(widths[j] + GAP for j in chosen[-1])
        if chosen[-1] and taken + widths[i] > width:
            chosen.append([])
        chosen[-1].append(i)
    for number, block in enumerate(chosen):
        heads, *rows = zip(
            *columns[: table.keys], *(columns[i] for i in block), strict=True
        )
        yield Table("" if number else table.title, heads, tuple(rows), table.keys)


def print_blocks(tables: Iterable[Table]) -> None:
    """Print tables in blocks that fit."""
    for table in tables:
        for block in blocks(table):
            print_table(block.title, block.columns, block.rows)


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)
        }
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    return value


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Print a table on stdout; only its last column wraps, numbers stand on the
    right.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table as Drawn
    from rich.text import Text

    cells = [[str(cell) for cell in row] for row in rows]
    if title:
        heading = Text(title)
    else:
        heading = None
    table = Drawn(
        title=heading,
        box=SIMPLE_HEAD,
        title_justify="left",
        pad_edge=False,
        show_edge=False,
    )
    for number, column in enumerate(columns, start=1):
        numeric = all(row[number - 1][:1] in "0123456789-" for row in cells)
        table.add_column(
            Text(column),
            justify="right" if numeric else "left",
            no_wrap=number < len(columns),
        )
    for row in cells:
        table.add_row(*(Text(cell) for cell in row))
    console = Console()
    # In a file or a pipe the width is fixed, so that the output is the same everywhere.
    if console.is_terminal:
        width = console.width
    else:
        width = 120
    # On a narrow terminal long lines run on to the next: a number cut short would be
    # worse.
    widths = [max(map(len, column)) for column in zip(columns, *cells, strict=True)]
    least = sum(widths[:-1]) + min(widths[-1], LAST) + GAP * len(widths)
    Console(width=max(width, least)).print(table, "")


def spell_bytes(count: float) -> str:
    """Return a number of bytes with a decimal unit.

    >>> spell_bytes(4_720_000_000)
    '4.7 GB'
    """
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000 or unit == "GB":
            break
        count /= 1000
    if count >= 100 or unit == "B":
        return f"{count:.0f} {unit}"
    return f"{count:.1f} {unit}"


def spell_seconds(seconds: float) -> str:
    """Return a duration in the units that people use.

    >>> spell_seconds(4000)
    '67 min'
    """
    if seconds < 100:
        return f"{max(seconds, 1):.0f} s"
    minutes = seconds / 60
    if minutes < 100:
        return f"{minutes:.0f} min"
    return f"{minutes / 60:.1f} h"


@contextmanager
def progress_bar(
    *, quiet: bool, counted: str = "scenarios"
) -> Iterator[Callable[[State], None] | None]:
    """Yield what tells of progress: how much is done, how fast, and the time left; None
    for silence.

    A terminal shows a bar; a file or a pipe gets a line per minute, so that short work
    leaves none. ``counted`` is what the work is counted in.
    """
    if quiet:
        from lagbench.store.copy import silence_fetching

        with silence_fetching():
            yield None
        return
    if not watched():
        yield _in_lines(counted)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    stage = TextColumn("{task.description}")
    count = TextColumn("{task.fields[count]}")
    columns = (stage, BarColumn(), TaskProgressColumn(), count, TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=None, count="")

        def draw(news: State) -> None:
            told: dict[str, Any] = {
                "description": news.stage,
                "count": _count(news, counted),
            }
            bar.update(task, total=news.total or None, completed=news.done, **told)

        yield draw


def _in_lines(counted: str) -> Callable[[State], None]:
    last = time.monotonic()

    def tell(news: State) -> None:
        nonlocal last
        if (now := time.monotonic()) - last < SECONDS_PER_LINE:
            return
        last = now
        known = news.scenarios and news.rate
        if known:
            left = (news.scenarios - news.scenarios_done) / news.rate
        else:
            left = math.inf
        if math.isfinite(left):
            still = f", {spell_seconds(left)} left"
        else:
            still = ""
        if news.total:
            share = f"{news.done / news.total:.0%}, "
        else:
            share = ""
        with suppress(OSError):  # the work goes on without a reader
            typer.echo(f"{news.stage}: {share}{_count(news, counted)}{still}", err=True)

    return tell


def _count(news: State, counted: str) -> str:
    if news.scenarios:
        of = f"/{news.scenarios}"
    else:
        of = ""
    return f"{news.scenarios_done}{of} {counted}, {news.rate:.2f}/s"
