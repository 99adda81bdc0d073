"""The output of commands: JSON for machines; tables, sentences, progress for people."""

from __future__ import annotations

import dataclasses
import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table as DrawnTable
from rich.text import Text

from lagbench.errors import escape_unprintable
from lagbench.figures.tables import Table
from lagbench.work.run import Progress, silence, watched

from .stderr import print_on_stderr

if TYPE_CHECKING:
    from lagbench.submission.issues import ValidationResult

PIPE_WIDTH = 120  # width of the output where it is no terminal [characters]

SECONDS_PER_LINE = 60.0  # time between two lines of progress that go to a file [s]

LONG = 100.0  # time of one scenario from which it is shown in minutes [s]

Listener = Callable[[Progress], None]


def format_bytes(count: float) -> str:
    """Return a number of bytes with a decimal unit.

    >>> format_bytes(4_720_000_000)
    '4.7 GB'
    """
    for unit in ("B", "kB", "MB", "GB"):
        if round(count) < 1000 or unit == "GB":
            break
        count /= 1000
    if round(count, 1) >= 100 or unit == "B":
        return f"{count:.0f} {unit}"
    return f"{count:.1f} {unit}"


def format_seconds(seconds: float) -> str:
    """Return a duration in the units that people use.

    >>> format_seconds(4000)
    '67 min'
    """
    if seconds < 100:
        return f"{max(seconds, 1):.0f} s"
    minutes = seconds / 60
    if minutes < 100:
        return f"{minutes:.0f} min"
    return f"{minutes / 60:.1f} h"


def print_line(text: str, *, quiet: bool = False) -> None:
    """Print a line on stdout unless the user asked for silence."""
    if not quiet:
        print(escape_unprintable(text))


def print_warning(text: str) -> None:
    """Print a warning on stderr."""
    print_on_stderr(f"warning: {text}")


def print_note(text: str) -> None:
    """Print on stderr what a command does meanwhile."""
    print_on_stderr(f"lagbench: {text}")


def print_json(value: object) -> None:
    """Print a value, a dataclass too, as one JSON object on stdout."""
    print(
        json.dumps(value, indent=2, sort_keys=True, allow_nan=False, default=_to_plain)
    )


def _to_plain(value: Any) -> object:  # noqa: ANN401
    """Return a value in types that JSON has; what is in it may still need this."""
    if dataclasses.is_dataclass(value):
        fields = dataclasses.fields(value)
        return {field.name: getattr(value, field.name) for field in fields}
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, (set, frozenset)):
        return list(value)
    message = f"no JSON for {type(value).__name__}"
    raise TypeError(message)


def print_result(
    value: object, lines: Iterable[str], *, as_json: bool, quiet: bool = False
) -> None:
    """Print a result as one JSON object, or as lines of text.

    The lines are formed only where they are printed: they may come from a generator.
    """
    if as_json:
        print_json(value)
    elif not quiet:
        for line in lines:
            print_line(line)


def print_errors(result: ValidationResult) -> None:
    """Print on stderr all errors of a file but the deciding one.

    The command then ends with that one.
    """
    for error in result.errors:
        if error is not result.deciding:
            print_on_stderr(str(error))


def print_tables(tables: Iterable[Table]) -> None:
    """Print tables, one below the other."""
    for table in tables:
        print_table(table.title, table.columns, table.rows)


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]
) -> None:
    """Print a table on stdout; columns of numbers are set flush right.

    Only the last column wraps. On a narrow terminal lines run on to the next: a number
    cut short would be worse.
    """
    cells = [[escape_unprintable(str(cell)) for cell in row] for row in rows]
    table = DrawnTable(
        box=SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False, show_edge=False
    )
    last = len(columns) - 1
    for number, heading in enumerate(columns):
        is_numeric = all(row[number][:1] in "0123456789-" for row in cells)
        table.add_column(
            Text(heading),
            justify="right" if is_numeric else "left",
            no_wrap=number < last,
        )
    for texts in cells:
        table.add_row(*map(Text, texts))

    console = Console(soft_wrap=True)
    width = console.width
    if not console.is_terminal and "COLUMNS" not in os.environ:
        width = PIPE_WIDTH  # equal files everywhere
    options = console.options.update(max_width=10_000)
    least_width = Measurement.get(console, options, table).minimum
    console.width = max(width, least_width)
    if title:
        # beside the table, not in it: a table wraps its title to its own width
        console.print(Text(escape_unprintable(title), style="table.title"))
    console.print(table, "")  # and an empty line


# --- progress: a bar where a person watches, else a line now and then -----------------


@contextmanager
def progress_bar(
    *,
    quiet: bool,
    unit: str = "scenarios",
    seconds_per_line: float = SECONDS_PER_LINE,
) -> Iterator[Listener | None]:
    """Yield a function that shows progress: the share done, the rate and the time left.

    A terminal shows a bar. A file or a pipe gets a line per minute by default, so that
    short work prints none.

    Args:
        quiet: whether to show nothing; None is yielded then.
        unit: what the work is counted in, where its stage has no word of its own.
        seconds_per_line: time between two lines that go to a file or a pipe [s].
    """
    if quiet:
        with silence():
            yield None
        return
    if not watched():
        yield _print_lines(unit, seconds_per_line)
        return

    # Commands without a bar do not load its library.
    from rich import progress as bars

    columns = (
        bars.TextColumn("{task.description}"),
        bars.BarColumn(),
        bars.TaskProgressColumn(),
        bars.TextColumn("{task.fields[count]}"),
        bars.TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with bars.Progress(*columns, console=console, transient=True) as display:
        task = display.add_task("starting", total=None, count="")

        def update_bar(progress: Progress) -> None:
            display.update(
                task,
                description=progress.stage,
                completed=progress.done,
                total=progress.total or None,
                count=_format_rate(progress, unit),
            )

        yield update_bar


def _print_lines(unit: str, seconds_per_line: float) -> Listener:
    """Return a function that prints a line, at most one in some seconds."""
    last_time = time.monotonic()

    def print_progress(progress: Progress) -> None:
        nonlocal last_time
        now = time.monotonic()
        if now - last_time < seconds_per_line:
            return
        last_time = now

        parts = []
        if progress.total:
            parts.append(f"{progress.done / progress.total:.0%}")
        rate = _format_rate(progress, unit)
        if rate:
            parts.append(rate)
        if progress.scenarios and progress.rate:
            seconds_left = (
                progress.scenarios - progress.scenarios_done
            ) / progress.rate
            parts.append(f"{format_seconds(seconds_left)} left")
        print_on_stderr(f"{progress.stage}: {', '.join(parts)}")

    return print_progress


def _format_rate(progress: Progress, unit: str) -> str:
    """Return how many units are done, and the rate.

    A rate below one unit a second is shown as the time of one unit. An empty text where
    the work has no such units.
    """
    if not progress.scenarios and not progress.scenarios_done:
        return ""
    unit = progress.unit or unit
    count = f"{progress.scenarios_done}"
    if progress.scenarios:
        count = f"{count}/{progress.scenarios}"
    rate = progress.rate
    if rate <= 0.0:
        return f"{count} {unit}"
    if rate >= 1.0:
        return f"{count} {unit}, {rate:.2f}/s"
    seconds = 1.0 / rate
    duration = f"{seconds:.1f} s"
    if seconds >= LONG:
        duration = format_seconds(seconds)
    return f"{count} {unit}, {duration} per {unit.removesuffix('s')}"
