"""Files that appear whole or not at all: temporary name, fsync, rename."""

from __future__ import annotations

import functools
import os
import secrets
import shlex
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import LagbenchError, UsageError, WorkFailedError, explain_system_error

SUFFIX = ".partial"
"""Ending of temporary names; nothing but this module creates or removes such files."""

ROOT_OPTION = "--root or LAGBENCH_ROOT"
"""The option that names the folder for most files."""


@contextmanager
def atomic_path(target: Path, *, option: str = ROOT_OPTION) -> Iterator[Path]:
    """Yield a temporary name beside the target; rename it there on a clean exit.

    The parent folder is created. Before the rename the file is flushed to disk, after
    it the folder is, so that a crash at any time leaves the old file or the new one.
    When the body raises, the temporary file is removed and the target stays as it was.

    Args:
        target: the file.
        option: the option that names another folder, for messages.

    Raises:
        WorkFailedError: the operating system refused, or the target is no file.
    """
    # the superuser's rename would replace a device, as in -o /dev/null
    if target.exists() and not target.is_file():
        raise WorkFailedError("not a file; name a file", where=str(target))
    temporary = temporary_name(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush(temporary)
        temporary.replace(target)
        _flush(target.parent)
    except OSError as error:
        raise explain_write_error(target, error, option=option) from error
    finally:
        if temporary.exists():
            temporary.unlink()


def write_atomically(target: Path, data: bytes, *, option: str = ROOT_OPTION) -> None:
    """Write bytes to a file that appears whole or not at all."""
    with atomic_path(target, option=option) as temporary:
        temporary.write_bytes(data)


@contextmanager
def checked_path(target: Path, *, option: str) -> Iterator[Path]:
    """Yield a file of the same name in a temporary folder, to write and to check.

    On a clean exit the target gets its content.

    Raises:
        WorkFailedError: the operating system refused.
    """
    check_writable(target.parent, option=option)
    with tempfile.TemporaryDirectory() as folder:
        unchecked = Path(folder) / target.name
        yield unchecked
        write_atomically(target, unchecked.read_bytes(), option=option)


def check_output_file(
    output: Path, *, overwrite: bool, option: str = "--output"
) -> None:
    """Refuse, before the work, a file to write that must not be replaced.

    Raises:
        UsageError: it is a folder, a device or an address, or such a file is there and
            may not be replaced.
    """
    if ":" in output.parts[0] and len(output.parts) > 1:
        raise UsageError(
            f"{output} is an address; write {output.name}, then copy it there",
            where=option,
        )
    if output.exists() and not output.is_file():
        raise UsageError(f"{output} is not a file; name a file", where=option)
    if os.path.lexists(output) and not overwrite:
        other = shlex.quote(str(output.with_name(f"{output.stem}-2{output.suffix}")))
        raise UsageError(
            f"there is a file {output}; replace it by --overwrite, or write elsewhere: "
            f"-o {other}",
            where=option,
        )


def check_writable(folder: Path, *, option: str = ROOT_OPTION) -> None:
    """Check, before the work, that its result can be written in a folder.

    A folder that is not there is not made; the folder above it is checked instead.

    Raises:
        WorkFailedError: nothing can be written there.
    """
    places = [folder.absolute(), *folder.absolute().parents]
    present = next(place for place in places if os.path.lexists(place))
    if not present.is_dir() or not os.access(present, os.W_OK | os.X_OK):
        raise WorkFailedError(
            f"cannot write there; name a folder that you may write to: {option}",
            where=str(folder),
        )


def remove_leftovers(folder: Path) -> list[Path]:
    """Remove temporary files that killed writers left, in subfolders too; return them.

    Call it only while holding the lock of the data set.
    """
    leftovers = []
    for path in sorted(folder.rglob(f".*{SUFFIX}")):
        if not path.is_dir():
            path.unlink(missing_ok=True)
            leftovers.append(path)
    return leftovers


def temporary_name(target: Path) -> Path:
    """Return a temporary name beside a target that no other process uses."""
    return target.with_name(f".{target.name}.{os.getpid()}-{_process_token()}{SUFFIX}")


@functools.cache
def _process_token() -> str:
    """Return a random word; process ids of several machines may be equal."""
    return secrets.token_hex(4)


def explain_write_error(
    target: Path, error: Exception, *, option: str
) -> LagbenchError:
    """Return the error for a file that could not be written.

    HDF5, netCDF and PyTorch do not know the reason: on a full disk netCDF may say that
    permission is denied.

    Args:
        target: the file.
        error: what the operating system or a library raised.
        option: the option or argument that names another file, for the message.
    """
    explained = None
    if isinstance(error, OSError):
        explained = explain_system_error(error)
    if explained is None:
        reason = str(error).partition("\n")[0]
        explained = WorkFailedError(f"{reason}; free disk space")
    return WorkFailedError(
        f"cannot write there: {explained.text}, or name another place: {option}",
        where=str(target),
    )


def _flush(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
