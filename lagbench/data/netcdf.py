"""What netCDF shows of an HDF5 file: variables, dimensions and attributes.

h5py opens a file in half the time that netCDF4 takes, and follows a link only where it
is asked to. Nothing that leads out of the file is opened.
"""

from __future__ import annotations

import h5py
import numpy as np

from lagbench.errors import DataError

from .hdf5 import INSIDE, list_members, read_dimensions, read_layout

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

NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"
"""Start of the name of a dimension that has no variable of its own."""


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
        variable = file[name]
        layout = read_layout(variable)
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
    value = owner.attrs[name]
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
