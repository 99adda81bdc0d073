"""Worker processes that take tasks, are replaced when killed, and die with their
parent.

Each worker is a fresh interpreter that talks over a socket pair. Unlike
``multiprocessing`` it never imports the caller's ``__main__`` (a script without a
guard, a notebook or standard input may call :func:`lagbench.generate`), and unlike
``concurrent.futures`` one killed worker costs one attempt of one task, not the pool.
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
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, Self

from lagbench.errors import LagbenchError, UsageError, WorkFailedError, package_at_fault

from .machine import available_cores

AVAILABLE = os.name == "posix"
"""Whether workers can be started here: they inherit a socket, which Windows cannot hand
on.
"""

ATTEMPTS = 3  # times that a task is tried when the worker under it dies

Report = Callable[[int], None]
"""What a task calls to say how many units of work it has done since it last called."""

_FAREWELL = b""
_PATIENCE = 20.0  # how long a worker may take to end by itself [s]
_BOOT = (
    "import sys, json; sys.path[:] = json.loads(sys.argv[2]); "
    "from lagbench.work.pool import serve; serve(int(sys.argv[1]))"
)


def worker_count(wanted: int | None, *, default: int | None = None) -> int:
    """Return how many workers to start: those wanted, else the default, else one per
    core.
    """
    if wanted is None:
        return default or available_cores()
    if wanted < 1:
        raise UsageError(
            "there is no work without a worker",
            where="--workers",
            expected=">= 1",
            got=wanted,
        )
    return wanted


@dataclass(frozen=True, kw_only=True)
class Task:
    """Something to run in a worker: ``function(*arguments, report)``, all of it
    picklable.
    """

    name: str  # what messages call it, as in "cavity tiny scenario 3"
    function: Callable[..., Any]  # importable by its name from a module
    arguments: tuple[Any, ...] = ()  # its arguments; a Report is added as the last one
    cost: float = 0.0  # expected work in any unit; the costliest tasks start first


@dataclass(frozen=True, kw_only=True)
class Event:
    """News from a worker."""

    task: Task  # the task concerned
    # "progress" (value: units done since the last news), "lost" (its worker died and it
    # starts anew; value: units that were done in vain) or "done" (value: its result)
    kind: str
    value: Any  # see 'kind'
    # what identity says of another machine that did it; None for this one
    machine: Mapping[str, str] | None = None


class _Attempt(NamedTuple):
    """A task and how many workers have died under it."""

    task: Task
    deaths: int = 0


@dataclass
class _Worker:
    """A worker process, the parent's end of its channel and what it works on."""

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
    _waiting: list[tuple[float, int, _Attempt]] = field(
        default_factory=list, init=False
    )
    _number: Iterator[int] = field(default_factory=itertools.count, init=False)

    def __post_init__(self) -> None:
        """Refuse a pool in which no task could ever run."""
        if not AVAILABLE:
            raise WorkFailedError(
                "this system cannot start workers", fix="on Windows use WSL"
            )
        self.size = worker_count(self.size)

    def __enter__(self) -> Self:
        """Return the pool itself."""
        return self

    def __exit__(
        self, kind: object, error: BaseException | None, trace: object
    ) -> None:
        """Let idle workers end by themselves, then kill; after an error kill at
        once.
        """
        if error is None:  # what Taichi compiled is then kept for the next time
            idle = [worker for worker in self._workers if worker.attempt is None]
            for worker in idle:
                with contextlib.suppress(OSError):  # it died while idle
                    worker.channel.send_bytes(_FAREWELL)
            for worker in idle:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    worker.process.wait(_PATIENCE)
        self.close()

    def submit(self, task: Task) -> None:
        """Queue a task; also while :meth:`events` runs."""
        self._queue(_Attempt(task))

    def events(self) -> Iterator[Event]:
        """Run every queued task and yield news until all are done."""
        while self._waiting or any(worker.attempt for worker in self._workers):
            idle = [worker for worker in self._workers if worker.attempt is None]
            while self._waiting and (idle or len(self._workers) < self.size):
                if idle:
                    worker = idle.pop()
                else:
                    worker = self._start()
                _, _, attempt = heapq.heappop(self._waiting)
                worker.attempt = attempt
                worker.progress = 0
                try:
                    worker.channel.send_bytes(
                        pickle.dumps((attempt.task.function, attempt.task.arguments))
                    )
                except OSError:  # it died while idle
                    self._bury(worker, attempt)
            busy = [worker for worker in self._workers if worker.attempt]
            # one that died has some too
            news = wait([worker.channel for worker in busy])
            for worker in busy:
                if worker.channel in news and worker.attempt is not None:
                    yield self._receive(worker, worker.attempt)

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

    def _queue(self, attempt: _Attempt) -> None:
        heapq.heappush(self._waiting, (-attempt.task.cost, next(self._number), attempt))

    def _start(self) -> _Worker:
        ours, theirs = socket.socketpair()
        with theirs:
            process = subprocess.Popen(
                [
                    sys.executable,
                    "-P",
                    "-c",
                    _BOOT,
                    str(theirs.fileno()),
                    json.dumps(sys.path),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                env={**os.environ, **self.environment},
                # Ctrl-C reaches the parent only, which then ends the workers itself.
                process_group=0,
            )
        worker = _Worker(process, Connection(ours.detach()))
        self._workers.append(worker)
        return worker

    def _receive(self, worker: _Worker, attempt: _Attempt) -> Event:
        try:
            kind, value = worker.channel.recv()
        except (EOFError, OSError):
            return self._bury(worker, attempt)
        if kind == "progress":
            worker.progress += value
            return Event(task=attempt.task, kind=kind, value=value)
        worker.attempt = None
        if kind == "done":
            return Event(task=attempt.task, kind=kind, value=value)
        raise value

    def _bury(self, worker: _Worker, attempt: _Attempt) -> Event:
        """Forget a dead worker; queue its task again unless it was tried often
        enough.
        """
        self._workers.remove(worker)
        worker.process.kill()
        code = worker.process.wait()
        worker.channel.close()
        again = _Attempt(attempt.task, attempt.deaths + 1)
        if again.deaths >= ATTEMPTS:
            if code < 0:
                got = f"killed by {signal.Signals(-code).name}"
            else:
                got = f"exit status {code}"
            what = f"a worker process died {ATTEMPTS} times"
            fix = "free memory or take fewer workers: --workers 1"
            raise WorkFailedError(what, where=again.task.name, got=got, fix=fix)
        self._queue(again)
        return Event(task=again.task, kind="lost", value=worker.progress)


def crashed(error: Exception) -> WorkFailedError:
    """Return what a task raised that it should not, as an error of ours."""
    if (place := package_at_fault(error)) is not None:
        fix = "mend or uninstall that package"
        got = ", ".join([repr(error), *getattr(error, "__notes__", ())])
        return WorkFailedError(
            "a package failed in a worker", where=place, got=got, fix=fix
        )
    last = "".join(traceback.format_exception(error, limit=-6))
    return WorkFailedError("a worker crashed", got=f"{error!r}\n{last}")


def serve(descriptor: int) -> None:
    """Run the tasks that arrive on a socket until the other end closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = Connection(descriptor)
    inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def listen() -> None:
        try:
            while True:
                inbox.put(channel.recv_bytes())
        except (EOFError, OSError):  # the parent is gone
            os._exit(1)

    threading.Thread(target=listen, daemon=True).start()
    while (message := inbox.get()) != _FAREWELL:
        try:
            function, arguments = pickle.loads(message)
            reply = (
                "done",
                function(*arguments, lambda units: channel.send(("progress", units))),
            )
        except LagbenchError as error:
            reply = ("error", error)
        except Exception as error:
            reply = ("error", crashed(error))
        channel.send(reply)
    if (
        taichi := sys.modules.get("taichi")
    ) is not None:  # it keeps what it compiled only if asked to end
        with contextlib.suppress(
            Exception
        ):  # where it cannot, the next run compiles again
            taichi.reset()
