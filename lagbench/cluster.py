"""Workers of a Dask cluster, used like the :class:`.Pool` of this machine.

The scheduler runs what a lost worker held on another one. A lost scheduler ends the work with
an error; results that have arrived by then are not lost.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import queue
import secrets
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from .errors import LagbenchError, UsageError, WorkFailedError
from .extras import require
from .outpost import Delivery, Order, fulfil, stop
from .pool import Event, Task
from .shared_folder import Mark, marked

__all__ = ["Cluster"]

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
    """The workers of a Dask cluster; use it as a context manager.

    Args:
        address: address of the scheduler, as in tcp://10.0.0.5:8786.
        environment: variables added to the environment of the processes that work.
        folder: folder that all workers must share with this machine; None for none.

    Raises (on entry):
        UsageError: Dask's distributed is not installed, or the address cannot be one.
        WorkFailedError: the scheduler does not answer.
    """

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
        """Yield news until all tasks are done; lost work counts as negative progress.

        Raises:
            LagbenchError: what a task raised.
            WorkFailedError: workers died too often, or the cluster is lost.
        """
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
