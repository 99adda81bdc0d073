"""The workers of a Dask cluster, used like the :class:`.Pool` of this machine.

The scheduler runs the items of a lost worker on another one. A lost scheduler ends the
work with an error; results that have arrived by then are not lost. An item runs in the
worker itself, which must have one thread: Taichi and HDF5 want a process for
themselves. Progress comes as Dask events.

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
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any, NamedTuple, Self

from lagbench.atomic import check_writable, temporary_name, write_atomically
from lagbench.errors import LagbenchError, UsageError, WorkFailedError, require

from .machine import describe_machine
from .pool import Event, WorkItem, error_to_send

PATIENCE = 30.0  # how long a file of another machine may take to appear [s]
PAUSE = 0.1  # pause between two looks for a file [s]
REPORT_SECONDS = 0.5  # time between two reports of the progress of an item [s]
CONNECT_SECONDS = 20  # how long a Dask scheduler may take to answer
POLL_SECONDS = 0.02  # pause between two looks at the items [s]
CHECK_SECONDS = 1.0  # pause between two looks at the workers [s]
LOST_SECONDS = 60.0  # how long a Dask cluster may be without any worker
FETCH_SECONDS = 5.0  # how long to wait for a result before a look at the workers
STOP_SECONDS = 5  # how long to wait for the workers to stop
WORKERS = "dask worker ADDRESS --nworkers -1 --nthreads 1"
"""The command that starts workers as they must be: one a core, each with one thread."""

LOGGERS = ("distributed", "distributed.client", "distributed.comm", "distributed.core")
"""Loggers that print when a cluster is lost."""


# --- a folder that several machines write to ------------------------------------------


@dataclass(frozen=True)
class FolderMark:
    """A file by which a worker recognises the client's folder."""

    path: Path  # path of the file
    word: str  # its content
    patience: float  # how long it may take to appear [s]

    def check(self, worker: str) -> None:
        """Check that this machine sees the folder and can write to it.

        Raises:
            WorkFailedError: another folder, no folder, or it is not writable.
        """
        folder = self.path.parent
        if not _wait_for_file(self.path, self.patience, content=self.word):
            got = "no such folder"
            if folder.is_dir():
                got = "another folder"
            raise WorkFailedError(
                f"a worker does not see the folder of the data set: {got}; name a "
                "folder on storage that all of them share: --root",
                where=f"{folder}, worker {worker}",
            )
        check_writable(folder)
        for path in folder.iterdir():
            if path.is_dir():
                _refresh_listing(path)


@contextmanager
def mark_folder(folder: Path) -> Iterator[FolderMark]:
    """Keep a mark in a folder."""
    mark = FolderMark(
        path=temporary_name(folder / "mark"),
        word=secrets.token_hex(16),
        patience=PATIENCE,
    )
    write_atomically(mark.path, mark.word.encode())
    try:
        yield mark
    finally:
        mark.path.unlink(missing_ok=True)


def await_file(path: Path) -> None:
    """Wait until a file that another machine has written is seen here."""
    if not _wait_for_file(path, PATIENCE):
        raise WorkFailedError(
            "a worker's file does not appear: got no file, expected a file within "
            f"{PATIENCE:.0f} s; name a folder on storage that all machines share, "
            "then run the same command again",
            where=str(path),
        )


def _wait_for_file(path: Path, patience: float, *, content: str | None = None) -> bool:
    """Wait until a file appears, with this content if given; tell whether it did."""
    end = time.monotonic() + patience
    while True:
        _refresh_listing(path.parent)
        if _has_content(path, content):
            return True
        if time.monotonic() > end:
            return False
        time.sleep(PAUSE)


def _has_content(path: Path, content: str | None) -> bool:
    if not path.is_file():
        return False
    # Another machine may see the name before the content.
    return content is None or path.read_text(encoding="utf-8") == content


def _refresh_listing(folder: Path) -> None:
    """List a folder, so that a network file system looks at it again."""
    with contextlib.suppress(OSError):
        os.listdir(folder)


# --- in a worker ----------------------------------------------------------------------

_stopped_clients: set[str] = set()
"""Clients that no longer wait for their items."""


