"""Look at a stranger's HDF5 file without trusting it: what it holds, before values are read.

HDF5 lets a file point to other files (external links, external storage, virtual data sets),
ask for plug-ins, and claim any size. Here links are listed and never followed, data sets are
opened only where a hard link of the root group leads, attributes only by the names that the
format knows and up to a length. What is wrong is recorded, not raised; only a file that HDF5
cannot read at all raises.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from .header import OPTIONAL, REQUIRED
from .opening import reading

__all__ = ["MAX_COORDINATE", "MAX_LINKS", "Anatomy", "Array", "Odd", "dissect"]

MAX_LINKS = 1000
"""Most entries of the root group that are looked at."""

MAX_ATTRIBUTE = 1 << 16
"""Longest attribute that is read [bytes]."""

MAX_COORDINATE = 20_000
"""Most entries of a coordinate that are read; ids and frame numbers have four digits."""

MAX_COORDINATE_CHUNK = 1 << 26
"""Largest chunk of a coordinate that is read [bytes]."""

VARIABLES = ("position", "scenario", "frame", "diverged_at")
INTEGERS = ("scenario", "frame", "diverged_at")
FILTERS = {
    h5py.h5z.FILTER_DEFLATE: "zlib",
    h5py.h5z.FILTER_SHUFFLE: "shuffle",
    h5py.h5z.FILTER_FLETCHER32: "",
}
LAYOUTS = {
    h5py.h5d.COMPACT: "compact",
    h5py.h5d.CONTIGUOUS: "contiguous",
    h5py.h5d.CHUNKED: "chunked",
    h5py.h5d.VIRTUAL: "virtual",
}
PACKING = ("scale_factor", "add_offset")

_LINKS = {h5py.h5l.TYPE_SOFT: "soft link", h5py.h5l.TYPE_EXTERNAL: "external link"}
_OBJECTS = {h5py.h5o.TYPE_GROUP: "group", h5py.h5o.TYPE_DATASET: "variable"}


@dataclass(frozen=True)
class Odd:
    """An attribute that is there but cannot be used, and why."""

    reason: str


@dataclass(frozen=True, kw_only=True)
class Array:
    """A data set as its header describes it."""

    name: str
    shape: tuple[int, ...] | None  # lengths of its dimensions; None where asking could touch another file
    dims: tuple[str, ...]  # names of its dimensions, an empty name where one has none
    kind: str  # its type in words, such as "float32" or "compound"
    layout: str  # "contiguous", "chunked", "compact", "virtual" or "external files"
    chunks: tuple[int, ...] | None  # shape of a chunk; None where not chunked
    largest_chunk: int  # length of the longest chunk as it is packed in the file [bytes]
    foreign_filters: tuple[str, ...]  # filters beyond zlib, shuffle and checksum, by name
    packing: Mapping[str, object]  # scale_factor and add_offset, where it has them

    @property
    def self_contained(self) -> bool:
        """Whether its values lie in this file, packed in ways that HDF5 itself unpacks."""
        return self.shape is not None and not self.foreign_filters

    @property
    def chunk_count(self) -> int:
        """Chunks that the shape divides into; 1 where not chunked."""
        if self.chunks is None or self.shape is None:
            return 1
        return math.prod(-(-n // c) for n, c in zip(self.shape, self.chunks, strict=True))


@dataclass(frozen=True, kw_only=True)
class Anatomy:
    """A file as its headers describe it."""

    links: Mapping[str, str]  # entry of the root group to what it is: "variable", "group", "soft link", ...
    link_count: int  # how many entries there are; 'links' holds the first of them
    attributes: Mapping[str, object]  # attribute of the format to its value, None where it is missing
    arrays: Mapping[str, Array]  # variable of the format to its description, where a hard link leads to one
    integers: Mapping[str, tuple[int, ...]]  # coordinate to its values, where they could be read


def dissect(file: h5py.File, path: Path) -> Anatomy:
    """Return what a file holds; values are read of coordinates only."""
    with reading(path):
        root = h5py.h5g.open(file.id, b"/")
        count = root.get_num_objs()
        links = dict(_links(root, min(count, MAX_LINKS)))
        names = ("lagbench_format", *REQUIRED, *OPTIONAL)
        attributes = {name: _attribute(file["/"], name) for name in names}
    arrays, integers = {}, {}
    for name in VARIABLES:
        if links.get(name) == "variable":
            with reading(path, name):
                dataset = file[name]
                arrays[name] = _array(dataset, name)
                if name in INTEGERS and _is_coordinate(arrays[name]):
                    integers[name] = tuple(int(i) for i in dataset[...])
    return Anatomy(links=links, link_count=count, attributes=attributes, arrays=arrays, integers=integers)


def _links(root: h5py.h5g.GroupID, count: int) -> Iterator[tuple[str, str]]:
    for index in range(count):
        name = root.get_objname_by_idx(index)
        kind = root.links.get_info(name).type
        if kind == h5py.h5l.TYPE_HARD:
            word = _OBJECTS.get(h5py.h5o.get_info(root, name).type, "named type")
        else:
            word = _LINKS.get(kind, "user-defined link")
        yield name.decode("utf-8", "backslashreplace"), word


def _attribute(owner: h5py.HLObject, name: str) -> object:
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
    return value if isinstance(value, (str, int, float)) else Odd("neither a text nor a number")


def _array(dataset: h5py.Dataset, name: str) -> Array:
    plist = dataset.id.get_create_plist()
    layout = LAYOUTS.get(plist.get_layout(), "unknown")
    if plist.get_external_count():
        layout = "external files"
    # HDF5 opens the sources of a virtual data set to tell its shape.
    elsewhere = layout not in ("compact", "contiguous", "chunked")
    filters = [plist.get_filter(i) for i in range(plist.get_nfilters())]
    return Array(
        name=name,
        shape=None
        if elsewhere or dataset.id.get_space().get_simple_extent_type() != h5py.h5s.SIMPLE
        else tuple(dataset.id.shape),
        dims=() if elsewhere else _dims(dataset),
        kind=_kind(dataset.id.get_type()),
        layout=layout,
        chunks=tuple(plist.get_chunk()) if layout == "chunked" else None,
        largest_chunk=_largest_chunk(dataset) if layout == "chunked" else 0,
        foreign_filters=tuple(
            f"{text.decode('ascii', 'replace')} ({code})"
            for code, _, _, text in filters
            if code not in FILTERS
        ),
        packing={n: value for n in PACKING if (value := _attribute(dataset, n)) is not None},
    )


def _largest_chunk(dataset: h5py.Dataset) -> int:
    sizes: list[int] = []
    dataset.id.chunk_iter(lambda chunk: sizes.append(chunk.size))
    return max(sizes, default=0)


def _dims(dataset: h5py.Dataset) -> tuple[str, ...]:
    """Return the names of the dimension scales that netCDF attaches, one per dimension."""
    rank: int = dataset.id.rank
    if not h5py.h5a.exists(dataset.id, b"DIMENSION_LIST"):
        return ("",) * rank
    attribute = h5py.h5a.open(dataset.id, b"DIMENSION_LIST")
    kind = attribute.get_type()
    is_list = kind.get_class() == h5py.h5t.VLEN and kind.get_super().get_class() == h5py.h5t.REFERENCE
    if not is_list or attribute.shape != (rank,):
        return ("",) * rank
    scales = dataset.attrs["DIMENSION_LIST"]
    return tuple(_name_of(scale[0], dataset) if len(scale) else "" for scale in scales)


def _name_of(reference: h5py.Reference, dataset: h5py.Dataset) -> str:
    name = h5py.h5r.get_name(reference, dataset.id)
    return (name or b"").decode("utf-8", "backslashreplace").rsplit("/", 1)[-1]


def _kind(kind: h5py.h5t.TypeID) -> str:
    """Return a type in words; byte order is left out, since HDF5 undoes it."""
    if kind.get_class() == h5py.h5t.FLOAT:
        if kind in (h5py.h5t.IEEE_F32LE, h5py.h5t.IEEE_F32BE):
            return "float32"
        return f"float{8 * kind.get_size()}" if kind.get_size() != 4 else "a float of 4 bytes, not IEEE"
    if kind.get_class() == h5py.h5t.INTEGER:
        sign = "" if kind.get_sign() == h5py.h5t.SGN_2 else "u"
        return f"{sign}int{8 * kind.get_size()}"
    return _CLASSES.get(kind.get_class(), "another type")


_CLASSES = {
    h5py.h5t.STRING: "string",
    h5py.h5t.COMPOUND: "compound",
    h5py.h5t.VLEN: "variable-length",
    h5py.h5t.REFERENCE: "object reference",
    h5py.h5t.ENUM: "enum",
    h5py.h5t.OPAQUE: "opaque",
    h5py.h5t.ARRAY: "array",
    h5py.h5t.BITFIELD: "bit field",
}


def _is_coordinate(array: Array) -> bool:
    """Tell whether a variable's values may be read as a short list of integers."""
    if not array.self_contained or array.shape is None or len(array.shape) != 1:
        return False
    small = array.chunks is None or 8 * math.prod(array.chunks) <= MAX_COORDINATE_CHUNK
    return small and array.shape[0] <= MAX_COORDINATE and array.kind.lstrip("u").startswith("int")
