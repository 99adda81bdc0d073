"""The workers of a Dask cluster, used like the :class:`.Pool` of this machine.

The scheduler runs what a lost worker held on another one. A lost scheduler ends the
work with an error; results that have arrived by then are not lost. A task runs in the
worker itself, which must have one thread: Taichi and HDF5 want a process for
themselves. How far a task is comes as Dask events.

A cluster writes a data set to one folder on storage that all its machines share. A mark
with a random word shows that a worker's folder of that path is the client's. Network
file systems remember for a while that a file was missing; listing its folder makes them
look again.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import queue
import secrets
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from lagbench.atomic import check_writable, temporary_name, write_atomically
from lagbench.errors import LagbenchError, UsageError, WorkFailedError, require

from .machine import environment_of
from .pool import Event, Task, crashed

PATIENCE = 30.0  # how long a file of another machine may take to appear [s]
PAUSE = 0.1  # pause between two looks for a file [s]
TELL_SECONDS = 0.5  # time between two events that tell how far a task is [s]
CONNECT_SECONDS = 20  # how long a Dask scheduler may take to answer
POLL_SECONDS = 0.02  # pause between two looks at the tasks [s]
LOOK_SECONDS = 1.0  # pause between two looks at the workers [s]
LOST_SECONDS = 60.0  # how long a Dask cluster may be without any worker
STOP_SECONDS = 5  # how long to wait for the workers to hear that they shall stop
WORKERS = "dask worker ADDRESS --nworkers -1 --nthreads 1"
"""The command that starts workers as they must be: one a core, each with one thread."""

LOGGERS = ("distributed", "distributed.client", "distributed.comm", "distributed.core")
"""Loggers that print when a cluster is lost."""


# --- a folder that several machines write to ------------------------------------------


@dataclass(frozen=True)
class Mark:
    """A file by which a worker knows the client's folder."""

    path: Path  # where it stands
    word: str  # what it holds
    patience: float  # how long it may take to appear [s]

    def check(self, worker: str) -> None:
        """See that the folder is here and can be written to."""
        folder = self.path.parent
        if not _appears(self.path, self.patience, holding=self.word):
            raise WorkFailedError(
                "a worker does not see the folder of the data set",
                where=f"{folder}, worker {worker}",
                expected="one folder under the same path on every worker and here",
                got="another folder" if folder.is_dir() else "no such folder",
                fix="name a folder on storage that all of them share: --root",
            )
        check_writable(folder)
        for place in folder.iterdir():
            if place.is_dir():
                _look_again(place)


@contextmanager
def marked(folder: Path) -> Iterator[Mark]:
    """Keep a mark in a folder."""
    mark = Mark(temporary_name(folder / "mark"), secrets.token_hex(16), PATIENCE)
    write_atomically(mark.path, mark.word.encode())
    try:
        yield mark
    finally:
        mark.path.unlink(missing_ok=True)


def await_file(path: Path) -> None:
    """Wait until a file that another machine has written is seen here."""
    if not _appears(path, PATIENCE):
        what = "a worker's file does not appear"
        expected = f"a file within {PATIENCE:.0f} s"
        fix = "name a folder on storage that all machines share, then run the same command again"
        raise WorkFailedError(what, where=str(path), expected=expected, fix=fix)


def _appears(path: Path, patience: float, *, holding: str | None = None) -> bool:
    end = time.monotonic() + patience
    while True:
        _look_again(path.parent)
        # Another machine may see the name before the content.
        if path.is_file() and (
            holding is None or path.read_text(encoding="utf-8") == holding
        ):
            return True
        if time.monotonic() > end:
            return False
        time.sleep(PAUSE)


def _look_again(folder: Path) -> None:
    with contextlib.suppress(OSError):
        os.listdir(folder)


# --- in a worker ----------------------------------------------------------------------

_STOPPED: set[str] = set()  # clients whose tasks are void


