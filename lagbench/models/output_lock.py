"""One prediction at a time writes a file: a second one is refused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import filelock

from lagbench.errors import WorkFailedError


@contextmanager
def hold_output(output: Path) -> Iterator[None]:
    """Let no other prediction write the same file for a while.

    Nothing is held where no lock can be made. If nobody may write in the folder, the
    writer of the file says so.

    Args:
        output: the predictions.nc to write.

    Raises:
        WorkFailedError: another prediction holds the file.
    """
    lock_file = output.with_name(f".{output.name}.lock")
    lock = filelock.FileLock(lock_file)
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
    except filelock.Timeout:
        raise WorkFailedError(
            "another prediction writes this file",
            where=str(output),
            expected="no other writer",
            got="another one",
            fix="wait until it ends, or name another file: --output",
        ) from None
    except (OSError, NotImplementedError):
        pass  # a disk without locks, or a folder in which nobody may write
    try:
        yield
    finally:
        if lock.is_locked:
            # Windows removes no file that is open; there the lock does it itself.
            with suppress(OSError):
                lock_file.unlink()
            lock.release()
