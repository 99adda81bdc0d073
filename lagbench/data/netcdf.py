"""What netCDF sees in an HDF5 file: variables, their dimensions, and attributes.

h5py opens a scenario in half the time that netCDF4 takes, and follows a link only where it is
asked to: here nothing that leads out of the file is opened.
"""

from __future__ import annotations

import h5py
import numpy as np

from lagbench.errors import DataError

from .hdf5 import INSIDE, dims_of, layout_of, members_of

HIDDEN = frozenset(
    (
        *("CLASS", "NAME", "REFERENCE_LIST", "DIMENSION_LIST"),
        *("_Netcdf4Dimid", "_Netcdf4Coordinates", "_NCProperties", "_nc3_strict"),
    )
)
"""Attributes by which netCDF stores dimensions; it shows them to nobody."""

NO_VARIABLE = "This is a netCDF dimension but not a netCDF variable"


def variables(file: h5py.File) -> dict[str, h5py.Dataset]:
    """Return the variables beside each other in a file; refuse links and what lies in other files."""
    members, count = members_of(file)
    if count > len(members):
        raise DataError(f"{count} members, of which {len(members)} are looked at")
    found = {}
    for name, kind in members.items():
        if kind.endswith("link"):
            raise DataError(f"{name!r} is a {kind}")
        if kind != "variable":
            continue
        variable = file[name]
        layout = layout_of(variable)
        if layout not in INSIDE:
            raise DataError(f"the values of {name!r} lie elsewhere: {layout}")
        scale = attribute(variable, "CLASS") == "DIMENSION_SCALE"
        if not (scale and str(attribute(variable, "NAME")).startswith(NO_VARIABLE)):
            found[name] = variable
    return found


def dimensions(variable: h5py.Dataset, name: str) -> tuple[str, ...]:
    """Return the names of a variable's dimensions; one that is a dimension itself has its own."""
    if attribute(variable, "CLASS") == "DIMENSION_SCALE":
        return (name,) if variable.ndim == 1 else ("",) * variable.ndim
    return dims_of(variable)


def is_text(variable: h5py.Dataset) -> bool:
    """Tell whether the values are texts, which single characters are not."""
    kind = h5py.check_string_dtype(variable.dtype)
    return kind is not None and kind.length != 1


def attributes(owner: h5py.HLObject) -> dict[str, object]:
    """Return all attributes by name."""
    return {name: attribute(owner, name) for name in owner.attrs if name not in HIDDEN}


def attribute(owner: h5py.HLObject, name: str) -> object:
    """Return a text or number, an array where there are several; None where there is none."""
    if not h5py.h5a.exists(owner.id, name.encode()):
        return None
    value = owner.attrs[name]
    if isinstance(value, h5py.Empty):
        return "" if value.dtype.kind in "SO" else np.empty(0, value.dtype)
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, str):  # damaged bytes of texts of no set length come as lone surrogates
        value = value.encode("utf-8", "surrogateescape")
    return value.decode("utf-8", "replace").replace("\0", "") if isinstance(value, bytes) else value
