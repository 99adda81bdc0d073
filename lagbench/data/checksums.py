"""Content hashes of the values of a data set, whatever library packed them.

A file hash would change with the compression, the chunks or the version of HDF5. The
content hash of a scenario is built from its values alone, in two levels::

    variable = SHA-256(canonical JSON of {name, dtype, dims, shape}, newline, values)
    content  = SHA-256(canonical JSON of {split, size, major, scenario, subset, seed,
                                          parameters, variables: {name: variable}})

so that variables can be hashed side by side while frames arrive, and a damaged one can
be named. Values are little-endian, in C order, with one zero and one NaN. The full
definition is in docs/format.md.

The file ``.verified.json`` of a data set notes the hashes that this machine computed.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.atomic import write_atomically
from lagbench.errors import (
    DataError,
    UnreadableFileError,
    WorkFailedError,
    check_regular,
)

from .hdf5 import to_plain
from .layout import NOTES_NAME

HASHED_SUBSETS = ("train", "valid", "test")
"""Subsets that the data set hash covers."""

BLOCK_BYTES = 1 << 18
"""Values are made canonical in blocks that fit the second-level cache [bytes]."""


def round_digits(value: float, digits: int = 9) -> float:
    """Return a number rounded to significant digits.

    Every published statistic has nine. Infinities and NaN stay; -0.0 becomes 0.0.

    >>> round_digits(2 / 3), round_digits(2 / 3, 4), round_digits(float("inf"))
    (0.666666667, 0.6667, inf)
    """
    if math.isfinite(value):
        return float(f"{value:.{digits}g}") + 0.0
    return value


def canonical_json(value: object) -> bytes:
    """Return the one JSON text of a value, as UTF-8.

    Keys sorted by code point, no white space, no escapes beyond what JSON demands,
    floats in the shortest form that reads back equal (``repr``), integers without a
    point.

    >>> canonical_json({"b": 1, "a": [-0.0, 1e-7]})
    b'{"a":[0.0,1e-07],"b":1}'
    """
    text = json.dumps(
        to_plain(value),
        sort_keys=True,
        separators=(",", ":"),
        ensure_ascii=False,
        allow_nan=False,
    )
    return text.encode("utf-8")


def dtype_name(dtype: object) -> str:
    """Return the name by which a type enters the hash, byte order left out.

    >>> dtype_name(np.dtype(">f4")), dtype_name(str)
    ('float32', 'string')
    """
    resolved = np.dtype(dtype)  # type: ignore[call-overload]
    if resolved.kind in "OSTU":
        return "string"
    if resolved.kind in "iuf":
        return str(resolved.name)
    raise DataError(
        f"a type cannot be hashed: {resolved}, expected integers, floats or strings"
    )


class VariableHasher:
    """SHA-256 of one variable whose values arrive in C order, piece by piece."""

    def __init__(
        self, name: str, dtype: object, dims: Sequence[object], shape: Sequence[int]
    ) -> None:
        self.name = name  # name of the variable
        self.dtype = dtype_name(dtype)
        self._missing_count = math.prod(shape)
        self._sha = hashlib.sha256()
        self._separator = b""
        header = {
            "name": name,
            "dtype": self.dtype,
            "dims": list(dims),
            "shape": list(shape),
        }
        self._sha.update(canonical_json(header) + b"\n")

    def update(self, values: ArrayLike) -> None:
        """Add the next values.

        Raises:
            DataError: they have another type, or are more than the shape holds.
        """
        array = np.asarray(values)
        if dtype_name(array.dtype) != self.dtype:
            raise self._error("values have another type", self.dtype, array.dtype)
        if array.size > self._missing_count:
            most = f"at most {self._missing_count} more"
            raise self._error("too many values", most, array.size)
        self._missing_count -= array.size
        if self.dtype == "string":
            self._update_strings(array)
        else:
            self._update_numbers(array)

    def _update_strings(self, array: NDArray[Any]) -> None:
        """Add texts, joined by NUL."""
        for item in array.reshape(-1).tolist():
            text = to_plain(item)
            if not isinstance(text, str):
                raise self._error("a value is not a string", "a string", repr(item))
            self._sha.update(self._separator + text.encode("utf-8"))
            self._separator = b"\0"

    def _update_numbers(self, array: NDArray[Any]) -> None:
        little_endian = array.dtype.newbyteorder("<")
        values = array.astype(little_endian, order="C", copy=False).reshape(-1)
        step = BLOCK_BYTES // values.itemsize
        for start in range(0, values.size, step):
            block = _canonical_block(values[start : start + step])
            self._sha.update(block.data)

    def hexdigest(self) -> str:
        """Return the hash, 64 hex digits.

        Raises:
            DataError: fewer values have arrived than the shape holds.
        """
        if self._missing_count:
            raise self._error(
                "values are missing",
                "as many as the shape holds",
                f"{self._missing_count} fewer",
            )
        return self._sha.hexdigest()

    def _error(self, what: str, expected: object, got: object) -> DataError:
        return DataError(
            f"{what}: got {got}, expected {expected}", where=f"variable {self.name!r}"
        )


def _canonical_block(block: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return a block with one zero and one NaN; the same block if nothing changes."""
    if block.dtype.kind != "f":
        return block
    bits = block.view(f"<i{block.itemsize}")
    # The bits of -0.0 are the smallest integer of their width, and a minimum passes NaN
    # on: two fast reductions find both, and integers keep subnormals where a library
    # flushes them to zero.
    negative_zero = np.iinfo(bits.dtype).min
    if bits.min() > negative_zero and not np.isnan(block.min()):
        return block
    nan_bits = np.full(1, np.nan, block.dtype).view(bits.dtype)[0]
    canonical_bits = bits.copy()
    canonical_bits[bits == negative_zero] = 0
    canonical_bits[np.isnan(block)] = nan_bits
    return canonical_bits


