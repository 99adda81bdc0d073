"""Open a stranger's HDF5 file: regular files of the right kind only, errors that say what is wrong."""

from __future__ import annotations

import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import h5py

from lagbench.errors import LagbenchError, UnreadableFileError

__all__ = ["check_file", "opened", "reading"]

SIGNATURE = b"\x89HDF\r\n\x1a\n"
FOREIGN: Mapping[bytes, str] = {
    b"CDF": "netCDF-3, the old format",
    b"PK\x03\x04": "a zip archive, perhaps .npz",
    b"\x93NUMPY": "a NumPy .npy file",
    b"\x1f\x8b": "a gzip archive",
    b"\x80": "perhaps a Python pickle",
}
"""First bytes to what a file is instead."""


@contextmanager
def reading(path: Path, variable: str | None = None) -> Iterator[None]:
    """Turn whatever HDF5 raises on damaged bytes into an UnreadableFileError."""
    try:
        yield
    except LagbenchError:
        raise
    except Exception as error:  # no list of types holds: damage surfaces as nearly any of them
        raise UnreadableFileError(
            "HDF5 cannot read the file",
            where=str(path) if variable is None else f"{path}, variable {variable!r}",
            expected="an undamaged netCDF4 file",
            got=f"{type(error).__name__}: {' '.join(str(error).split())[:300]}",
            fix="write the file again; if it was copied or downloaded, compare its length",
        ) from error


@contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; no lock, nothing but a regular file."""
    check_file(path)
    with reading(path):
        file = h5py.File(path, "r", locking=False)
    try:
        yield file
    finally:
        file.close()


def check_file(path: Path) -> None:
    """Refuse what is no HDF5 file by its kind and first bytes; a FIFO must not be opened."""
    fix = "write it with lagbench.submission.write, or fill what `lagbench template` writes"
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            kind = "a folder" if path.is_dir() else "a device, socket or pipe"
            raise UnreadableFileError("not a file", where=str(path), expected="a file", got=kind, fix=fix)
        with path.open("rb") as stream:
            head = stream.read(len(SIGNATURE))
    except (OSError, ValueError) as error:
        got = getattr(error, "strerror", None) or error
        fix = "check the path and that you may read the file"
        raise UnreadableFileError(
            "cannot open the file", where=str(path), expected="a readable file", got=got, fix=fix
        ) from error
    if head != SIGNATURE:
        got = next((what for start, what in FOREIGN.items() if head.startswith(start)), _guess(head))
        raise UnreadableFileError(
            "not a netCDF4 file", where=str(path), expected="netCDF4, which is HDF5", got=got, fix=fix
        )


def _guess(head: bytes) -> str:
    if not head:
        return "an empty file"
    return "text" if head.isascii() and head.decode("ascii").isprintable() else "bytes of another format"
