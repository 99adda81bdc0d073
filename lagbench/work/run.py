"""Run jobs here, in worker processes, or on a Dask cluster; results come in the order
of the jobs.

A job that a lost worker held is run again; that changes no result, so neither does
where the jobs ran.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from . import pool
from .cluster import Cluster
from .pool import Pool, Report, Task

Job = TypeVar("Job")
Result = TypeVar("Result")

# bytes of files below which starting processes to read them costs more than it gains
WORTH_WORKERS = 1 << 30
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of workers: threads of NumPy and HDF5 would only take the cores from the
others.

A Dask worker has it from Dask.
"""


def run_all(
    function: Callable[[Job, Report], Result],
    jobs: Mapping[str, Job],
    *,
    workers: int = 1,
    scheduler: str | None = None,
    report: Report = lambda _: None,
) -> list[Result]:
    """Run a function on jobs and return the results in the order of the jobs; here
    where no workers start.
    """
    if scheduler is not None:
        return _with(Cluster(scheduler), function, jobs, report)
    if workers > 1 and len(jobs) > 1 and pool.AVAILABLE:
        return _with(Pool(min(workers, len(jobs)), ONE_THREAD), function, jobs, report)
    return [function(job, report) for job in jobs.values()]


def read_many(
    function: Callable[[Job, Report], Result],
    jobs: Mapping[str, Job],
    files: Iterable[Path],
    report: Report,
    *,
    workers: int = 1,
    scheduler: str | None = None,
) -> list[Result]:
    """Run a function that reads files: here where they hold little, else by the
    workers.
    """
    if sum(path.stat().st_size for path in files if path.exists()) < WORTH_WORKERS:
        return run_all(function, jobs, report=report)
    return run_all(function, jobs, workers=workers, scheduler=scheduler, report=report)


def _with(
    workers: Pool | Cluster,
    function: Callable[[Job, Report], Result],
    jobs: Mapping[str, Job],
    report: Report,
) -> list[Result]:
    results: dict[str, Result] = {}
    with workers as team:
        for name, job in jobs.items():
            team.submit(Task(name=name, function=function, arguments=(job,)))
        for event in team.events():
            if event.kind == "done":
                results[event.task.name] = event.value
            else:
                report(event.value if event.kind == "progress" else -event.value)
    return [results[name] for name in jobs]
