"""One writer per data set of a store: a lock object that is created conditionally and expires.

Locks are numbered, ``.lock.000001`` and on. Whoever creates the next number (a conditional put:
only one can) and then still sees none above it holds the data set, provided that the last one
was released or has expired. The highest number is never removed, so that a writer who looked
long ago cannot create a number that was held already. The holder renews its lock from a thread;
when the holder is killed, or cut off, the lock expires and the next writer takes over.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime, timedelta

from lagbench.data.lock import Holder
from lagbench.errors import LagbenchError, WorkFailedError

from .remote import Remote

__all__ = ["Lease", "lease"]

PREFIX = ".lock."

LASTS = 120.0
"""How long a lock holds after it was last renewed [s]."""

RENEW = 30.0
"""How often a holder renews it [s]."""

SKEW = 30.0
"""How much the clocks of two writers may differ [s]."""

POLL = 2.0
"""How often a waiting writer looks [s]."""


@dataclass(frozen=True, kw_only=True)
class _Lock:
    """What a lock object says."""

    pid: int = field(default_factory=os.getpid)  # process id of the holder
    host: str = field(default_factory=socket.gethostname)  # its machine
    # when it took the lock, ISO 8601 in UTC
    since: str = field(default_factory=lambda: _now().isoformat(timespec="seconds"))
    expires: str = ""  # until when it holds unless renewed, likewise
    released: bool = False  # whether the holder gave it back
    token: str = field(default_factory=lambda: secrets.token_hex(8))  # random word of the holder

    @property
    def free(self) -> bool:
        """Whether another writer may take over."""
        try:
            return self.released or _now() > datetime.fromisoformat(self.expires) + timedelta(seconds=SKEW)
        except (ValueError, TypeError):  # written by hand: whoever did so removes it
            return False

    def renewed(self) -> _Lock:
        """Return the same lock with its time counted from now."""
        return replace(self, expires=(_now() + timedelta(seconds=LASTS)).isoformat(timespec="milliseconds"))

    def as_bytes(self) -> bytes:
        """Return the lock as an object's content."""
        return json.dumps(asdict(self)).encode()

    def __str__(self) -> str:
        """Return the holder in words."""
        return f"{Holder(self.pid, self.host, self.since)}, until {self.expires} unless renewed"


class Lease:
    """The lock of a data set, held by this process."""

    def __init__(self, remote: Remote, number: int, lock: _Lock) -> None:
        self._remote, self._number, self._lock = remote, number, lock
        self._lost: str | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._go_on, name="lagbench lease", daemon=True)
        self._thread.start()

    def check(self) -> None:
        """Refuse to write on once the lock is not ours any more."""
        if self._lost is None and _now() > datetime.fromisoformat(self._lock.expires):
            self._lost = "it expired: the store did not answer"
        if self._lost is not None:
            raise WorkFailedError(
                "the lock of the data set in the store was lost",
                where=self._remote.url,
                got=self._lost,
                fix="repeat the command: it goes on with what is there",
            )

    def release(self) -> None:
        """Give the lock back; where the store does not answer it expires by itself."""
        self._ended.set()
        self._thread.join()
        with suppress(LagbenchError):
            self.check()
            self._remote.write(_name(self._number), replace(self._lock, released=True).as_bytes())

    def renew(self) -> None:
        """Count the time of the lock from now, unless a later one is there."""
        later = [number for number in _numbers(self._remote) if number > self._number]
        if later:
            self._lost = f"another writer took over: {_read(self._remote, max(later))}"
            return
        renewed = self._lock.renewed()
        self._remote.write(_name(self._number), renewed.as_bytes())
        self._lock = renewed

    def _go_on(self) -> None:
        while self._lost is None and not self._ended.wait(RENEW):
            with suppress(LagbenchError):  # the line may be back before the lock expires
                self.renew()


@contextmanager
def lease(
    remote: Remote, *, timeout: float | None = None, on_wait: Callable[[str], None] | None = None
) -> Iterator[Lease]:
    """Hold the lock of a data set in a store."""
    held = _acquire(remote, timeout, on_wait)
    try:
        yield held
    finally:
        held.release()


def _acquire(remote: Remote, timeout: float | None, on_wait: Callable[[str], None] | None) -> Lease:
    started, told = time.monotonic(), False
    while True:
        number, holder = _last(remote)
        if holder is None or holder.free:
            taken = _take(remote, number + 1)
            if taken is not None:
                return taken
            continue
        if timeout is not None and time.monotonic() - started >= timeout:
            raise WorkFailedError(
                "another process writes this data set",
                where=remote.url,
                got=str(holder),
                fix="wait until it ends, or end it; objects that are complete stay",
            )
        if on_wait is not None and not told:
            on_wait(str(holder))
            told = True
        time.sleep(POLL if timeout is None else min(POLL, timeout))


def _take(remote: Remote, number: int) -> Lease | None:
    """Create a lock of this number and hold it; None where another writer was faster."""
    lock = _Lock().renewed()
    remote.create(_name(number), lock.as_bytes())
    # Read it back: a put repeated after a lost answer finds itself there, and a store that
    # ignores the condition keeps the last of two.
    there = _numbers(remote)
    found = _read(remote, number)
    if found is None or found.token != lock.token:
        return None
    if max(there) > number:
        remote.remove(_name(number))
        return None
    for old in there:
        if old < number:
            remote.remove(_name(old))
    return Lease(remote, number, lock)


def _last(remote: Remote) -> tuple[int, _Lock | None]:
    """Return the highest number and what its lock says; 0 and None where there is none."""
    number = max(_numbers(remote), default=0)
    return number, _read(remote, number) if number else None


def _numbers(remote: Remote) -> list[int]:
    names = (name.removeprefix(PREFIX) for name in remote.beside() if name.startswith(PREFIX))
    return [int(name) for name in names if name.isdecimal()]


def _read(remote: Remote, number: int) -> _Lock | None:
    """Return what a lock says; None where it went just now."""
    data = remote.read(_name(number))
    if data is None:
        return None
    try:
        return _Lock(**json.loads(data))
    except (ValueError, TypeError):  # cut short, or by hand: it holds until somebody removes it
        return _Lock(pid=0, host=f"unreadable lock {_name(number)}", since="?", expires="?")


def _name(number: int) -> str:
    return f"{PREFIX}{number:06d}"


def _now() -> datetime:
    return datetime.now(UTC)
