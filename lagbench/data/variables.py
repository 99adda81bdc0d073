"""The variables of a scenario file and their attributes; its parameters.

Attributes of variables do not enter the content hash, yet readers compute with them: a
``scale_factor`` or other ``units`` change what xarray returns although no stored value
changed. So ``verify`` refuses such attributes where they are not those of
:data:`ATTRIBUTES`.

Parameters of a scenario are attributes of the file. They do enter the hash.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import DataError

from . import MATERIALS, PARTICLE_KINDS

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

RESERVED = {
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


def require_known_material(material: NDArray[Any], *, where: str, fix: str) -> None:
    """Refuse numbers that stand for no material.

    Args:
        material: numbers of materials.
        where: the file or scenario that has them, for the message.
        fix: what to do about a wrong number.

    Raises:
        DataError: there is such a number.
    """
    is_known = np.isin(material, range(len(PARTICLE_KINDS)))
    if not is_known.all():
        raise DataError(
            f"a particle has an unknown material: got {material[~is_known][0]}, "
            f"expected whole numbers from 0 to {len(PARTICLE_KINDS) - 1}; {fix}",
            where=f"{where}, variable 'material'",
        )
