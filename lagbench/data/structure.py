"""Check the structure of a stranger's HDF5 file before its values are read.

HDF5 lets a file point to other files (external links, external storage, virtual data
sets), ask for plug-ins, and claim any size. What a header declares is compared with
what the file holds.

:func:`check_structure` refuses a file. Formats that report all issues together use
:func:`describe_array` and :func:`find_storage_issue`.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from lagbench.errors import UnreadableFileError

from .hdf5 import (
    INSIDE,
    MAX_LINKS,
    hdf5_errors,
    list_members,
    open_variable,
    read_dimensions,
    read_layout,
)

MAX_ATTRIBUTE = 1 << 16
"""Longest attribute that is read [bytes]."""

MAX_CACHE = 1 << 27
"""Most memory for chunks that stay unpacked while rows are read in order [bytes]."""

MAX_CHUNKS = 200_000
"""Most chunks of an array; each costs some microseconds to find."""

HARMLESS_BYTES = 1 << 28
"""Any array or chunk may unpack to this many bytes."""

MAX_ARRAY_RATIO = 200
"""Most unpacked bytes per packed byte of an array beyond HARMLESS_BYTES.

Particles at rest reach 100.
"""

FILTERS = (h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)

TYPE_NAMES = {
    h5py.h5t.STRING: "string",
    h5py.h5t.COMPOUND: "compound",
    h5py.h5t.VLEN: "variable-length",
    h5py.h5t.REFERENCE: "object reference",
    h5py.h5t.ENUM: "enum",
    h5py.h5t.OPAQUE: "opaque",
    h5py.h5t.ARRAY: "array",
    h5py.h5t.BITFIELD: "bit field",
}


# --- what headers say -----------------------------------------------------------------


@dataclass(frozen=True)
class UnusableAttribute:
    """An attribute that exists but cannot be used."""

    reason: str


def read_single_value(owner: h5py.HLObject, name: str) -> object:
    """Return an attribute that is one number or one text.

    None where it is missing, an UnusableAttribute where it is something else.
    """
    if not h5py.h5a.exists(owner.id, name.encode()):
        return None
    attribute = h5py.h5a.open(owner.id, name.encode())
    type_class = attribute.get_type().get_class()
    if type_class not in (h5py.h5t.STRING, h5py.h5t.INTEGER, h5py.h5t.FLOAT):
        return UnusableAttribute("neither a text nor a number")
    if attribute.get_space().get_simple_extent_npoints() != 1:
        return UnusableAttribute("not a single value")
    length = attribute.get_storage_size()
    if length > MAX_ATTRIBUTE:
        return UnusableAttribute(f"{length} bytes")

    value: Any = h5py.AttributeManager(owner)[name]
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.item()
    if isinstance(value, bytes):
        try:
            value = value.decode("utf-8").rstrip("\0")
        except UnicodeDecodeError:
            return UnusableAttribute("no UTF-8")
    if isinstance(value, str) and len(value) > MAX_ATTRIBUTE:
        return UnusableAttribute(f"{len(value)} characters")
    if isinstance(value, (str, int, float)):
        return value
    return UnusableAttribute("neither a text nor a number")


@dataclass(frozen=True, kw_only=True)
class ArrayInfo:
    """A data set as its header describes it."""

    shape: tuple[int, ...] | None  # None where asking could touch another file
    dims: tuple[str, ...]  # an empty name where a dimension has none
    kind: str  # its type in words, such as "float32" or "compound"
    item: int  # length of a value [bytes]
    layout: str  # "contiguous", "chunked", "compact", "virtual" or "external files"
    chunks: tuple[int, ...] | None
    packed: int  # its length in the file, as the file says [bytes]
    largest_chunk: int  # longest packed chunk [bytes]
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

    @property
    def chunk_counts(self) -> tuple[int, ...]:
        """Number of chunks along each dimension; empty where it is not chunked."""
        if self.shape is None or self.chunks is None:
            return ()
        counts = []
        for length, chunk_length in zip(self.shape, self.chunks, strict=True):
            counts.append(-(-length // chunk_length))  # rounded up
        return tuple(counts)


def describe_array(dataset: h5py.Dataset, *, has_dims: bool = True) -> ArrayInfo:
    """Return what the header of a data set says; no value is read.

    Args:
        dataset: the data set.
        has_dims: whether the names of its dimensions are needed, each of which has to
            be looked up.
    """
    creation_properties = dataset.id.get_create_plist()
    layout = read_layout(creation_properties)
    # HDF5 opens the sources of a virtual data set to tell its shape.
    is_inside = layout in INSIDE
    shape = None
    if is_inside and dataset.id.shape is not None:
        shape = tuple(dataset.id.shape)

    chunks = None
    chunk_lengths: list[int] = []
    packed = 0
    if layout == "chunked":
        chunks = tuple(creation_properties.get_chunk())
        dataset.id.chunk_iter(lambda chunk: chunk_lengths.append(chunk.size))
        packed = sum(chunk_lengths)
    elif is_inside:
        packed = dataset.id.get_storage_size()

    filters = []
    foreign_filters = []
    for index in range(creation_properties.get_nfilters()):
        code, *_, description = creation_properties.get_filter(index)
        filters.append(code)
        if code not in FILTERS:
            foreign_filters.append(f"{description.decode('ascii', 'replace')} ({code})")

    value_type = dataset.id.get_type()
    return ArrayInfo(
        shape=shape,
        dims=read_dimensions(dataset) if is_inside and has_dims else (),
        kind=_name_type(value_type),
        item=value_type.get_size(),
        layout=layout,
        chunks=chunks,
        packed=packed,
        largest_chunk=max(chunk_lengths, default=0),
        filters=tuple(filters),
        foreign_filters=tuple(foreign_filters),
    )


def _name_type(value_type: h5py.h5t.TypeID) -> str:
    """Return a type in words; byte order is left out, since HDF5 undoes it."""
    type_class = value_type.get_class()
    bits = 8 * value_type.get_size()
    if type_class == h5py.h5t.FLOAT:
        if value_type in (h5py.h5t.IEEE_F32LE, h5py.h5t.IEEE_F32BE):
            return "float32"
        if bits != 32:
            return f"float{bits}"
        return "a float of 4 bytes, not IEEE"
    if type_class == h5py.h5t.INTEGER:
        if value_type.get_sign() == h5py.h5t.SGN_2:
            return f"int{bits}"
        return f"uint{bits}"
    return TYPE_NAMES.get(type_class, "another type")


def estimate_chunk_cache(array: ArrayInfo) -> tuple[int, int]:
    """Return the bytes and the number of chunks to keep while frames are read in order.

    With this cache no chunk is unpacked twice. Predictions have the axes [scenario,
    frame, particle, space]: the chunks of one frame stay, and if a chunk holds several
    scenarios, the chunks of all their frames. Other files have the axes [frame,
    particle, space]: the chunks of one frame stay if a chunk holds several frames.

    Returns:
        Bytes and number of chunks; 0 and 1 for an array without chunks.
    """
    counts = array.chunk_counts
    if array.chunks is None or not counts:
        return 0, 1

    cached_chunks = math.prod(counts[2:])
    entries_per_chunk = array.chunks[0]  # along the first axis
    has_second_axis = len(counts) > 1
    if entries_per_chunk > 1 and has_second_axis:
        cached_chunks *= counts[1]
    cached_chunks = max(1, cached_chunks)
    return cached_chunks * array.chunk_bytes, cached_chunks


# --- refusing -------------------------------------------------------------------------


class StorageIssue(NamedTuple):
    """A reason to refuse the storage of an array."""

    what: str
    expected: str
    got: str


def find_storage_issue(
    array: ArrayInfo, *, length: int, cache: int = MAX_CACHE
) -> StorageIssue | None:
    """Return why an array must not be read; None where it is sound.

    An array must not reach outside its file, need plug-ins, or claim more than it has.

    Args:
        array: the header of the array.
        length: length of the file [bytes]. Chunks may overlap, and then promise more.
        cache: most memory for chunks that must stay unpacked [bytes].
    """
    if array.shape is None:
        what = "there are no values"
        if "file" in array.layout or array.layout == "virtual":
            what = "the values lie in other files"
        expected = "compact, contiguous or chunked storage in this file"
        return StorageIssue(what, expected, array.layout)
    if array.foreign_filters:
        return StorageIssue(
            "a filter is needed that not every reader has",
            "zlib, shuffle, checksum or none",
            ", ".join(array.foreign_filters),
        )
    # Each zlib in a pipeline multiplies what a chunk may unpack to by a thousand.
    if len(set(array.filters)) < len(array.filters):
        codes = ", ".join(str(code) for code in array.filters[:10])
        return StorageIssue(
            "a filter is applied more than once",
            "each filter at most once",
            f"filters {codes}",
        )
    if array.packed > length:
        return StorageIssue(
            "the values claim more room than the file has",
            f"at most {length} bytes",
            f"{array.packed} bytes in a file of {length}",
        )
    if array.chunks is None or len(array.shape) != len(array.chunks):
        return None
    return _find_chunk_issue(array, cache)


def _find_chunk_issue(array: ArrayInfo, cache: int) -> StorageIssue | None:
    chunk_count = math.prod(array.chunk_counts)
    if chunk_count > MAX_CHUNKS:
        return StorageIssue(
            "too many chunks",
            f"at most {MAX_CHUNKS}",
            f"{chunk_count} of shape {array.chunks}",
        )
    # zlib unpacks as much as the stream says: a thousand times its length at worst.
    if array.largest_chunk > 2 * array.chunk_bytes + 1024:
        return StorageIssue(
            "a chunk is longer packed than unpacked",
            f"about {array.chunk_bytes} bytes at most",
            f"{array.largest_chunk} bytes",
        )
    cache_bytes, _ = estimate_chunk_cache(array)
    if cache_bytes > cache:
        return StorageIssue(
            "frames cannot be read without unpacking much more",
            f"at most {cache} bytes",
            f"chunks {array.chunks}: {cache_bytes} bytes",
        )
    return None


@dataclass(frozen=True, kw_only=True)
class Structure:
    """What a format expects of a file; anything else is refused before it is read."""

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
) -> dict[str, ArrayInfo]:
    """Return the arrays of an open file by name ("a", "group/b"); refuse a trap.

    They have no names of dimensions.

    Refused are links, foreign storage and filters, filters
    that are applied twice, groups and types that the format does not have, and arrays
    that unpack to far more than the file holds, as the headers tell.

    Raises:
        UnreadableFileError: the file has another structure, is damaged, or is a trap.
    """
    length = path.stat().st_size
    arrays = {}
    with hdf5_errors(path):
        for name in _list_arrays(file, path, expected):
            dataset = open_variable(file, name)
            array = describe_array(dataset, has_dims=False)
            issue = find_storage_issue(
                array, length=length, cache=expected.cache
            ) or _find_array_issue(array, expected)
            if issue is not None:
                raise _refusal(path, name, issue)
            arrays[name] = array

    total = sum(array.unpacked + array.chunk_bytes for array in arrays.values())
    if expected.unpacked is not None and total > expected.unpacked:
        issue = StorageIssue(
            "the file unpacks to too much",
            f"at most {expected.unpacked} bytes",
            f"{total} bytes",
        )
        raise _refusal(path, "", issue)
    return arrays


def _list_arrays(file: h5py.File, path: Path, expected: Structure) -> list[str]:
    """Return the names of all arrays; refuse other members than the format has."""

    def may_hold(group: str) -> bool:
        return expected.groups is None or group in expected.groups

    arrays = []
    groups = [""]
    while groups:
        group = groups.pop(0)
        members, count = list_members(file[group or "/"], expected.members)
        if count > expected.members:
            most = f"at most {expected.members}"
            issue = StorageIssue("too many members", most, str(count))
            raise _refusal(path, group, issue)
        for member, kind in members.items():
            name = f"{group}{member}"
            if kind == "variable":
                arrays.append(name)
            elif kind == "group" and not group and may_hold(member):
                groups.append(f"{member}/")
            else:
                issue = StorageIssue("a member that is no variable", "a variable", kind)
                raise _refusal(path, name, issue)
    return arrays


def _find_array_issue(array: ArrayInfo, expected: Structure) -> StorageIssue | None:
    """Return an issue where an array holds neither numbers nor, where the format has
    them, texts, or would unpack to far more than its file holds.
    """
    if array.unpacked > max(HARMLESS_BYTES, MAX_ARRAY_RATIO * array.packed):
        return StorageIssue(
            "the array would unpack to far more than the file holds",
            f"at most {MAX_ARRAY_RATIO} times {array.packed} bytes",
            f"{array.unpacked} bytes",
        )
    if expected.texts and array.kind in ("string", "variable-length"):
        return None
    if array.kind.startswith(("float", "int", "uint")):
        return None
    return StorageIssue("an array of another type", "plain numbers", array.kind)


def _refusal(path: Path, name: str, issue: StorageIssue) -> UnreadableFileError:
    where = str(path)
    if name:
        where = f"{path}, {name!a}"
    return UnreadableFileError(
        f"{issue.what}: {issue.got}; write it again without links, filters of its own, "
        "and arrays larger than their values",
        where=where,
    )