@dataclass(frozen=True)
class Client:
    """The client that a worker works for."""

    name: str  # topic of the events with the progress of its items
    version: str  # its version of lagbench
    # shows that the worker sees the client's folder; None where no folder is needed
    mark: FolderMark | None = None

    def check(self, worker: str, *, threads: int) -> None:
        """Refuse a worker that could not make the client's bits.

        Raises:
            WorkFailedError: another version, several threads, or another folder.
        """
        where = f"worker {worker}"
        worker_version = version("lagbench")
        if self.version != worker_version:
            raise WorkFailedError(
                f"a worker runs another version of lagbench: got {worker_version}, "
                f"expected {self.version}; install the same version on every worker",
                where=where,
            )
        if threads != 1:
            raise WorkFailedError(
                f"a worker runs several items in one process: {threads} threads; "
                f"start the workers with `{WORKERS}`",
                where=where,
            )
        if self.mark is not None:
            self.mark.check(worker)


class ItemResult(NamedTuple):
    """The result of an item."""

    value: Any  # the return value
    units: int  # units of work done
    machine: dict[str, str]  # description of the machine that did it


def run_item(item: WorkItem, number: int, client: Client) -> ItemResult:
    """Run a client's item in this process, the only thread of a Dask worker."""
    from distributed import get_worker

    worker = get_worker()
    client.check(worker.address, threads=worker.state.nthreads)
    total_units = 0
    last_report = time.monotonic()

    def report(units: int) -> None:
        nonlocal total_units, last_report
        total_units += units
        # Dask cannot stop a thread: an item ends itself when nobody waits for it.
        if client.name in _stopped_clients:
            raise WorkFailedError("the client is gone", where=item.name)
        if time.monotonic() - last_report >= REPORT_SECONDS:
            last_report = time.monotonic()
            worker.log_event(client.name, [number, total_units])

    try:
        value = item.function(*item.arguments, report)
    except Exception as error:
        raise error_to_send(error) from None
    return ItemResult(value, total_units, describe_machine("unknown"))


def stop(client: str) -> None:
    """End the items of a client in this worker."""
    _stopped_clients.add(client)


# --- at the client --------------------------------------------------------------------


