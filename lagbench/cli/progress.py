"""A progress bar on stderr, drawn only where a person watches."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lagbench.progress import Progress as State

__all__ = ["progress_bar"]


@contextmanager
def progress_bar(*, quiet: bool, counted: str = "scenarios") -> Iterator[Callable[[State], None] | None]:
    """Yield what draws progress: overall bar, scenarios, scenarios per second, time left.

    Args:
        quiet: whether the user wants silence.
        counted: what the work is counted in.

    Yields:
        A function to hand to ``generate``; None where stderr is no terminal or silence is wanted.
    """
    if quiet:
        from lagbench.store.fetching import quietly

        with quietly():
            yield None
        return
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TextColumn("{task.fields[count]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=None, count="")

        def draw(news: State) -> None:
            bar.update(
                task,
                description=news.stage,
                total=news.total,
                completed=news.done,
                count=f"{news.scenarios_done}/{news.scenarios} {counted}, {news.rate:.2f}/s",
            )

        yield draw
