"""Look at a stranger's HDF5 file without trusting it: what it holds, before values are
read.

HDF5 lets a file point to other files (external links, external storage, virtual data
sets), ask for plug-ins, and claim any size. Here links are listed and never followed,
and what a header declares is held against what the file holds. :func:`check_structure`
refuses a file; formats that report all their findings together use :func:`describe` and
:func:`storage_problem`.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from lagbench.errors import LagbenchError, UnreadableFileError, check_regular

MAX_LINKS = 1000
"""Most entries of a group that are looked at."""

MAX_ATTRIBUTE = 1 << 16
"""Longest attribute that is read [bytes]."""

MAX_CACHE = 1 << 27
"""Most memory for chunks that must stay unpacked while rows are read in order [bytes].
"""

MAX_CHUNKS = 200_000
"""Most chunks of an array; each costs some microseconds to find."""

HARMLESS = 1 << 28
"""Bytes that may come of anything."""

DEFLATE_RATIO = 1032
"""No zlib stream unpacks to more than this many times its length."""

MOST = 200
"""Times its packed length that an array beyond HARMLESS may unpack to; particles at
rest reach 100.
"""

SIGNATURE = b"\x89HDF\r\n\x1a\n"
FOREIGN: Mapping[bytes, str] = {
    b"CDF": "netCDF-3, the old format",
    b"PK\x03\x04": "a zip archive, perhaps .npz",
    b"\x93NUMPY": "a NumPy .npy file",
    b"\x1f\x8b": "a gzip archive",
    b"\x80": "perhaps a Python pickle",
}
FILTERS = (h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)
LAYOUTS = {
    h5py.h5d.COMPACT: "compact",
    h5py.h5d.CONTIGUOUS: "contiguous",
    h5py.h5d.CHUNKED: "chunked",
    h5py.h5d.VIRTUAL: "virtual",
}
INSIDE = ("compact", "contiguous", "chunked")
"""Layouts of arrays whose values lie in the file itself."""

KINDS = {
    h5py.h5t.STRING: "string",
    h5py.h5t.COMPOUND: "compound",
    h5py.h5t.VLEN: "variable-length",
    h5py.h5t.REFERENCE: "object reference",
    h5py.h5t.ENUM: "enum",
    h5py.h5t.OPAQUE: "opaque",
    h5py.h5t.ARRAY: "array",
    h5py.h5t.BITFIELD: "bit field",
}
LINKS = {h5py.h5l.TYPE_SOFT: "soft link", h5py.h5l.TYPE_EXTERNAL: "external link"}
OBJECTS = {h5py.h5o.TYPE_GROUP: "group", h5py.h5o.TYPE_DATASET: "variable"}

AGAIN = "write the file again; if it was copied or downloaded, compare its length"


def check_file(path: Path, *, longest: int | None = None, fix: str = AGAIN) -> None:
    """Refuse what is no HDF5 file by its kind, length and first bytes."""
    check_regular(path, longest=longest, fix=fix)
    try:
        with path.open("rb") as stream:
            head = stream.read(len(SIGNATURE))
    except OSError as error:
        raise UnreadableFileError(
            "cannot open the file",
            where=str(path),
            expected="a readable file",
            got=error.strerror or error,
            fix="check the path and that you may read the file",
        ) from error
    if head != SIGNATURE:
        text = head.isascii() and head.decode("ascii").isprintable()
        if head:
            guess = "text" if text else "bytes of another format"
        else:
            guess = "an empty file"
        got = next(
            (what for start, what in FOREIGN.items() if head.startswith(start)), guess
        )
        expected = "HDF5, as netCDF4 is"
        raise UnreadableFileError(
            "not an HDF5 file", where=str(path), expected=expected, got=got, fix=fix
        )


@contextmanager
def reading(path: Path, variable: str | None = None) -> Iterator[None]:
    """Turn whatever HDF5 raises on damaged bytes into an UnreadableFileError."""
    try:
        yield
    except LagbenchError:
        raise
    except (
        Exception
    ) as error:  # no list of types holds: damage surfaces as nearly any of them
        raise UnreadableFileError(
            "HDF5 cannot read the file",
            where=str(path) if variable is None else f"{path}, variable {variable!r}",
            expected="an undamaged HDF5 file",
            got=f"{type(error).__name__}: {' '.join(str(error).split())[:300]}",
            fix=AGAIN,
        ) from error


@contextmanager
def opened(
    path: Path, *, longest: int | None = None, fix: str = AGAIN
) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading: no lock, nothing but a regular file of bounded
    length.
    """
    check_file(path, longest=longest, fix=fix)
    with reading(path):
        file = h5py.File(path, "r", locking=False)
    with file:
        yield file


