"""Worker processes that run work items, are replaced when killed, and die with us.

Each worker is a fresh interpreter that talks over a socket pair. Unlike
``multiprocessing`` it never imports the caller's ``__main__`` (a script without a
guard, a notebook or standard input may call :func:`lagbench.generate`), and unlike
``concurrent.futures`` one killed worker costs one attempt of one item, not the pool.
"""

from __future__ import annotations

import contextlib
import heapq
import itertools
import json
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, Self, TextIO

from lagbench.errors import (
    LagbenchError,
    WorkFailedError,
    explain_system_error,
    find_place_in_extension,
)

from .machine import has_time_limit, worker_count

AVAILABLE = os.name == "posix"
"""Whether workers can be started here.

They inherit a socket, which Windows cannot hand on.
"""

ATTEMPTS = 3
"""How often an item is tried when its workers die."""

LONGEST_END = 1.0
"""How long a worker may take to end once its channel is closed [s]."""

Report = Callable[[int], None]
"""Function that an item calls with the units of work done since its last call."""

_shown_warnings: dict[Any, Any] = {}
"""Warnings of workers that were shown: several workers may give the same one."""

_FAREWELL = b""
_PATIENCE = 20.0  # how long a worker may take to end by itself [s]
_BOOT = (
    "import sys, json; sys.path[:] = json.loads(sys.argv[2]); "
    "from lagbench.work.pool import serve; serve(int(sys.argv[1]))"
)


@dataclass(frozen=True, kw_only=True)
class WorkItem:
    """A call for a worker: ``function(*arguments, report)``, all of it picklable."""

    name: str  # name in messages, as in "cavity tiny scenario 3"
    function: Callable[..., Any]  # importable by its name from a module
    arguments: tuple[Any, ...] = ()  # its arguments; a Report is added as the last one
    cost: float = 0.0  # expected work in any unit; the costliest items start first


@dataclass(frozen=True, kw_only=True)
class Event:
    """News from a worker."""

    item: WorkItem
    # "progress" (value: units done since the last news), "lost" (its worker died and it
    # starts anew; value: units that were done in vain) or "done" (value: its result)
    kind: str
    value: Any  # see 'kind'
    # description of the other machine that did it; None for this one
    machine: Mapping[str, str] | None = None


class _Attempt(NamedTuple):
    """An item, and how many workers have died with it."""

    item: WorkItem
    deaths: int = 0


@dataclass
class _Worker:
    """A worker process, the parent's end of its channel and its present attempt."""

    process: subprocess.Popen[bytes]
    channel: Connection
    attempt: _Attempt | None = None
    progress: int = 0


