"""Workers of a Dask cluster, used like the :class:`.Pool` of this machine.

The scheduler runs what a lost worker held on another one. A lost scheduler ends the work with
an error; results that have arrived by then are not lost.

A folder that several machines write to: see that they do, and wait for each other's files.

A cluster writes a data set to one folder on storage that all its machines share. A mark with
a random word shows that a worker's folder of that path is the client's. Network file systems
remember for a while that a file was missing; listing its folder makes them look again.

What a worker of a Dask cluster does: it runs each task in a process of its own.

Dask workers run tasks in threads; Taichi and HDF5 want a process for themselves. So every
thread keeps a :class:`.Pool` of one process, which dies with the worker. Its work is told to
the client as Dask events.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import os
import queue
import secrets
import signal
import socket
import threading
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from lagbench.atomic import check_writable, temporary_name, write_atomically
from lagbench.errors import LagbenchError, UsageError, WorkFailedError, require

from .machine import environment_of
from .pool import Event, Pool, Task

__all__ = [
    "Mark",
    "await_file",
    "marked",
    "Delivery",
    "Order",
    "fulfil",
    "stop",
    "Cluster",
]


PATIENCE = 30.0
"""How long a file of another machine may take to appear [s]."""

PAUSE = 0.1
"""Pause between two looks [s]."""


@dataclass(frozen=True)
class Mark:
    """A file by which a worker knows the client's folder."""

    path: Path  # where it stands
    word: str  # what it holds
    patience: float  # how long it may take to appear [s]

    def check(self, worker: str) -> None:
        """See that the folder is here and can be written to."""
        folder = self.path.parent
        if not _appears(self.path, self.patience) or self.path.read_text(encoding="utf-8") != self.word:
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
        raise WorkFailedError(
            "a worker's file does not appear",
            where=str(path),
            expected=f"a file within {PATIENCE:.0f} s",
            fix="name a folder on storage that all machines share, then run the same command again",
        )


def _appears(path: Path, patience: float) -> bool:
    end = time.monotonic() + patience
    while True:
        _look_again(path.parent)
        if path.is_file():
            return True
        if time.monotonic() > end:
            return False
        time.sleep(PAUSE)


def _look_again(folder: Path) -> None:
    with contextlib.suppress(OSError):
        os.listdir(folder)


TELL_SECONDS = 0.5
"""Time between two events that tell how far a task is [s]."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """A task on its way to a worker."""

    task: Task  # what to do
    number: int  # number of the order
    client: str  # word that the orders of one client share; Dask events carry it too
    version: str  # version of lagbench that the client runs
    environment: Mapping[str, str]  # variables added to the environment of the process
    mark: Mark | None = None  # what shows that the worker sees the client's folder; None where none is needed


@dataclass(frozen=True, kw_only=True)
class Delivery:
    """What became of an order."""

    value: Any  # result of the task
    units: int  # units of work done
    machine: dict[str, str]  # what identity says of the machine that did it


@dataclass
class _Desk:
    """The process of one thread, and the client that it works for."""

    client: str
    pool: Pool
    busy: bool = False


_DESKS: dict[int, _Desk] = {}
"""Desks by the thread that sits there."""

_STOPPED: set[str] = set()
"""Clients whose orders are void."""


def fulfil(order: Order) -> Delivery:
    """Run a task in this thread's process, started now or kept from the last order."""
    name = socket.gethostname()
    if version("lagbench") != order.version:
        raise WorkFailedError(
            "a worker runs another version of lagbench",
            where=f"worker {name}",
            expected=order.version,
            got=version("lagbench"),
            fix="install the same version on every worker",
        )
    if order.mark is not None:
        order.mark.check(name)
    desk = _desk(order)
    desk.busy = True
    try:
        return _work(order, desk.pool)
    finally:
        desk.busy = False
        if order.client in _STOPPED:
            _clear(threading.get_ident())


def stop(client: str) -> None:
    """End what is done for a client, and its processes."""
    _STOPPED.add(client)
    for thread, desk in list(_DESKS.items()):
        if desk.client != client:
            continue
        if not desk.busy:
            _clear(thread)
            continue
        for process in desk.pool.process_ids():  # its thread notices, and clears the desk itself
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)


def _desk(order: Order) -> _Desk:
    """Return this thread's desk; one of an earlier client, which may have been killed, goes."""
    thread = threading.get_ident()
    if thread in _DESKS and _DESKS[thread].client != order.client:
        _clear(thread)
    return _DESKS.setdefault(thread, _Desk(order.client, Pool(1, order.environment)))


def _clear(thread: int) -> None:
    desk = _DESKS.pop(thread, None)
    if desk is not None:
        desk.pool.close()


def _work(order: Order, pool: Pool) -> Delivery:
    units, told = 0, time.monotonic()
    pool.submit(order.task)
    for event in pool.events():
        if event.kind == "done":
            return Delivery(value=event.value, units=units, machine=environment_of("unknown"))
        if order.client in _STOPPED:
            raise WorkFailedError("the client is gone", where=order.task.name)
        units += _units(event)
        if time.monotonic() - told >= TELL_SECONDS:
            told = time.monotonic()
            _tell(order, units)
    raise WorkFailedError("a task ended without a result", where=order.task.name)


def _units(event: Event) -> int:
    return int(event.value if event.kind == "progress" else -event.value)


