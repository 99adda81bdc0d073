"""One writer per data set version; a second one waits, or names the first.

The operating system drops the lock when its process ends, however it ends, so that a
killed generation blocks nobody. A small file beside the lock names the holder; it is
information only and never decides. Start workers by ``spawn``: a forked child would
inherit the lock.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

import filelock
from filelock import BaseFileLock

from lagbench.atomic import write_atomically
from lagbench.errors import WorkFailedError

from .layout import dataset_folder

LOCK_NAME = ".lock"
HOLDER_NAME = ".lock.holder"


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
        since = datetime.now(UTC).isoformat(timespec="seconds")
        holder = f"process {os.getpid()} on {socket.gethostname()}, since {since}"
        write_atomically(folder / HOLDER_NAME, holder.encode())
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

    holder = "another process"
    with suppress(OSError, ValueError):
        holder = (folder / HOLDER_NAME).read_text(encoding="utf-8")
    if on_wait is not None and timeout != 0:
        on_wait(holder)
    try:
        lock.acquire(timeout=-1 if timeout is None else timeout)
    except filelock.Timeout:
        raise WorkFailedError(
            f"another process writes this data set: {holder}; wait until it ends, or "
            "end it; files that are complete stay",
            where=str(folder),
        ) from None
    return lock
