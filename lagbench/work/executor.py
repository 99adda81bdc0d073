"""Run calls in worker processes: those of this machine (loky) or of a Dask cluster.

A call of a lost worker is run again. Neither that nor the place of the work changes a
result.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, NamedTuple

from lagbench.errors import UsageError, WorkFailedError, require

from .machine import describe_machine

ATTEMPTS = 3
"""How often workers may die before the work is given up."""

CONNECT_SECONDS = 20  # how long a Dask scheduler may take to answer

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of workers: more threads would take the cores from other workers."""

WORKERS = "dask worker ADDRESS --nworkers -1 --nthreads 1"
"""The command that starts workers as they must be: one a core, each with one thread."""

Report = Callable[[int], None]
"""Function that an item calls with the units of work done since its last call."""


@dataclass(frozen=True, kw_only=True)
class WorkItem:
    """A call for a worker: ``function(argument, report)``, all of it picklable."""

    name: str  # name in messages, as in "cavity tiny scenario 3"
    function: Callable[[Any, Report], Any]  # importable by its name from a module
    argument: Any
    cost: float = 0.0  # expected work in any unit; the costliest items start first


class Finished(NamedTuple):
    """An item that is done."""

    item: WorkItem
    value: Any  # what its function has returned
    units: int  # units of work that it reported
    machine: dict[str, str]  # description of the machine that did it


def run_items(
    items: Iterable[WorkItem],
    *,
    workers: int = 1,
    scheduler: str | None = None,
    environment: Mapping[str, str] = ONE_THREAD,
) -> Generator[Finished, None, None]:
    """Run items in worker processes; yield each as it is done.

    Args:
        items: the calls.
        workers: worker processes at the most.
        scheduler: address of a Dask scheduler, whose workers run the items instead.
        environment: variables added to the environment of the workers of this machine.

    Raises:
        UsageError: the address is none of a scheduler.
        WorkFailedError: workers died again and again, or the cluster is lost.
    """
    waiting = sorted(items, key=lambda item: -item.cost)
    for _ in range(ATTEMPTS):
        if not waiting:
            return
        with _open_executor(
            min(workers, len(waiting)), scheduler, environment
        ) as executor:
            futures = {}
            for item in waiting:
                future = executor.submit(
                    _call, item, os.getpid(), version("lagbench"), scheduler
                )
                futures[future] = item
            for future in as_completed(futures):
                try:
                    finished: Finished = future.result()
                except BrokenProcessPool:
                    continue
                waiting.remove(futures[future])
                yield finished
    if waiting:
        raise WorkFailedError(
            f"worker processes died {ATTEMPTS} times; free memory, or take fewer "
            "--workers, then run the same command again",
            where=waiting[0].name,
        )


@contextmanager
def _open_executor(
    workers: int, scheduler: str | None, environment: Mapping[str, str]
) -> Iterator[Executor]:
    """Open the executor of this machine or of a cluster; an error stops its work."""
    if scheduler is not None:
        distributed = require("distributed", extra="cluster")
        try:
            client = distributed.Client(
                scheduler, timeout=CONNECT_SECONDS, set_as_default=False
            )
        except (OSError, ValueError) as error:
            kind = UsageError if isinstance(error, ValueError) else WorkFailedError
            raise kind(
                f"cannot reach the Dask scheduler ({error}); start one with `dask "
                f"scheduler` and workers with `{WORKERS}`",
                where=f"--scheduler {scheduler}",
            ) from error
        try:
            yield client.get_executor(pure=False)
        except (CancelledError, distributed.comm.CommClosedError) as error:
            raise WorkFailedError(
                "the Dask cluster is lost; start scheduler and workers, then run the "
                "same command again",
                where="--scheduler",
            ) from error
        except distributed.KilledWorker as error:
            raise WorkFailedError(
                f"workers of the Dask cluster died again and again: {error}; give "
                "them more memory, or leave --scheduler out",
                where="--scheduler",
            ) from error
        finally:
            client.close()
        return

    import loky

    # Workers of an earlier call are taken again: Taichi starts in seconds.
    executor = loky.get_reusable_executor(
        max_workers=workers,
        env=dict(environment),
        initializer=_begin,
        initargs=(tuple(sys.path),),
    )
    is_done = False
    try:
        yield executor
        is_done = True
    finally:
        if not is_done:
            executor.shutdown(wait=True, kill_workers=True)


def _begin(path: tuple[str, ...]) -> None:
    """Import from where the parent does, leave Ctrl-C to it, be silent on stdout."""
    sys.path[:] = path
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 1)


def _call(item: WorkItem, parent: int, wanted: str, scheduler: str | None) -> Finished:
    """Run an item in a worker."""
    if scheduler is not None:
        from distributed import get_worker

        worker = get_worker()
        threads = worker.state.nthreads
        if threads != 1 or version("lagbench") != wanted:
            # Taichi and HDF5 want a process for themselves; other versions, other bits
            raise WorkFailedError(
                f"a worker has {threads} threads and lagbench {version('lagbench')}; "
                f"install lagbench {wanted}, and start workers with `{WORKERS}`",
                where=f"worker {worker.address}",
            )
    total_units = 0

    def report(units: int) -> None:
        nonlocal total_units
        total_units += units
        if scheduler is None and os.getppid() != parent:
            os._exit(1)  # nobody waits for the result

    value = item.function(item.argument, report)
    return Finished(item, value, total_units, describe_machine("unknown"))