@dataclass(frozen=True)
class Client:
    """For whom a worker works."""

    name: str  # topic of the events that tell of its tasks
    version: str  # its version of lagbench
    # what shows that the worker sees its folder; None where none is needed
    mark: Mark | None = None

    def check(self, worker: str, *, threads: int) -> None:
        """Refuse a worker that could not make the client's bits."""
        where = f"worker {worker}"
        own = version("lagbench")
        if self.version != own:
            fix = "install the same version on every worker"
            what = "a worker runs another version of lagbench"
            raise WorkFailedError(
                what, where=where, expected=self.version, got=own, fix=fix
            )
        if threads != 1:
            what = "a worker runs several tasks in one process"
            fix = f"start the workers with `{WORKERS}`"
            raise WorkFailedError(
                what,
                where=where,
                expected="1 thread",
                got=f"{threads} threads",
                fix=fix,
            )
        if self.mark is not None:
            self.mark.check(worker)


class Done(NamedTuple):
    """What became of a task."""

    value: Any  # its result
    units: int  # units of work done
    machine: dict[str, str]  # what identity says of the machine that did it


def run_task(task: Task, number: int, client: Client) -> Done:
    """Run a client's task in this process, the only thread of a Dask worker."""
    from distributed import get_worker

    worker = get_worker()
    client.check(worker.address, threads=worker.state.nthreads)
    units = 0
    told = time.monotonic()

    def report(done: int) -> None:
        nonlocal units, told
        units += done
        # Dask cannot stop a thread: a task ends itself when nobody waits for it any
        # more.
        if client.name in _STOPPED:
            raise WorkFailedError("the client is gone", where=task.name)
        if time.monotonic() - told >= TELL_SECONDS:
            told = time.monotonic()
            worker.log_event(client.name, [number, units])

    try:
        value = task.function(*task.arguments, report)
    except LagbenchError:
        raise
    except Exception as error:
        raise crashed(error) from None
    return Done(value, units, environment_of("unknown"))


def stop(client: str) -> None:
    """End what this worker does for a client."""
    _STOPPED.add(client)


# --- at the client --------------------------------------------------------------------