class ContentHasher:
    """Content hash of a scenario whose variables arrive side by side."""

    def __init__(self, identity: Mapping[str, object]) -> None:
        self.identity = identity  # the hashed part beside the variables
        self._variables: dict[str, VariableHasher] = {}

    def declare(
        self, name: str, dtype: object, dims: Sequence[object], shape: Sequence[int]
    ) -> None:
        """Announce a variable before its values come."""
        self._variables[name] = VariableHasher(name, dtype, dims, shape)

    def update(self, name: str, values: ArrayLike) -> None:
        """Add the next values of a variable, in C order."""
        self._variables[name].update(values)

    def digests(self) -> dict[str, str]:
        """Return the hash of every variable, sorted by name."""
        digests = {}
        for name in sorted(self._variables):
            digests[name] = self._variables[name].hexdigest()
        return digests

    def hexdigest(self) -> str:
        """Return the content hash, 64 hex digits."""
        whole = {**self.identity, "variables": self.digests()}
        return hashlib.sha256(canonical_json(whole)).hexdigest()


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def subset_hash(hashes: Mapping[int, str]) -> str:
    """Return the SHA-256 of the lines ``{id:04d} {content hash}``, by id."""
    lines = []
    for scenario in sorted(hashes):
        lines.append(f"{scenario:04d} {hashes[scenario]}\n")
    text = "".join(lines)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def dataset_hash(split: str, size: str, major: int, subsets: Mapping[str, str]) -> str:
    """Return the data set hash over train, valid and test, without other subsets.

    Raises:
        DataError: the hash of one of the three is missing.
    """
    missing = []
    for subset in HASHED_SUBSETS:
        if subset not in subsets:
            missing.append(subset)
    if missing:
        raise DataError(
            "the data set hash needs every subset",
            where=f"{split} {size}",
            got=f"no {missing}",
        )
    hashed = {subset: subsets[subset] for subset in HASHED_SUBSETS}
    whole = {"split": split, "size": size, "major": major, "subsets": hashed}
    return hashlib.sha256(canonical_json(whole)).hexdigest()


# --- hashes that this machine has computed --------------------------------------------

# Hashing the values of a large file takes seconds, and a manifest is a claim of whoever
# wrote it. So this machine notes the files whose values it has hashed. A note counts
# for that very file alone: nobody can set the time of its last change of any kind
# (ctime), so notes that came with a copied or downloaded folder count for nothing.