@dataclass
class Pool:
    """A set of workers; use it as a context manager, which ends them."""

    size: int  # workers at the most; they start when there is work for them
    # variables added to the environment of the workers
    environment: Mapping[str, str] = field(default_factory=dict)
    _workers: list[_Worker] = field(default_factory=list, init=False)
    _queue: list[tuple[float, int, _Attempt]] = field(default_factory=list, init=False)
    _numbers: Iterator[int] = field(default_factory=itertools.count, init=False)

    def __post_init__(self) -> None:
        """Refuse a pool in which no item could ever run."""
        if not AVAILABLE:
            raise WorkFailedError(
                "this system cannot start workers: none of them; on Windows use WSL",
                where=sys.platform,
            )
        self.size = worker_count(self.size)

    def __enter__(self) -> Self:
        """Return the pool itself."""
        return self

    def __exit__(
        self, kind: object, error: BaseException | None, trace: object
    ) -> None:
        """Let idle workers end by themselves; after an error kill all at once."""
        # A worker that ends by itself keeps Taichi's kernels for the next time.
        if error is None:
            idle_workers = self._list_idle()
            for worker in idle_workers:
                with contextlib.suppress(OSError):  # it died while idle
                    worker.channel.send_bytes(_FAREWELL)
            for worker in idle_workers:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    worker.process.wait(_PATIENCE)
        self.close()

    def submit(self, item: WorkItem) -> None:
        """Queue an item; also while :meth:`events` runs."""
        self._enqueue(_Attempt(item))

    def events(self) -> Iterator[Event]:
        """Run every queued item and yield news until all are done."""
        while self._queue or self._list_busy():
            self._assign_queued()
            busy_workers = self._list_busy()
            # The channel of a dead worker is ready too.
            ready_channels = wait([worker.channel for worker in busy_workers])
            for worker in busy_workers:
                if worker.channel in ready_channels and worker.attempt is not None:
                    event = self._receive(worker, worker.attempt)
                    if event is not None:
                        yield event

    def _assign_queued(self) -> None:
        """Give queued items to idle workers; start workers up to the size."""
        idle_workers = self._list_idle()
        while self._queue and (idle_workers or len(self._workers) < self.size):
            if idle_workers:
                worker = idle_workers.pop()
            else:
                worker = self._start()
            _, _, attempt = heapq.heappop(self._queue)
            worker.attempt = attempt
            worker.progress = 0
            call = (attempt.item.function, attempt.item.arguments)
            try:
                worker.channel.send_bytes(pickle.dumps(call))
            except OSError:  # it died while idle
                self._bury(worker, attempt)

    def _list_idle(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.attempt is None]

    def _list_busy(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.attempt is not None]

    @property
    def is_idle(self) -> bool:
        """Whether no item waits and no worker has one."""
        return not self._queue and not self._list_busy()

    def process_ids(self) -> list[int]:
        """Return the process ids of the living workers."""
        return [worker.process.pid for worker in self._workers]

    def close(self) -> None:
        """Kill the workers and wait until they are gone."""
        workers = self._workers
        self._workers = []
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.process.wait()
            worker.channel.close()

    def _enqueue(self, attempt: _Attempt) -> None:
        # Items of one cost keep their order by their number.
        entry = (-attempt.item.cost, next(self._numbers), attempt)
        heapq.heappush(self._queue, entry)

    def _start(self) -> _Worker:
        parent_socket, worker_socket = socket.socketpair()
        with worker_socket:
            descriptor = worker_socket.fileno()
            arguments = [str(descriptor), json.dumps(sys.path)]
            process = subprocess.Popen(
                [sys.executable, "-P", "-c", _BOOT, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[descriptor],
                env={**os.environ, **self.environment},
                # Ctrl-C reaches the parent only, which then ends the workers itself.
                process_group=0,
            )
        worker = _Worker(process, Connection(parent_socket.detach()))
        self._workers.append(worker)
        return worker

    def _receive(self, worker: _Worker, attempt: _Attempt) -> Event | None:
        """Return the news that a worker sent; None after it sent a warning."""
        try:
            kind, value = worker.channel.recv()
        except (EOFError, OSError):
            return self._bury(worker, attempt)
        if kind == "warning":
            message, category, file, line = value
            warnings.warn_explicit(
                message, category, file, line, registry=_shown_warnings
            )
            return None
        if kind == "progress":
            worker.progress += value
            return Event(item=attempt.item, kind=kind, value=value)
        worker.attempt = None
        if kind == "done":
            return Event(item=attempt.item, kind=kind, value=value)
        raise value

    def _bury(self, worker: _Worker, attempt: _Attempt) -> Event:
        """Forget a dead worker; queue its item again unless it was tried often."""
        self._workers.remove(worker)
        worker.channel.close()
        code = _end(worker.process)
        next_attempt = _Attempt(attempt.item, attempt.deaths + 1)
        if next_attempt.deaths >= ATTEMPTS:
            cause = f"exit status {code}"
            if code < 0:
                cause = f"killed by {signal.Signals(-code).name}"
            raise WorkFailedError(
                f"a worker process died {ATTEMPTS} times: {cause}; "
                f"{_advise_on_death(code)}",
                where=attempt.item.name,
            )
        self._enqueue(next_attempt)
        return Event(item=attempt.item, kind="lost", value=worker.progress)


def _end(process: subprocess.Popen[bytes]) -> int:
    """Return the exit code of a worker whose channel is closed.

    A worker that does not end by itself is killed.
    """
    try:
        return process.wait(timeout=LONGEST_END)
    except subprocess.TimeoutExpired:
        process.kill()
        return process.wait()


def _advise_on_death(code: int) -> str:
    """Return what a user can do whose workers die with an exit code."""
    memory = (
        "free memory; where the command has the option --workers, take fewer of them"
    )
    time = "raise the limit of processor time: `ulimit -t unlimited`"
    if code == -signal.SIGXCPU:
        return time
    # beyond the hard limit the system kills, as where memory is short
    if code == -signal.SIGKILL and has_time_limit():
        return f"{time}; if that was not the cause, {memory}"
    return memory


def error_to_send(error: Exception) -> LagbenchError:
    """Return an exception of an item as an error of ours, which can be sent.

    A full disk or a missing permission has the same message in a worker as elsewhere.
    An error of another package names the line of that package; an unexpected one holds
    its traceback.
    """
    if isinstance(error, LagbenchError):
        return error
    if isinstance(error, MemoryError):
        return WorkFailedError(
            f"there is not enough memory: {type(error).__name__}: {str(error)[:200]}; "
            "free memory, or raise the limit (`ulimit -v unlimited`, or that of the "
            "batch system); where the command has the option --workers, take fewer of "
            "them",
            where="a worker process",
        )
    if isinstance(error, OSError) and find_place_in_extension(error) is None:
        explained = explain_system_error(error)
        if explained is not None:
            return explained
    return crash_error(error)


def crash_error(error: Exception) -> WorkFailedError:
    """Return an unexpected exception of an item as an error of ours."""
    place = find_place_in_extension(error)
    if place is not None:
        messages = [repr(error), *getattr(error, "__notes__", ())]
        return WorkFailedError(
            f"a package failed in a worker: {', '.join(messages)}; mend or uninstall "
            "that package",
            where=place,
        )
    trace = "".join(traceback.format_exception(error, limit=-6))
    return WorkFailedError(
        f"a worker crashed: {error!r}\n{trace}; this is a fault of lagbench: report "
        "it with this message",
        where="a worker process",
    )


def serve(descriptor: int) -> None:
    """Run the items that arrive on a socket until the parent says farewell.

    End at once if the parent is gone.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = Connection(descriptor)
    _forward_warnings(channel)
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def listen() -> None:
        try:
            while True:
                inbox.put(channel.recv_bytes())
        except (EOFError, OSError):  # the parent is gone
            os._exit(1)

    threading.Thread(target=listen, daemon=True).start()
    message = inbox.get()
    while message != _FAREWELL:
        reply = _run_item(message, channel)
        try:
            channel.send(reply)
        except Exception as error:  # pickle raises nearly any type
            channel.send(("error", error_to_send(error)))
        message = inbox.get()

    # Taichi keeps compiled kernels only where it ends; else they are compiled again.
    taichi = sys.modules.get("taichi")
    if taichi is not None:
        with contextlib.suppress(Exception):
            taichi.reset()


def _forward_warnings(channel: Connection) -> None:
    """Send warnings of ours to the parent, which shows them as its own."""
    show_here = warnings.showwarning

    def forward(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if category.__module__.startswith("lagbench."):
            channel.send(("warning", (message, category, filename, lineno)))
        else:
            show_here(message, category, filename, lineno, file, line)

    warnings.showwarning = forward


def _run_item(message: bytes, channel: Connection) -> tuple[str, Any]:
    """Return the kind of the reply and its value: a result or an error."""

    def report(units: int) -> None:
        channel.send(("progress", units))

    try:
        function, arguments = pickle.loads(message)
        return "done", function(*arguments, report)
    except Exception as error:
        return "error", error_to_send(error)
