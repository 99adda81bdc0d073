"""Run jobs in this process, in worker processes, or on a Dask cluster.

Results come in the order of the jobs. A job of a lost worker is run again. Neither that
nor the place of the work changes a result.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeVar

from . import pool
from .cluster import Cluster
from .pool import Pool, Report, WorkItem

Job = TypeVar("Job")
Result = TypeVar("Result")

MIN_BYTES_FOR_WORKERS = 1 << 30
"""Bytes of files below which starting processes costs more than it gains."""

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of workers.

Threads of NumPy and HDF5 would only take the cores from other workers. Dask sets it for
its own workers.
"""


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
    if scheduler is not None:
        return _run_with(Cluster(scheduler), function, jobs, report)
    if workers > 1 and len(jobs) > 1 and pool.AVAILABLE:
        worker_pool = Pool(min(workers, len(jobs)), ONE_THREAD)
        return _run_with(worker_pool, function, jobs, report)
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
    """Run a function that reads files; small files are read in this process."""
    total_bytes = sum(path.stat().st_size for path in files if path.exists())
    if total_bytes < MIN_BYTES_FOR_WORKERS:
        return run_all(function, jobs, report=report)
    return run_all(function, jobs, workers=workers, scheduler=scheduler, report=report)


def _run_with(
    workers: Pool | Cluster,
    function: Callable[[Job, Report], Result],
    jobs: Mapping[str, Job],
    report: Report,
) -> list[Result]:
    results: dict[str, Result] = {}
    with workers as team:
        for name, job in jobs.items():
            team.submit(WorkItem(name=name, function=function, arguments=(job,)))
        for event in team.events():
            if event.kind == "done":
                results[event.item.name] = event.value
            elif event.kind == "progress":
                report(event.value)
            else:  # the work of a lost worker was in vain
                report(-event.value)
    return [results[name] for name in jobs]