NOTES_LIMIT = 64 << 20
"""Longest file of notes that is read [bytes]."""


class _HashNote(NamedTuple):
    """A file whose values were hashed."""

    bytes: int
    modified: int  # time of the last change of its bytes [ns]
    changed: int  # time of the last change of any kind [ns]
    file_sha256: str
    content_sha256: str

    @property
    def stamp(self) -> tuple[int, int, int]:
        """Length and times of the file."""
        return self.bytes, self.modified, self.changed

    def says(self, stamp: tuple[int, int, int], content_sha256: str) -> bool:
        """Tell whether this is the note of a file with that stamp and content."""
        return self.stamp == stamp and self.content_sha256 == content_sha256


_read_in_process: dict[Path, _HashNote] = {}
"""Files whose bytes this process has read.

They are not read again while their times stay.
"""


def record_hashes(
    folder: Path,
    contents: Mapping[Path, str],
    *,
    file_hashes: Mapping[Path, str] | None = None,
) -> None:
    """Note content hashes of files that this machine has just hashed or written.

    Where the folder cannot be written to, nothing is noted. A file that is gone by now
    gets no note.

    Args:
        folder: folder of the data set.
        contents: content hashes by path.
        file_hashes: SHA-256 of the files' bytes by path, if they are known from before
            the values were read. The bytes of all other files are read here.
    """
    if not contents:
        return
    known_file_hashes = file_hashes or {}
    old_notes = _read_hash_notes(folder)
    new_notes = {}
    for path, content in contents.items():
        try:
            stamp = _file_stamp(path)
        except FileNotFoundError:
            continue  # another process has removed it meanwhile
        name = _relative_name(path, folder)
        old_note = old_notes.get(name)
        if old_note is not None and old_note.says(stamp, content):
            continue
        # The stamp is from before the bytes are read: if the file changes meanwhile,
        # its new stamp is not that of its note.
        if path in known_file_hashes:
            note = _HashNote(*stamp, known_file_hashes[path], content)
        else:
            note = _HashNote(*stamp, file_sha256(path), content)
            _read_in_process[path] = note
        new_notes[name] = note
    if new_notes:
        text = json.dumps(old_notes | new_notes, indent=1) + "\n"
        with suppress(WorkFailedError):
            write_atomically(folder / NOTES_NAME, text.encode())


def load_recorded_hashes(folder: Path) -> Callable[[Path], tuple[str, str] | None]:
    """Return a function from a file to its noted content hash and SHA-256.

    The function returns None for a file that was not hashed here or has changed since.
    It reads the bytes once in a process; values are not unpacked. It takes paths below
    the folder, and raises an OSError for a file that was hashed and cannot be read now.
    """
    notes = _read_hash_notes(folder)

    def find_hashes(path: Path) -> tuple[str, str] | None:
        note = notes.get(_relative_name(path, folder))
        if note is None or note.stamp != _file_stamp(path):
            return None
        if _read_in_process.get(path) != note:
            if file_sha256(path) != note.file_sha256:
                return None
            _read_in_process[path] = note
        return note.content_sha256, note.file_sha256

    return find_hashes


def _read_hash_notes(folder: Path) -> dict[str, _HashNote]:
    """Return the notes of ``.verified.json`` by the files' relative names.

    A file that is missing or damaged has no notes: that costs another hashing only.
    """
    path = folder / NOTES_NAME
    notes = {}
    try:
        check_regular(path, longest=NOTES_LIMIT)
        for name, row in json.loads(path.read_bytes()).items():
            notes[name] = _HashNote(*row)
    except (
        UnreadableFileError,
        OSError,
        ValueError,
        TypeError,
        AttributeError,
        RecursionError,
    ):
        return {}
    return notes


def _file_stamp(path: Path) -> tuple[int, int, int]:
    status = path.stat()
    return status.st_size, status.st_mtime_ns, status.st_ctime_ns


def _relative_name(path: Path, folder: Path) -> str:
    return path.relative_to(folder).as_posix()
