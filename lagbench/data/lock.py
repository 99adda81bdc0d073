"""One writer per data set version; a second one waits, or names the first.

The operating system drops the lock when its process ends, however it ends, so that a
killed generation blocks nobody. A small file beside the lock names the holder; it is
information only and never decides. Start workers by ``spawn``: a forked child would
inherit the lock.
"""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import filelock
from filelock import BaseFileLock

from lagbench.atomic import write_atomically
from lagbench.errors import WorkFailedError

from .layout import dataset_folder

LOCK_NAME = ".lock"
HOLDER_NAME = ".lock.holder.json"


@dataclass(frozen=True)
class Holder:
    """The process that holds a lock."""

    pid: int  # process id
    host: str  # name of its machine
    since: str  # when it took the lock, ISO 8601 in UTC

    def __str__(self) -> str:
        """Return the holder in words."""
        return f"process {self.pid} on {self.host}, since {self.since}"


@contextmanager
def dataset_lock(
    root: Path,
    split: str,
    size: str,
    major: int,
    *,
    timeout: float | None = None,
    on_wait: Callable[[str], None] | None = None,
) -> Iterator[None]:
    """Hold the lock of one data set version.

    Args:
        root: root folder of all data sets.
        split: name of the split.
        size: name of the size.
        major: MAJOR of the version.
        timeout: longest wait for another process [s]; None without end.
        on_wait: receives the description of the holder before a wait.

    Raises:
        WorkFailedError: another process holds the lock, or the folder is not writable.
    """
    folder = dataset_folder(root, split, size, major)
    try:
        lock = _acquire(folder, timeout, on_wait)
    except OSError as error:
        raise WorkFailedError(
            "cannot write there, so the data set cannot be locked: "
            f"{error.strerror or error}; name a folder that you may write to: --root "
            "or LAGBENCH_ROOT",
            where=str(error.filename or folder),
        ) from error
    try:
        holder = Holder(
            pid=os.getpid(),
            host=socket.gethostname(),
            since=datetime.now(UTC).isoformat(timespec="seconds"),
        )
        write_atomically(folder / HOLDER_NAME, json.dumps(asdict(holder)).encode())
        yield
    finally:
        with suppress(OSError):
            (folder / HOLDER_NAME).unlink(missing_ok=True)
        lock.release()


def _acquire(
    folder: Path, timeout: float | None, on_wait: Callable[[str], None] | None
) -> BaseFileLock:
    folder.mkdir(parents=True, exist_ok=True)
    lock = filelock.FileLock(folder / LOCK_NAME)
    with suppress(filelock.Timeout):
        lock.acquire(timeout=0)
        return lock

    first_holder = read_holder(folder) or "another process"
    if on_wait is not None and timeout != 0:
        on_wait(str(first_holder))
    try:
        lock.acquire(timeout=-1 if timeout is None else timeout)
    except filelock.Timeout:
        raise WorkFailedError(
            "another process writes this data set: "
            f"{read_holder(folder) or first_holder}; wait until it ends, or end it; "
            "files that are complete stay",
            where=str(folder),
        ) from None
    return lock


def read_holder(folder: Path) -> Holder | None:
    """Return the last holder of a data set's lock; None where none can be read."""
    try:
        text = (folder / HOLDER_NAME).read_text(encoding="utf-8")
        return Holder(**json.loads(text))
    except (OSError, ValueError, TypeError, RecursionError):
        return None
