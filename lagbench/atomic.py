"""Files that appear whole or not at all: temporary name, fsync, rename."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import LagbenchError, WorkFailedError

__all__ = ["atomic_path", "remove_leftovers", "write_atomically"]

SUFFIX = ".partial"
"""Ending of temporary names; nothing but this module creates or removes such files."""


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """Yield a temporary name beside the target; rename it there on a clean exit.

    The parent folder is created. Before the rename the file is flushed to disk, after it
    the folder is, so that a crash at any time leaves the old file or the new one. When the
    body raises, the temporary file is removed and the target stays as it was.

    Args:
        target: path that shall appear.

    Raises:
        WorkFailedError: the operating system refused (no space, no permission).
    """
    temporary = target.with_name(f".{target.name}.{os.getpid()}{SUFFIX}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush(temporary)
        temporary.replace(target)
        _flush(target.parent)
    except LagbenchError:
        raise
    except OSError as error:
        raise WorkFailedError(
            "cannot write a file",
            where=str(target),
            got=error.strerror or error,
            fix="free disk space, or name a folder that you may write to: --root or LAGBENCH_ROOT",
        ) from error
    finally:
        _discard(temporary)


def write_atomically(target: Path, data: bytes) -> None:
    """Write bytes to a file that appears whole or not at all.

    Raises:
        WorkFailedError: the operating system refused.
    """
    with atomic_path(target) as temporary:
        temporary.write_bytes(data)


def remove_leftovers(folder: Path) -> list[Path]:
    """Remove temporary files that killed writers left, in subfolders too; return them.

    Call it only while holding the lock of the data set.
    """
    found = sorted(folder.rglob(f".*{SUFFIX}"))
    for path in found:
        path.unlink(missing_ok=True)
    return found


def _discard(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:  # the folder is missing or read-only: then there is nothing to remove
        return


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
