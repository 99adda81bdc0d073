"""The variables of a scenario file, and what their attributes must say.

Attributes do not enter the content hash, yet readers compute with them: ``scale_factor`` or
other ``units`` change what xarray returns although no stored value changed. So a variable has
exactly the attributes given here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

__all__ = ["ATTRIBUTES", "AXES", "MATERIALS", "WALLS", "attributes_of", "differing_attributes"]

MATERIALS = ("liquid", "jelly", "snow", "rope")
"""Meaning of the values 0, 1, 2, 3 of ``material``."""

WALLS = ("left", "right", "bottom", "top")
AXES = ("x", "y")

ATTRIBUTES: Mapping[str, Mapping[str, object]] = {
    "frame": {"long_name": "frame number; 0 is the state when recording starts", "units": "1"},
    "time": {"long_name": "time since frame 0", "units": "s"},
    "particle": {"long_name": "particle number", "units": "1"},
    "space": {"long_name": "axis of the unit box"},
    "wall": {"long_name": "wall of the box"},
    "position": {"long_name": "particle position in lengths of the unit box", "units": "1"},
    "velocity": {"long_name": "particle velocity of the solver in box lengths per second", "units": "s-1"},
    "material": {
        "long_name": "constitutive model",
        "flag_values": np.arange(len(MATERIALS), dtype=np.int8),
        "flag_meanings": " ".join(MATERIALS),
    },
    "particle_mass": {"long_name": "mass of one particle, density times area over particles", "units": "1"},
    "wall_velocity": {"long_name": "velocity of each wall in box lengths per second", "units": "s-1"},
}
"""Attributes of each variable beside ``coordinates`` and ``content_sha256``."""

_FREE = {"content_sha256", "long_name"}
"""Attributes that are checked elsewhere, and prose, which a patch release may word anew."""


def attributes_of(name: str, dims: Sequence[str]) -> dict[str, object]:
    """Return the attributes that a variable is written with.

    Args:
        name: one of :data:`ATTRIBUTES`.
        dims: its dimensions.
    """
    # xarray makes a coordinate only of what the CF attribute `coordinates` names.
    extra = {"coordinates": "time"} if "frame" in dims and len(dims) > 1 else {}
    return {**ATTRIBUTES[name], **extra}


def differing_attributes(name: str, dims: Sequence[str], found: Mapping[str, object]) -> list[str]:
    """Return the names of attributes that are missing, unknown or say something else.

    Args:
        name: name of the variable.
        dims: its dimensions.
        found: its attributes as read from a file.
    """
    wanted = attributes_of(name, dims) if name in ATTRIBUTES else {}
    names = (wanted.keys() | found.keys()) - _FREE
    return sorted(n for n in names if not _equal(wanted.get(n), found.get(n)))


def _equal(wanted: object, found: object) -> bool:
    if isinstance(wanted, np.ndarray):
        return isinstance(found, np.ndarray) and wanted.dtype == found.dtype and np.array_equal(wanted, found)
    return isinstance(found, str) and wanted == found
