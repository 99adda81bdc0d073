"""Kinds of particles: our materials as the numbers that other code bases give them, and back.

Both formats mark each particle with a number below 9, which their models embed; only a few have
a meaning to the programs: particles that move as prescribed, and padding. Our materials go to
numbers without such a meaning, one each, so that nothing is lost. On the way back a number that
no material has must be told what it stands for, or left out.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lagbench.data.scenario import MATERIALS
from lagbench.errors import UnreadableFileError, UsageError, nearest

__all__ = ["DROP", "MEANINGS", "NUMBERS", "Format", "materials_of", "numbers_of", "parse_kinds"]


class Format(enum.StrEnum):
    """A format that other code bases read."""

    GNS_NPZ = "gns-npz"
    LAGRANGEBENCH_H5 = "lagrangebench-h5"


NUMBERS: Mapping[Format, Mapping[str, int]] = {
    Format.GNS_NPZ: {"liquid": 5, "snow": 6, "jelly": 7, "rope": 8},
    Format.LAGRANGEBENCH_H5: {"liquid": 0, "jelly": 4, "snow": 5, "rope": 6},
}
"""Number of each material."""

MEANINGS: Mapping[Format, Mapping[int, str]] = {
    Format.GNS_NPZ: {0: "rigid", 3: "kinematic: a boundary that moves as prescribed"},
    Format.LAGRANGEBENCH_H5: {1: "solid wall", 2: "moving wall", 3: "rigid body"},
}
"""What numbers without a material mean."""

PADDING = -1
"""Number of particles that are not there (lagrangebench-h5)."""

DROP = "drop"
"""What a number is mapped to whose particles are left out."""

_DROPPED = -1


def numbers_of(form: Format, material: NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the number of each particle's material, shape [particle]."""
    table = np.array([NUMBERS[form][name] for name in MATERIALS], dtype=np.int64)
    numbers: NDArray[np.int64] = table[material]
    return numbers


def materials_of(
    form: Format, numbers: NDArray[np.integer], *, given: Mapping[int, str], where: str
) -> tuple[NDArray[np.int8], NDArray[np.bool_]]:
    """Return the materials of the particles that are kept, and which are.

    Args:
        form: format that the numbers come from.
        numbers: number of each particle, shape [particle].
        given: what the user said of numbers: a material, or "drop".
        where: file and key, for messages.

    Returns:
        Material of each particle kept, and a mask over all particles.

    Raises:
        UsageError: what a number is mapped to is no material.
        UnreadableFileError: a number that no material has and the user did not map, or no
            particle is left.
    """
    known = {number: name for name, number in NUMBERS[form].items()} | {PADDING: DROP} | dict(given)
    codes = {number: _DROPPED if name == DROP else _code(name) for number, name in known.items()}
    found = np.unique(numbers).tolist()
    strange = [number for number in found if number not in codes]
    if strange:
        raise UnreadableFileError(
            "particles of a kind that no material is known for",
            where=where,
            expected=", ".join(f"{number} ({name})" for number, name in sorted(known.items())),
            got=", ".join(f"{n} ({MEANINGS[form].get(n, 'unknown')})" for n in strange),
            fix=f"say what they stand for: --kinds {strange[0]}=jelly, or leave them out: {strange[0]}=drop",
        )
    material = np.empty(numbers.shape, dtype=np.int8)
    for number in found:
        material[numbers == number] = codes[number]
    kept = material != _DROPPED
    if not kept.any():
        raise UnreadableFileError("every particle is padding or left out", where=where)
    return material[kept], kept


def _code(name: str) -> int:
    if name not in MATERIALS:
        fix = nearest(name, (*MATERIALS, DROP))
        raise UsageError(f"no material {name!r}", where="--kinds", fix=fix)
    return MATERIALS.index(name)


def parse_kinds(text: str | None) -> dict[int, str]:
    """Return what a user says about numbers of particles.

    Raises:
        UsageError: no list of number=material.

    >>> parse_kinds("3=jelly,0=drop")
    {3: 'jelly', 0: 'drop'}
    """
    kinds: dict[int, str] = {}
    for part in text.split(",") if text else ():
        number, _, name = part.strip().partition("=")
        if not number.lstrip("-").isdecimal():
            raise UsageError("bad kinds", where="--kinds", expected="as in 3=jelly,0=drop", got=text)
        if name != DROP:
            _code(name)
        kinds[int(number)] = name
    return kinds
