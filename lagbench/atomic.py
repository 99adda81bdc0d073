"""Files that appear whole or not at all: temporary name, fsync, rename."""

from __future__ import annotations

import errno
import functools
import hashlib
import os
import secrets
import shlex
import stat
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from .errors import (
    DISK_FULL_ERRORS,
    LIMIT_FIXES,
    LagbenchError,
    UsageError,
    WorkFailedError,
)

SUFFIX = ".partial"
"""Ending of temporary names; nothing but this module creates or removes such files."""

LONGEST_KEPT_NAME = 200
"""Longest name that a temporary name repeats [bytes]; a name has at most 255."""

SIGNED_BYTES = 4 << 20
"""How much of a file is read to learn its kind [bytes]."""

PROBE_BYTES = 1 << 20
"""Length of a file that finds out why a library could not write [bytes]."""

ROOT_OPTION = "--root or LAGBENCH_ROOT"
"""The option that names the folder for most files."""


@contextmanager
def atomic_path(
    target: Path, *, option: str = ROOT_OPTION, replaced: Iterable[Path] = ()
) -> Iterator[Path]:
    """Yield a temporary name beside the target; rename it there on a clean exit.

    The parent folder is created. Before the rename the file is flushed to disk, after
    it the folder is, so that a crash at any time leaves the old file or the new one.
    When the body raises, the temporary file is removed and the target stays as it was.

    Args:
        target: the file.
        option: the option that names another folder, for messages.
        replaced: other files that the target replaces; they are removed between the
            flush and the rename.

    Raises:
        WorkFailedError: the operating system refused, or a device, socket or pipe has
            the name of the target.
    """
    _refuse_special(target)
    temporary = temporary_name(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush(temporary)
        for file in replaced:
            file.unlink(missing_ok=True)
        temporary.replace(target)
        _flush_folder(target.parent)
    except LagbenchError:
        raise
    except OSError as error:
        raise _write_error(target, option, error) from error
    finally:
        _discard(temporary)


def write_atomically(target: Path, data: bytes, *, option: str = ROOT_OPTION) -> None:
    """Write bytes to a file that appears whole or not at all."""
    with atomic_path(target, option=option) as temporary:
        temporary.write_bytes(data)


@contextmanager
def checked_path(target: Path, *, option: str) -> Iterator[Path]:
    """Yield a file of the same name in a temporary folder, to write and to check.

    On a clean exit the target gets its content. An error of the check names the target
    too: the temporary folder is gone when the user reads it.

    Raises:
        WorkFailedError: the operating system refused.
    """
    check_writable(target.parent, option=option)
    with tempfile.TemporaryDirectory() as folder:
        unchecked = Path(folder) / target.name
        try:
            yield unchecked
        except LagbenchError as error:
            error.add_note(f"which was to become {target}")
            raise
        write_atomically(target, unchecked.read_bytes(), option=option)


def _refuse_special(target: Path) -> None:
    """Refuse to replace a device, socket or pipe; the superuser's rename would."""
    try:
        mode = target.lstat().st_mode
    except OSError:
        return  # nothing is there, or the write names the error
    if stat.S_ISREG(mode) or stat.S_ISLNK(mode) or stat.S_ISDIR(mode):
        return
    raise WorkFailedError(
        "the output is no file",
        where=str(target),
        expected="the name of a file",
        got="a device, socket or pipe",
        fix="name a file",
    )


def move_together(moves: Sequence[tuple[Path, Path]]) -> None:
    """Rename files to places on the same disk, in their order.

    The steps that fail most often come first: files are flushed and folders made before
    the first file is moved. If a move fails, the moves before it stay.
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
    """Raise IsADirectoryError for a folder where a file is replaced or removed."""
    for path in paths:
        if path.is_dir() and not path.is_symlink():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))


def check_output_file(
    output: Path,
    *,
    overwrite: bool,
    signs: Sequence[bytes] = (),
    option: str = "--output",
) -> None:
    """Refuse, before the work, a file to write that must not be replaced.

    Args:
        output: the file that ``option`` names, or one beside it.
        overwrite: whether the user allows to replace a file of that name.
        signs: bytes that a file of the kind that is written has near its beginning;
            files that lack one are never replaced.
        option: the option or argument that names the file, for messages.

    Raises:
        UsageError: it is a folder, a device or a file of another kind, or there is such
            a file.
    """
    if not os.path.lexists(output):
        return
    if output.is_dir():
        raise UsageError(
            "the output is a folder",
            where=option,
            expected="the name of a file",
            got=str(output),
            fix="name a file, also one in that folder",
        )
    if output.exists() and not output.is_file():
        raise UsageError(
            "the output is no file",
            where=option,
            expected="the name of a file",
            got=f"{output}, a device, socket or pipe",
            fix="name a file",
        )
    if signs and not _has_signs(output, signs):
        raise UsageError(
            "the output would replace a file that is something else",
            where=option,
            expected="no file, or one of the kind that is written",
            got=str(output),
            fix="name another file",
        )
    if not overwrite:
        other = output.with_name(f"{output.stem}-2{output.suffix}")
        raise UsageError(
            "there is such a file already",
            where=option,
            expected="a file that is not there yet",
            got=str(output),
            fix="replace it: --overwrite; or write elsewhere, as in -o "
            f"{shlex.quote(str(other))}",
        )


def _has_signs(path: Path, signs: Sequence[bytes]) -> bool:
    """Tell whether a file is empty or has all signs of its kind."""
    if not path.exists():  # a link that leads nowhere
        return True
    with path.open("rb") as stream:
        beginning = stream.read(SIGNED_BYTES)
    return not beginning or all(sign in beginning for sign in signs)


def check_writable(folder: Path, *, option: str = ROOT_OPTION) -> None:
    """Check, before the work, that its result can be written in a folder.

    A folder that is not there is not made: a command that is refused later would leave
    it empty. The folder above, in which it will be made, is checked instead.

    Args:
        folder: the folder.
        option: the option that names another folder, for the message.

    Raises:
        WorkFailedError: the operating system refused.
    """
    try:
        present_folder = _find_present(folder)
        probe = temporary_name(present_folder / "probe")
        try:
            probe.touch()
        finally:
            _discard(probe)
    except OSError as error:
        raise _write_error(folder, option, error) from error


def _find_present(folder: Path) -> Path:
    """Return a folder, or the nearest one above it that is there.

    Raises:
        OSError: no folder can be made below the nearest place.
    """
    for place in (folder, *folder.parents):
        try:
            place.lstat()
        except FileNotFoundError:
            continue
        if not place.is_dir():
            code = errno.ENOTDIR
            raise NotADirectoryError(code, os.strerror(code), str(place))
        return place
    return folder


def remove_leftovers(folder: Path) -> list[Path]:
    """Remove temporary files that killed writers left, in subfolders too; return them.

    Call it only while holding the lock of the data set.
    """
    leftovers = []
    for path in sorted(folder.rglob(f".*{SUFFIX}")):
        if path.is_dir():
            continue  # no writer of ours makes it
        path.unlink(missing_ok=True)
        leftovers.append(path)
    return leftovers


def temporary_name(target: Path) -> Path:
    """Return a temporary name beside a target that no other process uses."""
    name = target.name
    encoded_name = os.fsencode(name)
    if len(encoded_name) > LONGEST_KEPT_NAME:
        name = hashlib.sha256(encoded_name).hexdigest()
    return target.with_name(f".{name}.{os.getpid()}-{_process_token()}{SUFFIX}")


@functools.cache
def _process_token() -> str:
    """Return a random word; process ids of several machines may be equal."""
    return secrets.token_hex(4)


def explain_write_error(
    target: Path, error: Exception, *, option: str
) -> WorkFailedError:
    """Return the error for a file that a library could not write.

    HDF5, netCDF and PyTorch do not know the reason: on a full disk netCDF may say that
    permission is denied. So a probe is written beside the file, and the error of the
    probe counts.

    Args:
        target: the file.
        error: what the library raised.
        option: the option or argument that names another file, for the message.
    """
    probe = temporary_name(target.with_name("probe"))
    try:
        probe.write_bytes(bytes(PROBE_BYTES))
        _flush(probe)
    except OSError as probe_error:
        return _write_error(target, option, probe_error)
    finally:
        _discard(probe)
    return WorkFailedError(
        "cannot write there",
        where=str(target),
        expected="a place that can be written to",
        got=str(error).partition("\n")[0],
        fix=f"free disk space, or name a folder that you may write to: {option}; if "
        f"there is space, {LIMIT_FIXES[errno.EFBIG]}",
    )


def _write_error(target: Path, option: str, error: OSError) -> WorkFailedError:
    hint = "see that the disk is there and can be written to"
    if error.errno in DISK_FULL_ERRORS:
        hint = "free disk space"
    if error.errno in LIMIT_FIXES:
        hint = LIMIT_FIXES[error.errno]
    if isinstance(error, PermissionError):
        hint = "see who owns the folder"
    if isinstance(error, (FileExistsError, NotADirectoryError)):
        hint = "a file is where a folder has to be: move it"
    if isinstance(error, IsADirectoryError):
        hint = "a folder is where the file has to be: move it"
    return WorkFailedError(
        "cannot write there",
        where=str(target),
        expected="a place that can be written to",
        got=error.strerror or error,
        fix=f"{hint}, or name a folder that you may write to: {option}",
    )


def _discard(path: Path) -> None:
    # A folder that is missing or read-only holds no temporary file of ours.
    with suppress(OSError):
        path.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    # Windows flushes only files that are open for writing.
    if os.name == "nt":
        flags = os.O_RDWR
    else:
        flags = os.O_RDONLY
    descriptor = os.open(path, flags)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _flush_folder(path: Path) -> None:
    with suppress(PermissionError):  # Windows opens no folder
        _flush(path)
