"""Open HDF5 and netCDF files; read members and attributes as netCDF shows them.

h5py opens a file in half the time that netCDF4 takes. Links are listed and never
followed: nothing outside the file is opened. Sizes that headers claim are compared with
what the file holds before values are read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import h5py
import numpy as np

from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    check_regular,
)

if TYPE_CHECKING:
    import netCDF4

HIDDEN_ATTRIBUTES = frozenset(
    (
        "CLASS",
        "NAME",
        "REFERENCE_LIST",
        "DIMENSION_LIST",
        "_Netcdf4Dimid",
        "_Netcdf4Coordinates",
        "_NCProperties",
        "_nc3_strict",
    )
)
"""Attributes by which netCDF stores dimensions; it shows them to nobody."""

MAX_LINKS = 1000
"""Most entries of a group that are inspected."""

SIGNATURE = b"\x89HDF\r\n\x1a\n"

INSIDE = (h5py.h5d.COMPACT, h5py.h5d.CONTIGUOUS, h5py.h5d.CHUNKED)
"""Layouts of arrays whose values lie in the file itself."""

OBJECTS = {h5py.h5o.TYPE_GROUP: "group", h5py.h5o.TYPE_DATASET: "variable"}

FILTERS = (h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32)
"""Filters that every reader has."""

HARMLESS_BYTES = 1 << 28
"""Any array or chunk may unpack to this many bytes."""

MAX_ARRAY_RATIO = 200
"""Most unpacked bytes per packed byte of a larger array. Particles at rest reach 100.
"""

NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
"""Start of the name of a dimension that has no variable of its own."""

WRITE_AGAIN = "write the file again; if it was copied or downloaded, compare its length"


# --- opening --------------------------------------------------------------------------


def check_file(
    path: Path, *, longest: int | None = None, fix: str = WRITE_AGAIN
) -> None:
    """Refuse a file that is not HDF5 by its kind, length and first bytes.

    Raises:
        UnreadableFileError: no regular file, too long, or another signature.
    """
    check_regular(path, longest=longest, fix=fix)
    try:
        with path.open("rb") as stream:
            first_bytes = stream.read(len(SIGNATURE))
    except OSError as error:
        raise UnreadableFileError(
            f"cannot open the file: {error.strerror or error}; check the path and "
            "that you may read the file",
            where=str(path),
        ) from error
    if first_bytes != SIGNATURE:
        kind = "it begins with other bytes"
        if first_bytes.startswith(b"CDF"):
            kind = "it is netCDF-3, the old format"
        raise UnreadableFileError(
            f"not an HDF5 or netCDF-4 file: {kind}; {fix}", where=str(path)
        )


@contextmanager
def hdf5_errors(path: Path, variable: str | None = None) -> Iterator[None]:
    """Turn whatever HDF5 raises on damaged bytes into an UnreadableFileError."""
    try:
        yield
    except LagbenchError:
        raise
    except Exception as error:  # damage surfaces as nearly any type
        where = str(path)
        if variable is not None:
            where = f"{path}, variable {variable!r}"
        message = " ".join(str(error).split())[:300]
        raise UnreadableFileError(
            f"HDF5 cannot read the file: {type(error).__name__}: {message}; "
            f"{WRITE_AGAIN}",
            where=where,
        ) from error


@contextmanager
def open_hdf5(
    path: Path, *, longest: int | None = None, fix: str = WRITE_AGAIN
) -> Iterator[h5py.File]:
    """Open a regular HDF5 file of bounded length for reading, without a lock."""
    check_file(path, longest=longest, fix=fix)
    with hdf5_errors(path):
        file = h5py.File(path, "r", locking=False)
    with file:
        yield file


# --- members and storage --------------------------------------------------------------


def open_netcdf(path: Path, mode: Literal["r", "w"] = "r") -> netCDF4.Dataset:
    """Open a netCDF4 file, to read it or to write it anew.

    Every use of the library goes through here, because it takes a tenth of a second to
    load: help and plans of work do without it.

    Raises:
        UsageError: the path is no UTF-8, which the library needs.
    """
    import netCDF4

    try:
        return netCDF4.Dataset(path, mode, format="NETCDF4")
    except UnicodeEncodeError as error:
        raise UsageError(
            "no netCDF file can have that name: bytes that are no UTF-8; use another "
            "name",
            where=str(path),
        ) from error


def list_members(
    group: h5py.Group, most: int = MAX_LINKS
) -> tuple[dict[str, str], int]:
    """Return the first members of a group with their kinds, and the number of all.

    A member is a "variable", "group", "link" that is not followed, or "named type".
    """
    count: int = group.id.get_num_objs()
    members = {}
    for index in range(min(count, most)):
        name = group.id.get_objname_by_idx(index)
        kind = "link"
        if group.id.links.get_info(name).type == h5py.h5l.TYPE_HARD:
            object_type = h5py.h5o.get_info(group.id, name).type
            kind = OBJECTS.get(object_type, "named type")
        members[name.decode("utf-8", "backslashreplace")] = kind
    return members, count


def open_variable(group: h5py.Group, name: str) -> h5py.Dataset:
    """Return a variable of a file that is open for reading.

    ``group[name]`` would ask for the mode of the file each time, which takes longer
    than to open the variable.
    """
    return h5py.Dataset(h5py.h5d.open(group.id, name.encode()), readonly=True)


def find_storage_issue(variable: h5py.Dataset) -> str | None:
    """Return why an array must not be read; None where it is sound.

    Its values lie in other files, or would be far more than its bytes can hold.
    """
    properties = variable.id.get_create_plist()
    if properties.get_external_count() or properties.get_layout() not in INSIDE:
        return "the values lie in other files"
    item = 1 if is_text_of_any_length(variable) else variable.dtype.itemsize
    if properties.get_layout() == h5py.h5d.CHUNKED:
        chunk = item * math.prod(properties.get_chunk())
        if chunk > HARMLESS_BYTES:
            return f"a chunk has {chunk} bytes"
    filters = [properties.get_filter(i)[0] for i in range(properties.get_nfilters())]
    # Each zlib multiplies what a chunk may unpack to by a thousand.
    if len(set(filters)) < len(filters) or not set(filters) <= set(FILTERS):
        return "it needs other filters than zlib, shuffle and checksum, each once"
    unpacked = item * math.prod(variable.shape or (0,))
    packed = variable.id.get_storage_size()
    if unpacked > max(HARMLESS_BYTES, MAX_ARRAY_RATIO * packed):
        return f"{unpacked} bytes are claimed, and the file has {packed} of them"
    return None


def read_dimensions(dataset: h5py.Dataset) -> tuple[str, ...]:
    """Return the names of netCDF's dimension scales, one per dimension.

    A dimension has an empty name without a scale, and with one that is not there.
    """
    rank: int = dataset.id.rank
    unnamed = ("",) * rank
    if not h5py.h5a.exists(dataset.id, b"DIMENSION_LIST"):
        return unnamed
    attribute = h5py.h5a.open(dataset.id, b"DIMENSION_LIST")
    list_type = attribute.get_type()
    is_list_of_references = (
        list_type.get_class() == h5py.h5t.VLEN
        and list_type.get_super().get_class() == h5py.h5t.REFERENCE
    )
    if not is_list_of_references or attribute.shape != (rank,):
        return unnamed

    names = []
    for scales in dataset.attrs["DIMENSION_LIST"]:
        path = b""
        if len(scales):
            path = h5py.h5r.get_name(scales[0], dataset.id) or b""
        names.append(path.decode("utf-8", "backslashreplace").rsplit("/", 1)[-1])
    return tuple(names)


# --- what netCDF shows ----------------------------------------------------------------


def list_variables(group: h5py.Group) -> dict[str, h5py.Dataset]:
    """Return the variables of a group by name; links and groups in it are no variables.

    Raises:
        DataError: a link, values in other files, arrays far larger than their bytes, or
            too many members.
    """
    members, count = list_members(group)
    if count > len(members):
        raise DataError(f"{count} members, of which {len(members)} are inspected")
    variables = {}
    for name, kind in members.items():
        if kind == "link":
            raise DataError(f"{name!r} is a link, which is not followed")
        if kind != "variable":
            continue
        variable = open_variable(group, name)
        issue = find_storage_issue(variable)
        if issue is not None:
            raise DataError(f"{name!r}: {issue}")
        if not _is_bare_dimension(variable):
            variables[name] = variable
    return variables


def _is_bare_dimension(variable: h5py.Dataset) -> bool:
    """Tell whether a data set only stands for a dimension."""
    if not _is_dimension_scale(variable):
        return False
    return str(read_attribute(variable, "NAME")).startswith(NO_VARIABLE)


def _is_dimension_scale(variable: h5py.Dataset) -> bool:
    return read_attribute(variable, "CLASS") == "DIMENSION_SCALE"


def list_dimensions(variable: h5py.Dataset, name: str) -> tuple[str, ...]:
    """Return the names of a variable's dimensions.

    A variable that is a dimension itself has its own name.
    """
    if not _is_dimension_scale(variable):
        return read_dimensions(variable)
    rank: int = variable.ndim
    if rank == 1:
        return (name,)
    return ("",) * rank


def is_text(variable: h5py.Dataset) -> bool:
    """Tell whether the values are texts; single characters are not."""
    text_type = h5py.check_string_dtype(variable.dtype)
    return text_type is not None and text_type.length != 1


def is_text_of_any_length(variable: h5py.Dataset) -> bool:
    """Tell whether the values are texts that state their lengths themselves."""
    text_type = h5py.check_string_dtype(variable.dtype)
    return text_type is not None and text_type.length is None


def read_attributes(owner: h5py.HLObject) -> dict[str, object]:
    """Return all attributes by name, without those that netCDF hides."""
    attributes = {}
    for name in owner.attrs:
        if name not in HIDDEN_ATTRIBUTES:
            attributes[name] = read_attribute(owner, name)
    return attributes


def read_attribute(owner: h5py.HLObject, name: str) -> object:
    """Return a text or a number, an array where there are several values.

    None where there is no such attribute.
    """
    if not h5py.h5a.exists(owner.id, name.encode()):
        return None
    # The attribute `attrs` of a file opens the root group anew for each attribute.
    value = h5py.AttributeManager(owner)[name]
    if isinstance(value, h5py.Empty):
        if value.dtype.kind in "SO":
            return ""
        return np.empty(0, value.dtype)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    # Damaged bytes of texts of no set length come as lone surrogates.
    if isinstance(value, str):
        value = value.encode("utf-8", "surrogateescape")
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace").replace("\0", "")
    return value


def to_plain(value: object) -> object:
    """Return a JSON value equal to an attribute, whatever library read it.

    Booleans become 0 and 1, because netCDF has none; NumPy scalars and arrays of one
    element become Python numbers; -0.0 becomes 0.0.
    """
    if isinstance(value, (np.ndarray, np.generic)):
        if value.size == 1:
            value = value.item()
        else:
            value = value.tolist()
    if isinstance(value, bytes):
        value = value.decode("utf-8")
    if isinstance(value, int):
        return int(value)
    if isinstance(value, float) and math.isfinite(value):
        return value + 0.0
    if isinstance(value, str) and "\0" not in value:
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain(item) for item in value]
    raise DataError(
        f"a value cannot be hashed: {value!r}, expected a finite number, a string "
        "without NUL, or lists and mappings of them"
    )
