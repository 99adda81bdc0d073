"""Files that appear whole or not at all (temporary name, fsync, rename), and that are
files at all.
"""

from __future__ import annotations

import errno
import functools
import os
import secrets
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import LagbenchError, WorkFailedError

SUFFIX = ".partial"
"""Ending of temporary names; nothing but this module creates or removes such files."""

ROOT_OPTION = "--root or LAGBENCH_ROOT"
"""What names the folder that most files go to."""


@contextmanager
def atomic_path(target: Path, *, option: str = ROOT_OPTION) -> Iterator[Path]:
    """Yield a temporary name beside the target; rename it there on a clean exit.

    The parent folder is created. Before the rename the file is flushed to disk, after
    it the folder is, so that a crash at any time leaves the old file or the new one.
    When the body raises, the temporary file is removed and the target stays as it was.
    """
    temporary = temporary_name(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush(temporary)
        temporary.replace(target)
        _flush_folder(target.parent)
    except LagbenchError:
        raise
    except OSError as error:
        raise _refused(target, option, error) from error
    finally:
        _discard(temporary)


def write_atomically(target: Path, data: bytes, *, option: str = ROOT_OPTION) -> None:
    """Write bytes to a file that appears whole or not at all."""
    with atomic_path(target, option=option) as temporary:
        temporary.write_bytes(data)


def move_together(moves: Sequence[tuple[Path, Path]]) -> None:
    """Rename files to places on the same disk, in their order.

    What may fail comes first: files are flushed and folders made before the first one
    is moved.
    """
    for source, target in moves:
        _flush(source)
        target.parent.mkdir(parents=True, exist_ok=True)
    refuse_folders(target for _, target in moves)
    for source, target in moves:
        source.replace(target)
    for folder in {target.parent for _, target in moves}:
        _flush_folder(folder)


def refuse_folders(paths: Iterable[Path]) -> None:
    """Raise IsADirectoryError for a folder where a file is to be replaced or
    removed.
    """
    for path in paths:
        if path.is_dir() and not path.is_symlink():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))


def check_writable(folder: Path, *, option: str = ROOT_OPTION) -> None:
    """Make a folder and see that files can be written there, before work whose result
    goes there.

    Args:
        folder: the folder.
        option: what the user names another folder with, for the message.

    Raises:
        WorkFailedError: the operating system refused.
    """
    probe = temporary_name(folder / "probe")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
    except OSError as error:
        raise _refused(folder, option, error) from error
    finally:
        _discard(probe)


def remove_leftovers(folder: Path) -> list[Path]:
    """Remove temporary files that killed writers left, in subfolders too; return them.

    Call it only while holding the lock of the data set.
    """
    found = sorted(folder.rglob(f".*{SUFFIX}"))
    for path in found:
        path.unlink(missing_ok=True)
    return found


def temporary_name(target: Path) -> Path:
    """Return this process's own temporary name beside a target, of which nothing may be
    left.
    """
    return target.with_name(f".{target.name}.{os.getpid()}-{_mark()}{SUFFIX}")


@functools.cache
def _mark() -> str:
    """Return what tells equal process ids of several machines apart."""
    return secrets.token_hex(4)


def _refused(target: Path, option: str, error: OSError) -> WorkFailedError:
    remedy = "free disk space"
    if isinstance(error, (FileExistsError, NotADirectoryError)):
        remedy = "a file is where a folder has to be: remove it"
    if isinstance(error, IsADirectoryError):
        remedy = "a folder is where the file has to be: remove it"
    return WorkFailedError(
        "cannot write there",
        where=str(target),
        got=error.strerror or error,
        fix=f"{remedy}, or name a folder that you may write to: {option}",
    )


def _discard(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except (
        OSError
    ):  # the folder is missing or read-only: then there is nothing to remove
        return


def _flush(path: Path) -> None:
    # Windows flushes what is open for writing only.
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _flush_folder(path: Path) -> None:
    with suppress(PermissionError):  # Windows opens no folder
        _flush(path)