@dataclass(frozen=True)
class Odd:
    """An attribute that is there but cannot be used, and why."""

    reason: str


class Problem(NamedTuple):
    """What is wrong with the storage of an array, what would be right, and what was
    found.
    """

    what: str
    expected: str
    got: str


@dataclass(frozen=True, kw_only=True)
class Array:
    """A data set as its header describes it."""

    shape: tuple[int, ...] | None  # None where asking could touch another file
    dims: tuple[str, ...]  # an empty name where a dimension has none
    kind: str  # its type in words, such as "float32" or "compound"
    item: int  # length of a value [bytes]
    layout: str  # "contiguous", "chunked", "compact", "virtual" or "external files"
    chunks: tuple[int, ...] | None
    packed: int  # what the file says to hold of it [bytes]
    largest_chunk: int  # longest chunk as it is packed [bytes]
    filters: tuple[int, ...]
    foreign_filters: tuple[str, ...]  # those beyond zlib, shuffle and checksum, by name

    @property
    def unpacked(self) -> int:
        """Length of all values [bytes]."""
        return self.item * math.prod(self.shape or (0,))

    @property
    def chunk_bytes(self) -> int:
        """Length of an unpacked chunk [bytes]; 0 where it is not chunked."""
        if self.chunks:
            return self.item * math.prod(self.chunks)
        return 0


def members_of(group: h5py.Group, most: int = MAX_LINKS) -> tuple[dict[str, str], int]:
    """Return the first members of a group with what each is, and how many there are.

    A member is a "variable", "group", "named type", "soft link", "external link" or
    "user-defined link".
    """
    count: int = group.id.get_num_objs()
    found = {}
    for index in range(min(count, most)):
        name = group.id.get_objname_by_idx(index)
        kind = group.id.links.get_info(name).type
        word = LINKS.get(kind, "user-defined link")
        if kind == h5py.h5l.TYPE_HARD:
            word = OBJECTS.get(h5py.h5o.get_info(group.id, name).type, "named type")
        found[name.decode("utf-8", "backslashreplace")] = word
    return found, count


def attribute_of(owner: h5py.HLObject, name: str) -> object:
    """Return a number or a text; None where it is missing, Odd where it is neither."""
    if not h5py.h5a.exists(owner.id, name.encode()):
        return None
    attribute = h5py.h5a.open(owner.id, name.encode())
    kind = attribute.get_type().get_class()
    if kind not in (h5py.h5t.STRING, h5py.h5t.INTEGER, h5py.h5t.FLOAT):
        return Odd("neither a text nor a number")
    if attribute.get_space().get_simple_extent_npoints() != 1:
        return Odd("not a single value")
    if attribute.get_storage_size() > MAX_ATTRIBUTE:
        return Odd(f"{attribute.get_storage_size()} bytes")
    value: Any = owner.attrs[name]
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.item()
    if isinstance(value, bytes):
        try:
            value = value.decode("utf-8").rstrip("\0")
        except UnicodeDecodeError:
            return Odd("no UTF-8")
    if isinstance(value, str) and len(value) > MAX_ATTRIBUTE:
        return Odd(f"{len(value)} characters")
    if isinstance(value, (str, int, float)):
        return value
    return Odd("neither a text nor a number")


def layout_of(dataset: h5py.Dataset) -> str:
    """Return how the values are stored: one of :data:`INSIDE`, "virtual", "external
    files" or "unknown".
    """
    plist = dataset.id.get_create_plist()
    if plist.get_external_count():
        return "external files"
    return LAYOUTS.get(plist.get_layout(), "unknown")


def describe(dataset: h5py.Dataset) -> Array:
    """Return what the header of a data set says; no value is read."""
    plist = dataset.id.get_create_plist()
    layout = layout_of(dataset)
    # HDF5 opens the sources of a virtual data set to tell its shape.
    elsewhere = layout not in INSIDE
    plain = (h5py.h5s.SIMPLE, h5py.h5s.SCALAR)
    simple = not elsewhere and dataset.id.get_space().get_simple_extent_type() in plain
    filters = [plist.get_filter(i) for i in range(plist.get_nfilters())]
    sizes: list[int] = []
    if layout == "chunked":
        dataset.id.chunk_iter(lambda chunk: sizes.append(chunk.size))
    kind = dataset.id.get_type()
    return Array(
        shape=tuple(dataset.id.shape) if simple else None,
        dims=() if elsewhere else dims_of(dataset),
        kind=_kind(kind),
        item=kind.get_size(),
        layout=layout,
        chunks=tuple(plist.get_chunk()) if layout == "chunked" else None,
        packed=sum(sizes)
        if layout == "chunked"
        else 0
        if elsewhere
        else dataset.id.get_storage_size(),
        largest_chunk=max(sizes, default=0),
        filters=tuple(code for code, *_ in filters),
        foreign_filters=tuple(
            f"{text.decode('ascii', 'replace')} ({code})"
            for code, *_, text in filters
            if code not in FILTERS
        ),
    )