class Cluster:
    """The workers of a Dask cluster; use it as a context manager."""

    def __init__(self, address: str, *, folder: Path | None = None) -> None:
        self.address = address  # that of the scheduler
        # what the workers must share with this machine; None where they write nothing
        self.folder = folder
        self._numbers = itertools.count()
        self._pending: dict[int, tuple[Task, Any]] = {}
        self._seen: dict[int, int] = {}
        self._heard: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()

    def __enter__(self) -> Self:
        """Connect, and mark the shared folder."""
        with ExitStack() as stack:
            self._dask = stack.enter_context(_connected(self.address))
            if self.folder is None:
                mark = None
            else:
                mark = stack.enter_context(marked(self.folder))
            self._client = Client(
                f"lagbench-{secrets.token_hex(8)}", version("lagbench"), mark
            )
            self._dask.subscribe_topic(
                self._client.name, lambda event: self._heard.put(tuple(event[1]))
            )
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Make the workers drop what they hold, and disconnect."""
        pending = [future for _, future in self._pending.values()]
        self._pending = {}
        try:
            if pending and self._dask.status == "running":
                with contextlib.suppress(
                    Exception
                ):  # what cannot be reached is lost anyway
                    self._dask.cancel(pending)
                    self._dask.run(
                        stop,
                        self._client.name,
                        on_error="ignore",
                        callback_timeout=STOP_SECONDS,
                    )
        finally:
            self._stack.__exit__(kind, error, trace)

    def submit(self, task: Task) -> None:
        """Send a task to the scheduler; also while :meth:`events` runs."""
        number = next(self._numbers)
        options = {
            "key": f"{self._client.name}-{number}",
            "priority": round(task.cost),
            "pure": False,
        }
        self._pending[number] = (
            task,
            self._dask.submit(run_task, task, number, self._client, **options),
        )

    def events(self) -> Iterator[Event]:
        """Yield news until all tasks are done; lost work counts as negative
        progress.
        """
        looked = alive = time.monotonic()
        while self._pending:
            with contextlib.suppress(queue.Empty):
                while True:
                    number, units = self._heard.get_nowait()
                    if number in self._pending:
                        yield self._counted(number, self._pending[number][0], units)
            ended = [
                number for number, (_, future) in self._pending.items() if future.done()
            ]
            for number in ended:
                task, future = self._pending.pop(number)
                done = _fetch(task.name, future)
                yield self._counted(number, task, done.units)
                yield Event(
                    task=task, kind="done", value=done.value, machine=done.machine
                )
            now = time.monotonic()
            if now - looked >= LOOK_SECONDS:
                looked = now
                with contextlib.suppress(
                    OSError
                ):  # the connection may break after the status was set
                    if (
                        self._dask.status == "running"
                        and self._dask.scheduler_info()["workers"]
                    ):
                        alive = now
            if self._dask.status in ("closed", "failed") or now - alive > LOST_SECONDS:
                raise _lost(f"{self._dask.status}, no worker for {now - alive:.0f} s")
            if not ended:
                time.sleep(POLL_SECONDS)

    def _counted(self, number: int, task: Task, units: int) -> Event:
        """Return the progress since the last news; another worker may have begun
        anew.
        """
        before = self._seen.get(number, 0)
        self._seen[number] = units
        return Event(task=task, kind="progress", value=units - before)


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Connect, with Dask's logs kept off the terminal: what matters of them becomes an
    error of ours.

    After an error they stay off: a client that lost its scheduler logs until the
    process ends.
    """
    # its import sets the levels of its loggers
    distributed = require("distributed", extra="cluster")
    levels = {name: logging.getLogger(name).level for name in LOGGERS}
    for name in LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        if not address.startswith(("ucx://", "inproc://")):
            # A client whose address cannot be one is 40 s in closing.
            distributed.comm.addressing.get_address_host_port(address)
        client = distributed.Client(
            address, timeout=CONNECT_SECONDS, set_as_default=False
        )
    except (OSError, ValueError) as error:
        bad = isinstance(error, ValueError)
        raise (UsageError if bad else WorkFailedError)(
            "cannot reach the Dask scheduler",
            where=f"--scheduler {address}",
            expected="the address of a running scheduler, as in tcp://10.0.0.5:8786",
            got=f"{type(error).__name__}: {error}",
            fix=f"start one with `dask scheduler` and workers with `{WORKERS}`",
        ) from error
    try:
        yield client
    except (CancelledError, distributed.comm.CommClosedError) as error:
        raise _lost(error) from error
    finally:
        client.close()
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


def _lost(got: object) -> WorkFailedError:
    return WorkFailedError(
        "the Dask cluster is lost",
        where="--scheduler",
        got=f"{type(got).__name__}: {got}" if isinstance(got, Exception) else got,
        fix="start scheduler and workers, then run the same command again",
    )


def _fetch(name: str, future: Any) -> Done:  # noqa: ANN401
    """Return what came of a task; put whatever else came into an error of ours."""
    killed = require("distributed", extra="cluster").KilledWorker
    try:
        done: Done = future.result()
    except LagbenchError:
        raise
    except killed as error:
        what = "workers of the Dask cluster died again and again"
        fix = "give the workers more memory, or leave --scheduler out"
        raise WorkFailedError(what, where=name, got=str(error), fix=fix) from error
    except (
        Exception
    ) as error:  # whatever a worker raises that cannot even read the task
        if future.status != "error":
            raise _lost(error) from error
        what = "a worker of the Dask cluster cannot do the work"
        got = f"{type(error).__name__}: {error}"
        fix = "install the same version of lagbench with its extras on every worker"
        raise WorkFailedError(what, where=name, got=got, fix=fix) from error
    return done