class Cluster:
    """The workers of a Dask cluster; use it as a context manager.

    Args:
        address: address of the scheduler.
        folder: folder that the workers must share with this machine; None where they
            write nothing.
    """

    def __init__(self, address: str, *, folder: Path | None = None) -> None:
        self.address = address
        self.folder = folder
        self._numbers = itertools.count()
        # items that are not done, with their futures, by number
        self._pending: dict[int, tuple[WorkItem, Any]] = {}
        self._reported_units: dict[int, int] = {}
        # number and units of work of items, as the workers report them
        self._reports: queue.SimpleQueue[tuple[int, int]] = queue.SimpleQueue()

    def __enter__(self) -> Self:
        """Connect, and mark the shared folder."""
        with ExitStack() as stack:
            self._dask = stack.enter_context(_connect(self.address))
            mark = None
            if self.folder is not None:
                mark = stack.enter_context(mark_folder(self.folder))
            name = f"lagbench-{secrets.token_hex(8)}"
            self._client = Client(name, version("lagbench"), mark)
            self._dask.subscribe_topic(name, self._keep_report)
            self._stack = stack.pop_all()
        return self

    def _keep_report(self, event: tuple[Any, Any]) -> None:
        _, report = event
        self._reports.put(tuple(report))

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Make the workers drop their items, and disconnect."""
        futures = [future for _, future in self._pending.values()]
        self._pending = {}
        try:
            if futures and self._dask.status == "running":
                # A worker that cannot be reached is lost anyway.
                with contextlib.suppress(Exception):
                    self._dask.cancel(futures)
                    self._dask.run(
                        stop,
                        self._client.name,
                        on_error="ignore",
                        callback_timeout=STOP_SECONDS,
                    )
        finally:
            self._stack.__exit__(kind, error, trace)

    def submit(self, item: WorkItem) -> None:
        """Send an item to the scheduler; also while :meth:`events` runs."""
        number = next(self._numbers)
        future = self._dask.submit(
            run_item,
            item,
            number,
            self._client,
            key=f"{self._client.name}-{number}",
            priority=round(item.cost),
            pure=False,
        )
        self._pending[number] = (item, future)

    def events(self) -> Iterator[Event]:
        """Yield news until all items are done; lost work is negative progress."""
        last_check = time.monotonic()
        last_alive = last_check
        while self._pending:
            yield from self._progress_events()
            finished = self._list_finished()
            for number in finished:
                item, future = self._pending[number]
                result = _fetch_result(item.name, future)
                if result is None:
                    continue
                del self._pending[number]
                yield self._count_units(number, item, result.units)
                yield Event(
                    item=item, kind="done", value=result.value, machine=result.machine
                )
            now = time.monotonic()
            if now - last_check >= CHECK_SECONDS:
                last_check = now
                if self._has_workers():
                    last_alive = now
            lonely_seconds = now - last_alive
            status = self._dask.status
            if status in ("closed", "failed") or lonely_seconds > LOST_SECONDS:
                raise _lost_error(f"{status}, no worker for {lonely_seconds:.0f} s")
            if not finished:
                time.sleep(POLL_SECONDS)

    def _progress_events(self) -> Iterator[Event]:
        while not self._reports.empty():
            number, units = self._reports.get()
            if number in self._pending:
                item, _ = self._pending[number]
                yield self._count_units(number, item, units)

    def _list_finished(self) -> list[int]:
        finished = []
        for number, (_, future) in self._pending.items():
            if future.done():
                finished.append(number)
        return finished

    def _has_workers(self) -> bool:
        # The connection may break after the status was set.
        with contextlib.suppress(OSError):
            if self._dask.status == "running":
                return bool(self._dask.scheduler_info()["workers"])
        return False

    def _count_units(self, number: int, item: WorkItem, units: int) -> Event:
        """Return the progress since the last report.

        It is negative where another worker has begun anew.
        """
        units_before = self._reported_units.get(number, 0)
        self._reported_units[number] = units
        return Event(item=item, kind="progress", value=units - units_before)


@contextmanager
def _connect(address: str) -> Iterator[Any]:
    """Connect, with Dask's logs kept off the terminal: their news become our errors.

    After an error of a connected client they stay off: a client that lost its scheduler
    logs until the process ends.
    """
    # Its import sets the levels of its loggers.
    distributed = require("distributed", extra="cluster")
    levels = {}
    for name in LOGGERS:
        logger = logging.getLogger(name)
        levels[name] = logger.level
        logger.setLevel(logging.CRITICAL + 1)
    try:
        client = _open_client(distributed, address)
    except LagbenchError:
        _restore_levels(levels)
        raise
    try:
        yield client
    except (CancelledError, distributed.comm.CommClosedError) as error:
        raise _lost_error(error) from error
    finally:
        client.close()
    _restore_levels(levels)


def _restore_levels(levels: Mapping[str, int]) -> None:
    """Let loggers print again what they printed before."""
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


def _open_client(distributed: ModuleType, address: str) -> Any:  # noqa: ANN401
    try:
        # A client with an impossible address takes 40 s to close.
        if not address.startswith(("ucx://", "inproc://")):
            distributed.comm.addressing.get_address_host_port(address)
        return distributed.Client(
            address, timeout=CONNECT_SECONDS, set_as_default=False
        )
    except (OSError, ValueError) as error:
        kind: type[LagbenchError] = WorkFailedError
        if isinstance(error, ValueError):
            kind = UsageError
        raise kind(
            "cannot reach the Dask scheduler",
            where=f"--scheduler {address}",
            expected="the address of a running scheduler, as in tcp://10.0.0.5:8786",
            got=f"{type(error).__name__}: {error}",
            fix=f"start one with `dask scheduler` and workers with `{WORKERS}`",
        ) from error


def _lost_error(reason: object) -> WorkFailedError:
    if isinstance(reason, Exception):
        reason = f"{type(reason).__name__}: {reason}"
    return WorkFailedError(
        f"the Dask cluster is lost: {reason}; start scheduler and workers, then run "
        "the same command again",
        where="--scheduler",
    )


def _fetch_result(name: str, future: Any) -> ItemResult | None:  # noqa: ANN401
    """Return the result of an item; turn any exception into an error of ours.

    It is None where the result does not come. The worker that held it may be lost: the
    scheduler then has the item done again, and waits for ever where no worker is left.
    """
    killed_worker_error = require("distributed", extra="cluster").KilledWorker
    try:
        result: ItemResult = future.result(timeout=FETCH_SECONDS)
    except LagbenchError:
        raise
    except killed_worker_error as error:
        raise WorkFailedError(
            f"workers of the Dask cluster died again and again: {error}; give the "
            "workers more memory, or leave --scheduler out",
            where=name,
        ) from error
    except Exception as error:  # a worker that cannot read the item raises anything
        if future.status == "error":
            raise WorkFailedError(
                "a worker of the Dask cluster cannot do the work: "
                f"{type(error).__name__}: {error}; install the same version of "
                "lagbench with its extras on every worker",
                where=name,
            ) from error
        if isinstance(error, TimeoutError):
            return None
        raise _lost_error(error) from error
    return result