def dims_of(dataset: h5py.Dataset) -> tuple[str, ...]:
    """Return the names of the dimension scales that netCDF attaches, one per
    dimension.
    """
    rank: int = dataset.id.rank
    if not h5py.h5a.exists(dataset.id, b"DIMENSION_LIST"):
        return ("",) * rank
    attribute = h5py.h5a.open(dataset.id, b"DIMENSION_LIST")
    kind = attribute.get_type()
    is_list = (
        kind.get_class() == h5py.h5t.VLEN
        and kind.get_super().get_class() == h5py.h5t.REFERENCE
    )
    if not is_list or attribute.shape != (rank,):
        return ("",) * rank
    scales = dataset.attrs["DIMENSION_LIST"]
    names = (
        h5py.h5r.get_name(scale[0], dataset.id) or b"" if len(scale) else b""
        for scale in scales
    )
    return tuple(
        name.decode("utf-8", "backslashreplace").rsplit("/", 1)[-1] for name in names
    )


def _kind(kind: h5py.h5t.TypeID) -> str:
    """Return a type in words; byte order is left out, since HDF5 undoes it."""
    if kind.get_class() == h5py.h5t.FLOAT:
        if kind in (h5py.h5t.IEEE_F32LE, h5py.h5t.IEEE_F32BE):
            return "float32"
        if kind.get_size() != 4:
            return f"float{8 * kind.get_size()}"
        return "a float of 4 bytes, not IEEE"
    if kind.get_class() == h5py.h5t.INTEGER:
        if kind.get_sign() == h5py.h5t.SGN_2:
            sign = ""
        else:
            sign = "u"
        return f"{sign}int{8 * kind.get_size()}"
    return KINDS.get(kind.get_class(), "another type")


