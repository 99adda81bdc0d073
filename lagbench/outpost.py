"""What a worker of a Dask cluster does: it runs each task in a process of its own.

Dask workers run tasks in threads; Taichi and HDF5 want a process for themselves. So every
thread keeps a :class:`.Pool` of one process, which dies with the worker. Its work is told to
the client as Dask events.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any

from .errors import WorkFailedError
from .identity import environment_of
from .pool import Event, Pool, Task
from .shared_folder import Mark

__all__ = ["Delivery", "Order", "fulfil", "stop"]

TELL_SECONDS = 0.5
"""Time between two events that tell how far a task is [s]."""


@dataclass(frozen=True, kw_only=True)
class Order:
    """A task on its way to a worker.

    Attributes:
        task: what to do.
        number: number of the order.
        client: word that the orders of one client share; Dask events carry it too.
        version: version of lagbench that the client runs.
        environment: variables added to the environment of the process.
        mark: what shows that the worker sees the client's folder; None where none is needed.
    """

    task: Task
    number: int
    client: str
    version: str
    environment: Mapping[str, str]
    mark: Mark | None = None


@dataclass(frozen=True, kw_only=True)
class Delivery:
    """What became of an order.

    Attributes:
        value: result of the task.
        units: units of work done.
        machine: what :mod:`.identity` says of the machine that did it.
    """

    value: Any
    units: int
    machine: dict[str, str]


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
    """Run a task in this thread's process, started now or kept from the last order.

    Raises:
        LagbenchError: what the task raised.
        WorkFailedError: another version of lagbench, a folder that is not shared, or the process
            died too often.
    """
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
