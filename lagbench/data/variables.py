"""The variables of a scenario file, and the attributes that they must have.

Attributes do not enter the content hash, yet readers compute with them: a
``scale_factor`` or other ``units`` change what xarray returns although no stored value
changed. So a variable has exactly the attributes of :data:`ATTRIBUTES`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from lagbench.errors import UsageError

from . import MATERIALS

if TYPE_CHECKING:
    import netCDF4

ATTRIBUTES: Mapping[str, Mapping[str, object]] = {
    "frame": {
        "long_name": "frame number; 0 is the state when recording starts",
        "units": "1",
    },
    "time": {"long_name": "time since frame 0", "units": "s"},
    "particle": {"long_name": "particle number", "units": "1"},
    "space": {"long_name": "axis of the unit box"},
    "wall": {"long_name": "wall of the box"},
    "position": {
        "long_name": "particle position in lengths of the unit box",
        "units": "1",
    },
    "velocity": {
        "long_name": "particle velocity of the solver in box lengths per second",
        "units": "s-1",
    },
    "material": {
        "long_name": "constitutive model",
        "flag_values": np.arange(len(MATERIALS), dtype=np.int8),
        "flag_meanings": " ".join(MATERIALS),
    },
    "particle_mass": {
        "long_name": "mass of one particle, density times area over particles",
        "units": "1",
    },
    "body_force": {
        "long_name": "acceleration of the fluid towards each frame; layers of equal "
        "height along y, lowest first",
        "units": "s-2",
    },
    "wall_velocity": {
        "long_name": "velocity of each wall in box lengths per second",
        "units": "s-1",
    },
}
"""Attributes of each variable beside ``coordinates`` and ``content_sha256``."""

UNCHECKED_ATTRIBUTES = {"content_sha256", "long_name"}
"""Attributes that a reader does not compare.

The hash is checked elsewhere, and a patch release may reword a name.
"""

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

MAX_VALUES_PER_FRAME = 20_000_000
"""Values of a variable in one frame, which is read at once.

These are two for each of ten million particles, or three for each of 6.7 million.
"""


def open_netcdf(path: Path, mode: Literal["r", "w"] = "r") -> netCDF4.Dataset:
    """Open a netCDF4 file, to read it or to write it anew.

    Every use of the library goes through here, because it takes a tenth of a second to
    load: help and plans of work do without it. It stands here because a process that
    only writes does without h5py.

    Raises:
        UsageError: the path is no UTF-8, which the library needs.
    """
    import netCDF4

    try:
        return netCDF4.Dataset(path, mode, format="NETCDF4")
    except UnicodeEncodeError as error:
        raise UsageError(
            "no netCDF file can have that name",
            where=str(path),
            expected="a path in UTF-8",
            got="bytes that are no UTF-8",
            fix="use another name",
        ) from error


def expected_attributes(name: str, dims: Sequence[str]) -> dict[str, object]:
    """Return the attributes that a variable is written with."""
    attributes = dict(ATTRIBUTES[name])
    # xarray makes a coordinate only of what the CF attribute `coordinates` names.
    if "frame" in dims and len(dims) > 1:
        attributes["coordinates"] = "time"
    return attributes


def list_differing_attributes(
    expected: Mapping[str, object], attributes: Mapping[str, object]
) -> list[str]:
    """Return the names of attributes that differ, sorted."""
    names = (expected.keys() | attributes.keys()) - UNCHECKED_ATTRIBUTES
    differing = []
    for name in sorted(names):
        if not _is_equal(expected.get(name), attributes.get(name)):
            differing.append(name)
    return differing


def _is_equal(expected: object, value: object) -> bool:
    if not isinstance(expected, np.ndarray):
        return isinstance(value, str) and expected == value
    return (
        isinstance(value, np.ndarray)
        and expected.dtype == value.dtype
        and np.array_equal(expected, value)
    )