def cache_of(array: Array) -> tuple[int, int]:
    """Return the bytes and the number of chunks to keep while frames are read in order.

    A chunk is unpacked once if all chunks that a frame touches stay until the frames,
    and for chunks over several scenarios the scenarios, that share them are through.
    """
    if array.chunks is None or array.shape is None:
        return 0, 1
    counts = [-(-n // c) for n, c in zip(array.shape, array.chunks, strict=True)]
    if array.chunks[0] > 1:
        rows = counts[1:2]
    else:
        rows = []
    kept = max(1, math.prod([*rows, *counts[2:]]))
    return kept * array.chunk_bytes, kept


def storage_problem(
    array: Array, *, length: int, cache: int = MAX_CACHE
) -> Problem | None:
    """Return why an array reaches outside its file, needs plug-ins, or is a trap; None
    where it is sound.

    ``length`` is that of the file [bytes]: chunks may overlap, and then promise more
    than it has; ``cache`` the most memory for chunks that must stay unpacked [bytes].
    """
    if array.shape is None:
        away = "file" in array.layout or array.layout == "virtual"
        if away:
            what = "the values lie in other files"
        else:
            what = "there are no values"
        return Problem(
            what, "compact, contiguous or chunked storage in this file", array.layout
        )
    if array.foreign_filters:
        got = ", ".join(array.foreign_filters)
        return Problem(
            "a filter is needed that not every reader has",
            "zlib, shuffle, checksum or none",
            got,
        )
    if len(set(array.filters)) < len(array.filters):
        # Each zlib in a pipeline multiplies what a chunk may unpack to by a thousand.
        got = f"filters {', '.join(map(str, array.filters[:10]))}"
        return Problem(
            "a filter is applied more than once", "each filter at most once", got
        )
    if array.packed > length:
        got = f"{array.packed} bytes in a file of {length}"
        return Problem(
            "the values claim more room than the file has",
            f"at most {length} bytes",
            got,
        )
    if array.chunks is None or len(array.shape) != len(array.chunks):
        return None
    count = math.prod(
        -(-n // c) for n, c in zip(array.shape, array.chunks, strict=True)
    )
    if count > MAX_CHUNKS:
        return Problem(
            "too many chunks",
            f"at most {MAX_CHUNKS}",
            f"{count} of shape {array.chunks}",
        )
    whole = array.chunk_bytes
    if array.largest_chunk > 2 * whole + 1024:
        # zlib unpacks as much as the stream says: a thousand times its length at worst.
        got = f"{array.largest_chunk} bytes"
        return Problem(
            "a chunk is longer packed than unpacked",
            f"about {whole} bytes at most",
            got,
        )
    size = cache_of(array)[0]
    if size > cache:
        got = f"chunks {array.chunks}: {size} bytes"
        return Problem(
            "frames cannot be read without unpacking much more",
            f"at most {cache} bytes",
            got,
        )
    return None


@dataclass(frozen=True, kw_only=True)
class Structure:
    """What a format expects of a file: everything else is refused before a value is
    read.
    """

    members: int = MAX_LINKS  # most members of a group
    # groups below the root that it may have; None: any
    groups: Collection[str] | None = ()
    # whether arrays may hold texts; these share one heap of any length
    texts: bool = False
    unpacked: int | None = None  # most bytes that all arrays together may become
    # most bytes of chunks that must stay unpacked while frames are read in order
    cache: int = MAX_CACHE


def check_structure(
    file: h5py.File, path: Path, expected: Structure
) -> dict[str, Array]:
    """Return the arrays of an open file by name ("a", "group/b"); refuse what may harm
    a reader.

    Refused are links, foreign storage and filters, filters that are applied twice,
    groups and types that the format does not have, and arrays that unpack to far more
    than the file holds: by their headers, and large chunks by unpacking them up to the
    length that they declare.
    """

    def refused(name: str, what: str, wanted: str, got: str) -> UnreadableFileError:
        if name:
            where = f"{path}, {name!a}"
        else:
            where = str(path)
        fix = "write it again without links, filters of its own, and arrays larger than their values"
        return UnreadableFileError(what, where=where, expected=wanted, got=got, fix=fix)

    def names() -> Iterator[str]:
        root, _ = members_of(file["/"], expected.members)
        for prefix in [
            "",
            *(f"{name}/" for name, kind in root.items() if kind == "group"),
        ]:
            members, count = members_of(file[prefix or "/"], expected.members)
            if count > expected.members:
                raise refused(
                    prefix,
                    "too many members",
                    f"at most {expected.members}",
                    str(count),
                )
            for name, kind in members.items():
                if kind == "variable":
                    yield f"{prefix}{name}"
                elif (
                    kind != "group"
                    or prefix
                    or not (expected.groups is None or name in expected.groups)
                ):
                    raise refused(
                        prefix + name,
                        "a member that is no variable",
                        "a variable",
                        kind,
                    )

    length = path.stat().st_size
    found = {}
    with reading(path):
        for name in names():
            array = found[name] = describe(file[name])
            if problem := storage_problem(array, length=length, cache=expected.cache):
                raise refused(name, *problem)
            text = expected.texts and array.kind in ("string", "variable-length")
            if not text and not array.kind.startswith(("float", "int", "uint")):
                raise refused(
                    name, "an array of another type", "plain numbers", array.kind
                )
            if problem := _inflation(file[name], array):
                raise refused(name, *problem)
    total = sum(array.unpacked + array.chunk_bytes for array in found.values())
    if expected.unpacked is not None and total > expected.unpacked:
        most = f"at most {expected.unpacked} bytes"
        raise refused("", "the file unpacks to too much", most, f"{total} bytes")
    return found


def _inflation(dataset: h5py.Dataset, array: Array) -> Problem | None:
    """Hold what an array declares against what its chunks hold."""
    if array.unpacked > max(HARMLESS, MOST * array.packed):
        what = "the array would unpack to far more than the file holds"
        return Problem(
            what,
            f"at most {MOST} times {array.packed} bytes",
            f"{array.unpacked} bytes",
        )
    if (
        array.largest_chunk * DEFLATE_RATIO <= HARMLESS
        or h5py.h5z.FILTER_DEFLATE not in array.filters
    ):
        return None
    places: list[tuple[int, ...]] = []
    dataset.id.chunk_iter(
        lambda chunk: (
            places.append(chunk.chunk_offset)
            if chunk.size * DEFLATE_RATIO > HARMLESS
            else None
        )
    )
    most = array.chunk_bytes + 4  # a checksum may stand behind the values
    for place in places:
        mask, raw = dataset.id.read_direct_chunk(place)
        applied = [
            code for bit, code in enumerate(array.filters) if not mask >> bit & 1
        ]
        if h5py.h5z.FILTER_DEFLATE not in applied:
            continue
        after = applied[applied.index(h5py.h5z.FILTER_DEFLATE) + 1 :]
        packed = bytes(raw)[: len(raw) - 4 * len(after)]
        # no writer packs first and shuffles then
        if (
            h5py.h5z.FILTER_SHUFFLE in after
            or len(zlib.decompressobj().decompress(packed, most + 1)) > most
        ):
            return Problem(
                "a chunk unpacks to more than it declares",
                f"{array.chunk_bytes} bytes",
                "more",
            )
    return None
