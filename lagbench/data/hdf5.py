"""Open HDF5 and netCDF files; read members and attributes as netCDF shows them.

h5py opens a file in half the time that netCDF4 takes. Links are listed and never
followed: nothing outside the file is opened. Files of strangers are checked in
:mod:`.structure` before their values are read.
"""

from __future__ import annotations

import codecs
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

FIRST_BYTES = 64
"""Bytes by which the format of a file is told."""

OTHER_FORMATS: Mapping[bytes, str] = {
    b"CDF\x01": "netCDF-3, the old format",
    b"CDF\x02": "netCDF-3, the old format",
    b"CDF\x05": "netCDF-3, the old format",
    b"PK\x03\x04": "a zip archive, perhaps .npz",
    b"\x93NUMPY": "a NumPy .npy file",
    b"\x1f\x8b": "a gzip archive",
    b"\x80": "perhaps a Python pickle",
}

LAYOUTS = {
    h5py.h5d.COMPACT: "compact",
    h5py.h5d.CONTIGUOUS: "contiguous",
    h5py.h5d.CHUNKED: "chunked",
    h5py.h5d.VIRTUAL: "virtual",
}

INSIDE = ("compact", "contiguous", "chunked")
"""Layouts of arrays whose values lie in the file itself."""

LINKS = {h5py.h5l.TYPE_SOFT: "soft link", h5py.h5l.TYPE_EXTERNAL: "external link"}

OBJECTS = {h5py.h5o.TYPE_GROUP: "group", h5py.h5o.TYPE_DATASET: "variable"}

NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
"""Start of the name of a dimension that has no variable of its own."""

DEFLATE_RATIO = 1032
"""No zlib stream unpacks to more than this many times its length."""

WRITE_AGAIN = "write the file again; if it was copied or downloaded, compare its length"


# --- opening --------------------------------------------------------------------------


def read_beginning(path: Path, most: int) -> bytes:
    """Return the first bytes of a file, at most so many.

    Raises:
        UnreadableFileError: the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return stream.read(most)
    except OSError as error:
        raise UnreadableFileError(
            f"cannot open the file: {error.strerror or error}; check the path and "
            "that you may read the file",
            where=str(path),
        ) from error


def check_file(
    path: Path, *, longest: int | None = None, fix: str = WRITE_AGAIN
) -> None:
    """Refuse a file that is not HDF5 by its kind, length and first bytes.

    Raises:
        UnreadableFileError: no regular file, too long, or another signature.
    """
    check_regular(path, longest=longest, fix=fix)
    first_bytes = read_beginning(path, FIRST_BYTES)
    if not first_bytes.startswith(SIGNATURE):
        raise UnreadableFileError(
            f"not an HDF5 file: {guess_format(first_bytes)}; {fix}", where=str(path)
        )


def guess_format(first_bytes: bytes) -> str:
    """Return in plain words what a file is.

    Args:
        first_bytes: its first :data:`FIRST_BYTES` bytes, or all of a shorter file.
    """
    if first_bytes.startswith(SIGNATURE):
        return "an HDF5 file"
    for signature, format_name in OTHER_FORMATS.items():
        if first_bytes.startswith(signature):
            return format_name
    if not first_bytes:
        return "an empty file"
    # an incremental decoder accepts a character that the end of the bytes cuts
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        words = decoder.decode(first_bytes).split()
    except UnicodeDecodeError:
        return "bytes of another format"
    if "".join(words).isprintable():
        return "a text file"
    return "bytes of another format"


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

    A member is a "variable", "group", "named type", "soft link", "external link" or
    "user-defined link".
    """
    count: int = group.id.get_num_objs()
    members = {}
    for index in range(min(count, most)):
        name = group.id.get_objname_by_idx(index)
        link_type = group.id.links.get_info(name).type
        if link_type == h5py.h5l.TYPE_HARD:
            object_type = h5py.h5o.get_info(group.id, name).type
            kind = OBJECTS.get(object_type, "named type")
        else:
            kind = LINKS.get(link_type, "user-defined link")
        members[name.decode("utf-8", "backslashreplace")] = kind
    return members, count


def open_variable(group: h5py.Group, name: str) -> h5py.Dataset:
    """Return a variable of a file that is open for reading.

    ``group[name]`` would ask for the mode of the file each time, which takes longer
    than to open the variable.
    """
    return h5py.Dataset(h5py.h5d.open(group.id, name.encode()), readonly=True)


def read_layout(creation_properties: h5py.h5p.PropDCID) -> str:
    """Return how the values of a data set are stored.

    One of :data:`INSIDE`, "virtual", "external files" or "unknown".
    """
    if creation_properties.get_external_count():
        return "external files"
    return LAYOUTS.get(creation_properties.get_layout(), "unknown")


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


def list_variables(file: h5py.File) -> dict[str, h5py.Dataset]:
    """Return the variables of the root group by name.

    Raises:
        DataError: a link, values in other files, or too many members.
    """
    members, count = list_members(file)
    if count > len(members):
        raise DataError(f"{count} members, of which {len(members)} are inspected")
    variables = {}
    for name, kind in members.items():
        if kind.endswith("link"):
            raise DataError(f"{name!r} is a {kind}")
        if kind != "variable":
            continue
        variable = open_variable(file, name)
        layout = read_layout(variable.id.get_create_plist())
        if layout not in INSIDE:
            raise DataError(f"the values of {name!r} lie elsewhere: {layout}")
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
