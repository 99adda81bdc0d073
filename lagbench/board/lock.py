"""One writer per leaderboard: a second one waits.

The operating system drops the lock when its process ends, however it ends.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import filelock

from lagbench.errors import WorkFailedError

from .folder import LOCK, Folder

LONGEST_WAIT = 120.0
"""Longest wait for another writer [s]; it holds the lock for seconds."""


@contextmanager
def board_lock(folder: Folder, *, timeout: float = LONGEST_WAIT) -> Iterator[None]:
    """Hold the lock of a leaderboard; its folder is made where there is none.

    Raises:
        WorkFailedError: another process holds it, or the folder cannot be written.
    """
    try:
        folder.path.mkdir(parents=True, exist_ok=True)
        lock = filelock.FileLock(folder.path / LOCK)
        lock.acquire(timeout=timeout)
    except filelock.Timeout:
        raise WorkFailedError(
            "another process writes to this leaderboard",
            where=str(folder.path),
            expected=f"its end within {timeout:g} s",
            got="it still writes",
            fix="submit again when it has ended",
        ) from None
    except OSError as error:
        raise WorkFailedError(
            "cannot write there",
            where=str(error.filename or folder.path),
            expected="a folder that you may write to, on a disk with space",
            got=error.strerror or error,
            fix="free disk space, or name a folder that you may write to: --board",
        ) from error
    try:
        yield
    finally:
        lock.release()
