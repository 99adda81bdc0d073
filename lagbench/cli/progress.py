"""Progress on stderr: a bar where a person watches, else a line now and then."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    TaskProgressColumn,
    TextColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as ProgressDisplay

from lagbench.store.copy import silence_fetching
from lagbench.work.progress import Progress, watched

from .output import format_seconds, print_note
from .stderr import print_on_stderr

SECONDS_PER_LINE = 60.0  # time between two lines of progress that go to a file [s]

LONG = 100.0  # time of one scenario from which it is shown in minutes [s]

Listener = Callable[[Progress], None]


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
        with silence_fetching():
            yield None
        return
    if not watched():
        yield _print_lines(unit, seconds_per_line)
        return

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[count]}"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with ProgressDisplay(*columns, console=console, transient=True) as display:
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


def note_at_start(note: str, listener: Listener | None) -> Listener:
    """Return a listener that prints a note before the first progress.

    Work that is refused makes no progress, so its user reads the error alone.

    Args:
        note: what the command says as its work begins.
        listener: shows all progress, the first one too; may be None.
    """
    has_begun = False

    def show_progress(progress: Progress) -> None:
        nonlocal has_begun
        if not has_begun:
            has_begun = True
            print_note(note)
        if listener is not None:
            listener(progress)

    return show_progress


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
        seconds_left = _seconds_left(progress)
        if math.isfinite(seconds_left):
            parts.append(f"{format_seconds(seconds_left)} left")
        print_on_stderr(f"{progress.stage}: {', '.join(parts)}")

    return print_progress


def _seconds_left(progress: Progress) -> float:
    """Return the time that the rest takes [s]; infinity where it cannot be known."""
    if not progress.scenarios or not progress.rate:
        return math.inf
    return (progress.scenarios - progress.scenarios_done) / progress.rate


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
