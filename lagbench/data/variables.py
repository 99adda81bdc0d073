"""The variables of a scenario file and their attributes; its parameters.

Attributes of variables do not enter the content hash, yet readers compute with them: a
``scale_factor`` or other ``units`` change what xarray returns although no stored value
changed. So a variable has exactly the attributes of :data:`ATTRIBUTES`.

Parameters of a scenario are attributes of the file. They do enter the hash.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lagbench.errors import DataError

from . import MATERIALS, PARTICLE_KINDS
from .hdf5 import HIDDEN_ATTRIBUTES, to_plain

if TYPE_CHECKING:
    pass

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

_RESERVED = {
    "Conventions",
    "title",
    "source",
    "license",
    "lagbench_format",
    "lagbench_version",
    "split",
    "size",
    "version",
    "scenario",
    "subset",
    "seed",
    "generator",
    "device",
    "hashed_parameters",
    "content_sha256",
    "facts",
    "periodic",
}
"""Attributes of the file that no parameter may be named like."""

_KEPT_BY_NETCDF = HIDDEN_ATTRIBUTES | {
    "_ARRAY_DIMENSIONS",
    "_Codecs",
    "_Format",
    "_IsNetcdf4",
    "_SuperblockVersion",
    "_nczarr_array",
    "_nczarr_attr",
    "_nczarr_group",
    "_nczarr_superblock",
}
"""Attributes that netCDF and HDF5 keep for themselves."""

LONGEST_NAME = 256
"""Longest name of an attribute in netCDF [bytes]."""

POSSIBLE_NAME = (
    "letters, digits and _, as in disc_radius, and no name that files use; at most "
    f"{LONGEST_NAME} bytes, in the composed form (NFC)"
)
"""What the name of a parameter has to be."""

STORABLE_VALUE = (
    "a finite number, a whole one of 64 bits at most, or a text that is not empty and "
    "has no NUL and no lone surrogate"
)
"""What the value of a parameter has to be."""

_SURROGATES = re.compile("[\ud800-\udfff]")
"""Halves of characters, which no UTF-8 has."""

MAX_VALUES_PER_FRAME = 20_000_000
"""Values of a variable in one frame, which is read at once.

These are two for each of ten million particles, or three for each of 6.7 million.
"""


def expected_attributes(
    name: str, dims: Sequence[str], *, has_wall_particles: bool = False
) -> dict[str, object]:
    """Return the attributes that a variable is written with."""
    attributes = dict(ATTRIBUTES[name])
    if name == "material" and has_wall_particles:
        attributes["flag_values"] = np.arange(len(PARTICLE_KINDS), dtype=np.int8)
        attributes["flag_meanings"] = " ".join(PARTICLE_KINDS)
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


def find_name_fault(name: str) -> str | None:
    """Return why no parameter can have a name in a scenario file; None if one can."""
    if not name.isidentifier():
        return "no identifier"
    if name in _RESERVED:
        return "the name of an attribute that each file has"
    if name in _KEPT_BY_NETCDF:
        return "a name that netCDF keeps for itself"
    if not unicodedata.is_normalized("NFC", name):
        return "another form, which netCDF would change"
    length = len(name.encode("utf-8"))
    if length > LONGEST_NAME:
        return f"{length} bytes"
    return None


def as_attribute(value: object) -> int | float | str | None:
    """Return a value as an attribute holds it; None where netCDF cannot store it."""
    try:
        plain_value = to_plain(value)
    except (DataError, UnicodeDecodeError):
        return None
    if isinstance(plain_value, int):
        is_storable = -(2**63) <= plain_value < 2**64
        return plain_value if is_storable else None
    if isinstance(plain_value, str):
        is_storable = plain_value != "" and not _SURROGATES.search(plain_value)
        return plain_value if is_storable else None
    if isinstance(plain_value, float):
        return plain_value
    return None
