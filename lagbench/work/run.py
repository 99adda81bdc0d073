"""Run jobs here, in worker processes or on a Dask cluster, and count their work.

Results come in the order of the jobs; the place of the work does not change them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from .executor import Report, WorkItem, run_items

Job = TypeVar("Job")
Result = TypeVar("Result")

MIN_BYTES_FOR_WORKERS = 1 << 30
"""Bytes of files below which starting processes costs more than it gains."""


# --- jobs -----------------------------------------------------------------------------


def run_all(
    function: Callable[[Job, Report], Result],
    jobs: Mapping[str, Job],
    *,
    workers: int = 1,
    scheduler: str | None = None,
    report: Report = lambda _: None,
) -> list[Result]:
    """Run a function on jobs and return the results in the order of the jobs.

    Args:
        function: importable by its name from a module.
        jobs: argument of each call by its name, which messages use.
        workers: worker processes; with one, or one job, the work is done here.
        scheduler: address of a Dask scheduler, in place of workers.
        report: receives the units of work that the jobs have done.
    """
    if scheduler is None and (workers == 1 or len(jobs) == 1):
        return [function(job, report) for job in jobs.values()]
    items = []
    for name, job in jobs.items():
        items.append(WorkItem(name=name, function=function, argument=job))
    results: dict[str, Any] = {}
    for finished in run_items(items, workers=workers, scheduler=scheduler):
        results[finished.item.name] = finished.value
        report(finished.units)
    return [results[name] for name in jobs]


def read_many(
    function: Callable[[Job, Report], Result],
    jobs: Mapping[str, Job],
    files: Iterable[Path],
    report: Report,
    *,
    workers: int = 1,
    scheduler: str | None = None,
) -> list[Result]:
    """Run a function that reads files; small files are read in this process."""
    total_bytes = sum(path.stat().st_size for path in files if path.exists())
    if total_bytes < MIN_BYTES_FOR_WORKERS:
        return run_all(function, jobs, report=report)
    return run_all(function, jobs, workers=workers, scheduler=scheduler, report=report)


# --- progress -------------------------------------------------------------------------


_is_silent: ContextVar[bool] = ContextVar("is_silent", default=False)


def watched() -> bool:
    """Tell whether a person watches stderr; where it is closed, Python has none.

    Nobody does within :func:`silence`.
    """
    if _is_silent.get():
        return False
    return sys.stderr is not None and sys.stderr.isatty()


@contextmanager
def silence() -> Iterator[None]:
    """Show no progress on stderr meanwhile."""
    token = _is_silent.set(True)
    try:
        yield
    finally:
        _is_silent.reset(token)


@dataclass(frozen=True, kw_only=True)
class Progress:
    """Progress of a piece of work; training counts its steps as scenarios."""

    stage: str  # the present stage, in a word or two
    done: int  # units of work done: substeps, summed over scenarios, or files
    total: int  # units to do; 0 where nobody knows
    scenarios_done: int  # scenarios that are finished
    scenarios: int  # scenarios to finish; 0 where nobody knows
    seconds: float  # time since the start [s]
    # scenarios that were finished when the stage began; they took none of that time
    before: int = 0
    # what is counted as scenarios, in the plural; empty for the command's own word
    unit: str = ""

    @property
    def rate(self) -> float:
        """Scenarios finished per second since the start [1/s]."""
        if self.seconds > 0.0:
            return (self.scenarios_done - self.before) / self.seconds
        return 0.0


class Meter:
    """Counts work and tells a listener, where there is one, at every count."""

    def __init__(self, listener: Callable[[Progress], None] | None = None) -> None:
        self._listener = listener
        self.stage = ""  # the present stage
        self._progress = Progress(
            stage="", done=0, total=0, scenarios_done=0, scenarios=0, seconds=0.0
        )
        self._started = time.monotonic()

    def begin(
        self, stage: str, *, total: int, scenarios: int, done: int = 0, unit: str = ""
    ) -> None:
        """Start a stage with counts at zero, or where an earlier run stopped.

        Args:
            stage: the stage, in a word or two.
            total: units of work to do.
            scenarios: scenarios to finish.
            done: units that are done, and scenarios likewise: it suits stages of one
                unit each.
            unit: what is counted as scenarios, in the plural.
        """
        self.stage = stage
        self._progress = Progress(
            stage=stage,
            done=done,
            total=total,
            scenarios_done=done,
            scenarios=scenarios,
            seconds=0.0,
            before=done,
            unit=unit,
        )
        self._started = time.monotonic()
        self.count()

    def count(self, units: int = 0, *, scenarios: int = 0) -> None:
        """Add units of work (negative where work was lost) and finished scenarios."""
        old = self._progress
        self._progress = replace(
            old,
            stage=self.stage,
            done=old.done + units,
            scenarios_done=old.scenarios_done + scenarios,
            seconds=time.monotonic() - self._started,
        )
        if self._listener is not None:
            self._listener(self._progress)
