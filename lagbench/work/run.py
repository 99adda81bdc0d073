"""Run jobs here, in worker processes, or on a Dask cluster; results come in the order of the jobs.

A job that a lost worker held is run again; that changes no result, so neither does where the
jobs ran.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from .cluster import Cluster
from .pool import Pool, Report, Task

__all__ = [
    "run_all",
]


Job = TypeVar("Job")
Result = TypeVar("Result")

ENVIRONMENT = {"OMP_NUM_THREADS": "1"}
"""Threads of a library would only take the cores from the other workers."""


def run_all(
    function: Callable[[Job, Report], Result],
    jobs: Mapping[str, Job],
    *,
    workers: int = 1,
    scheduler: str | None = None,
    report: Report = lambda _: None,
) -> list[Result]:
    """Run a function on jobs and return the results in the order of the jobs."""
    if scheduler is not None:
        return _with(Cluster(scheduler, ENVIRONMENT), function, jobs, report)
    if workers > 1 and len(jobs) > 1:
        return _with(Pool(min(workers, len(jobs)), ENVIRONMENT), function, jobs, report)
    return [function(job, report) for job in jobs.values()]


def _with(
    workers: Pool | Cluster,
    function: Callable[[Job, Report], Result],
    jobs: Mapping[str, Job],
    report: Report,
) -> list[Result]:
    results: dict[str, Result] = {}
    with workers as crew:
        for name, job in jobs.items():
            crew.submit(Task(name=name, function=function, arguments=(job,)))
        for event in crew.events():
            if event.kind == "done":
                results[event.task.name] = event.value
            else:
                report(event.value if event.kind == "progress" else -event.value)
    return [results[name] for name in jobs]