def _tell(order: Order, units: int) -> None:
    from distributed import get_worker

    get_worker().log_event(order.client, [order.number, units])


CONNECT_SECONDS = 20
"""How long a Dask scheduler may take to answer."""

POLL_SECONDS = 0.02
"""Pause between two looks at the orders [s]."""

LOOK_SECONDS = 1.0
"""Pause between two looks at the workers [s]."""

LOST_SECONDS = 60.0
"""How long a Dask cluster may be without any worker."""

STOP_SECONDS = 5
"""How long to wait for the workers to stop."""

LOGGERS = ("distributed", "distributed.client", "distributed.comm", "distributed.core")
"""Loggers that print when a cluster is lost."""


class Cluster:
    """The workers of a Dask cluster; use it as a context manager."""

    def __init__(
        self, address: str, environment: Mapping[str, str] | None = None, *, folder: Path | None = None
    ) -> None:
        self.address, self.folder = address, folder
        self._environment = dict(environment or {})
        self._name = f"lagbench-{secrets.token_hex(8)}"
        self._numbers = itertools.count()
        self._pending: dict[int, tuple[Task, Any]] = {}
        self._seen: dict[int, int] = {}
        self._heard: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()
        self._mark: Mark | None = None

    def __enter__(self) -> Self:
        """Connect, and mark the shared folder."""
        with ExitStack() as stack:
            stack.enter_context(_quiet())
            self._client = stack.enter_context(_connected(self.address))
            if self.folder is not None:
                self._mark = stack.enter_context(marked(self.folder))
            self._client.subscribe_topic(self._name, lambda event: self._heard.put(tuple(event[1])))
            stack.callback(self._dismiss)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop what still runs and disconnect."""
        self._stack.__exit__(kind, error, trace)

    def submit(self, task: Task) -> None:
        """Send a task to the scheduler; also while :meth:`events` runs."""
        number = next(self._numbers)
        order = Order(
            task=task,
            number=number,
            client=self._name,
            version=version("lagbench"),
            environment=self._environment,
            mark=self._mark,
        )
        options = {"key": f"{self._name}-{number}", "priority": round(task.cost), "pure": False}
        self._pending[number] = task, self._client.submit(fulfil, order, **options)

    def events(self) -> Iterator[Event]:
        """Yield news until all tasks are done; lost work counts as negative progress."""
        looked = alive = time.monotonic()
        while self._pending:
            yield from self._progress()
            done = [number for number, (_, future) in self._pending.items() if future.done()]
            for number in done:
                yield from self._finished(number)
            now = time.monotonic()
            if now - looked >= LOOK_SECONDS:
                looked = now
                alive = now if _has_workers(self._client) else alive
            if self._client.status in ("closed", "failed") or now - alive > LOST_SECONDS:
                raise _lost(f"{self._client.status}, no worker for {now - alive:.0f} s")
            if not done:
                time.sleep(POLL_SECONDS)

    def _progress(self) -> Iterator[Event]:
        """Yield what was told of orders that are not finished."""
        with contextlib.suppress(queue.Empty):
            while True:
                number, units = self._heard.get_nowait()
                if number in self._pending:
                    yield self._counted(number, self._pending[number][0], units)

    def _finished(self, number: int) -> Iterator[Event]:
        task, future = self._pending.pop(number)
        delivery = _fetch(task.name, future)
        yield self._counted(number, task, delivery.units)
        yield Event(task=task, kind="done", value=delivery.value, machine=delivery.machine)

    def _counted(self, number: int, task: Task, units: int) -> Event:
        """Return the progress since the last news; another worker may have begun anew."""
        before, self._seen[number] = self._seen.get(number, 0), units
        return Event(task=task, kind="progress", value=units - before)

    def _dismiss(self) -> None:
        """Make the workers drop what they hold, and end their processes."""
        pending, self._pending = [future for _, future in self._pending.values()], {}
        if self._client.status == "running":
            with contextlib.suppress(Exception):  # what cannot be reached is lost anyway
                self._client.cancel(pending)
                self._client.run(stop, self._name, on_error="ignore", callback_timeout=STOP_SECONDS)


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    distributed = require("distributed", extra="cluster")
    try:
        if not address.startswith(("ucx://", "inproc://")):
            # A client whose address cannot be one is 40 s in closing.
            distributed.comm.addressing.get_address_host_port(address)
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


def _has_workers(client: Any) -> bool:  # noqa: ANN401
    try:
        return client.status == "running" and bool(client.scheduler_info()["workers"])
    except OSError:  # the connection broke since the status was set
        return False


def _fetch(name: str, future: Any) -> Delivery:  # noqa: ANN401
    """Return what came of an order; put whatever else came into an error of ours."""
    killed = require("distributed", extra="cluster").KilledWorker
    try:
        delivery: Delivery = future.result()
    except LagbenchError:
        raise
    except killed as error:
        raise WorkFailedError(
            "workers of the Dask cluster died again and again",
            where=name,
            got=str(error),
            fix="give the workers more memory, or leave --scheduler out",
        ) from error
    except Exception as error:  # whatever a worker raises that cannot even read the order
        if future.status != "error":
            raise _lost(error) from error
        raise WorkFailedError(
            "a worker of the Dask cluster cannot do the work",
            where=name,
            got=f"{type(error).__name__}: {error}",
            fix="install the same version of lagbench with its extras on every worker",
        ) from error
    return delivery
