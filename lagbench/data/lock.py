"""One writer per data set version; the second waits, or says who holds the lock.

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
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.errors import WorkFailedError

from .layout import dataset_folder

LOCK_NAME = ".lock"
HOLDER_NAME = ".lock.holder.json"


@dataclass(frozen=True)
class Holder:
    """Who holds a lock."""

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
    """Hold the lock of one data set version; where another has it, tell, wait, or say
    who.
    """
    import filelock

    folder = dataset_folder(root, split, size, major)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = filelock.FileLock(folder / LOCK_NAME)
        try:
            lock.acquire(timeout=0)
        except filelock.Timeout:
            last = read_holder(folder) or "another process"
            if on_wait is not None and timeout != 0:
                on_wait(str(last))
            try:
                lock.acquire(timeout=-1 if timeout is None else timeout)
            except filelock.Timeout:
                what = "another process writes this data set"
                got = str(read_holder(folder) or last)
                fix = "wait until it ends, or end it; files that are complete stay"
                raise WorkFailedError(
                    what, where=str(folder), got=got, fix=fix
                ) from None
    except OSError as error:
        why = error.strerror or error
        fix = "name a folder that you may write to: --root or LAGBENCH_ROOT"
        raise WorkFailedError(
            "cannot lock the data set", where=str(folder), got=why, fix=fix
        ) from error
    try:
        holder = Holder(
            os.getpid(),
            socket.gethostname(),
            datetime.now(UTC).isoformat(timespec="seconds"),
        )
        write_atomically(folder / HOLDER_NAME, json.dumps(asdict(holder)).encode())
        yield
    finally:
        (folder / HOLDER_NAME).unlink(missing_ok=True)
        lock.release()


def read_holder(folder: Path) -> Holder | None:
    """Return who last took the lock of a data set folder; None where it is not
    written.
    """
    try:
        return Holder(**json.loads((folder / HOLDER_NAME).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
