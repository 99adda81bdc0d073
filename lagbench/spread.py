"""Run jobs here, in worker processes, or on a Dask cluster; results come in the order of the jobs.

A job that a lost worker held is run again; that changes no result, so neither does where the
jobs ran.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

from .errors import UsageError, WorkFailedError
from .extras import require
from .pool import Pool, Report, Task

__all__ = ["spread"]

Job = TypeVar("Job")
Result = TypeVar("Result")

CONNECT_SECONDS = 20
"""How long a Dask scheduler may take to answer."""

POLL_SECONDS = 0.02
"""Pause between two looks at a Dask cluster [s]."""

LOST_SECONDS = 60.0
"""How long a Dask cluster may be without any worker."""

LOGGERS = ("distributed", "distributed.client", "distributed.comm", "distributed.core")
"""Loggers that print when a cluster is lost."""


def spread(
    function: Callable[[Job, Report], Result],
    jobs: Mapping[str, Job],
    *,
    workers: int = 1,
    scheduler: str | None = None,
    report: Report = lambda _: None,
) -> list[Result]:
    """Run a function on jobs and return the results in the order of the jobs.

    Args:
        function: importable by its name; takes a job and what to tell of units of work done.
        jobs: jobs by the name that messages call them.
        workers: worker processes; with one, or one job, all is done in this process.
        scheduler: address of a Dask scheduler, instead of worker processes; its workers must
            see the same files under the same paths.
        report: told the units of work done, negative where they were lost with a worker.

    Raises:
        LagbenchError: what a job raised.
        UsageError: Dask's distributed is not installed, or the address cannot be one.
        WorkFailedError: workers died too often, or the cluster cannot be reached or is lost.
    """
    if scheduler is not None:
        return _on_cluster(function, jobs, scheduler, report)
    if workers > 1 and len(jobs) > 1:
        return _in_processes(function, jobs, min(workers, len(jobs)), report)
    return [function(job, report) for job in jobs.values()]


def _in_processes(
    function: Callable[[Job, Report], Result], jobs: Mapping[str, Job], workers: int, report: Report
) -> list[Result]:
    results: dict[str, Result] = {}
    with Pool(workers, environment={"OMP_NUM_THREADS": "1"}) as pool:
        for name, job in jobs.items():
            pool.submit(Task(name=name, function=function, arguments=(job,)))
        for event in pool.events():
            if event.kind == "done":
                results[event.task.name] = event.value
            else:
                report(event.value if event.kind == "progress" else -event.value)
    return [results[name] for name in jobs]


def _on_cluster(
    function: Callable[[Job, Report], Result], jobs: Mapping[str, Job], address: str, report: Report
) -> list[Result]:
    with _quiet(), _connected(address) as client:
        # the scheduler runs what a killed worker held on another one
        futures = client.map(partial(_alone, function), list(jobs.values()), pure=False, key="lagbench")
        return _gather(client, dict(zip(jobs, futures, strict=True)), report)


def _alone(function: Callable[[Job, Report], Result], job: Job) -> tuple[Result, int]:
    """Run a job on a cluster's worker and count its units of work."""
    units = [0]

    def count(done: int) -> None:
        units[0] += done

    return function(job, count), units[0]


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    distributed = require("distributed", extra="cluster")
    try:
        client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        bad = isinstance(error, ValueError)
        raise (UsageError if bad else WorkFailedError)(
            "cannot reach the Dask scheduler",
            where=f"--scheduler {address}",
            expected="the address of a running scheduler, as in tcp://10.0.0.5:8786",
            got=f"{type(error).__name__}: {error}",
            fix="start one with `dask scheduler` and workers with `dask worker ADDRESS`",
        ) from error
    try:
        yield client
    except (CancelledError, distributed.comm.CommClosedError) as error:
        raise _lost(error) from error
    finally:
        client.close()


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask's logs off the terminal: what matters of them becomes an error of ours.

    After an error they stay off: a client that lost its scheduler logs until the process ends.
    """
    require("distributed", extra="cluster")  # its import sets the levels of its loggers
    levels = {name: logging.getLogger(name).level for name in LOGGERS}
    for name in LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    yield
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


def _lost(got: object) -> WorkFailedError:
    return WorkFailedError(
        "the Dask cluster is lost",
        where="--scheduler",
        got=f"{type(got).__name__}: {got}" if isinstance(got, Exception) else got,
        fix="start scheduler and workers, then run the same command again",
    )


def _gather(client: Any, futures: Mapping[str, Any], report: Report) -> list[Any]:  # noqa: ANN401
    """Fetch results as they come; fail when the cluster has no worker for a minute."""
    results: dict[str, Any] = {}
    alive = time.monotonic()
    while len(results) < len(futures):
        for name, future in futures.items():
            if name not in results and future.done():
                results[name], units = _fetch(name, future)
                report(units)
        if _has_workers(client):
            alive = time.monotonic()
        if client.status in ("closed", "failed") or time.monotonic() - alive > LOST_SECONDS:
            raise _lost(f"{client.status}, no worker for {time.monotonic() - alive:.0f} s")
        time.sleep(POLL_SECONDS)
    return [results[name] for name in futures]


def _has_workers(client: Any) -> bool:  # noqa: ANN401
    try:
        return client.status == "running" and bool(client.scheduler_info()["workers"])
    except OSError:  # the connection broke since the status was set
        return False


def _fetch(name: str, future: Any) -> Any:  # noqa: ANN401
    killed = require("distributed", extra="cluster").KilledWorker
    try:
        return future.result()
    except killed as error:
        raise WorkFailedError(
            "workers of the Dask cluster died again and again",
            where=name,
            got=str(error),
            fix="give the workers more memory, or leave --scheduler out",
        ) from error
    except (CancelledError, OSError) as error:
        if future.status == "error":  # the job itself raised it
            raise
        raise _lost(error) from error
