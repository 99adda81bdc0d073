"""The fixed round obstacle that a scenario file may state: where it is, how large.

Files state it by the attributes ``obstacle_x``, ``obstacle_y``, in three dimensions
``obstacle_z``, and ``obstacle_diameter`` [length]. No particle enters it.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import DataError

from .box import AXES

__all__ = ["keep_outside", "parse_obstacle"]

LARGEST = float(np.finfo(np.float32).max)


def parse_obstacle(
    attributes: Mapping[str, object], dimension: int, *, where: str
) -> NDArray[np.float32] | None:
    """Return centre and radius of the obstacle that attributes state; None without one.

    >>> stated = {"obstacle_x": 0.25, "obstacle_y": 0.5, "obstacle_diameter": 0.125}
    >>> parse_obstacle(stated, 2, where="a file")
    array([0.25  , 0.5   , 0.0625], dtype=float32)

    Args:
        attributes: parameters of a scenario by name.
        dimension: number of axes of the box.
        where: the file.

    Returns:
        [length], shape [axis + 1], the radius last.

    Raises:
        DataError: the attributes are no finite numbers, or the diameter is not above 0.
    """
    if "obstacle_diameter" not in attributes:
        return None
    names = [f"obstacle_{axis}" for axis in AXES[:dimension]]
    names.append("obstacle_diameter")
    values = []
    for name in names:
        stated = np.asarray(attributes.get(name))
        is_number = stated.size == 1 and stated.dtype.kind in "iuf"
        # float32 has no larger numbers; not a number is no less
        if not is_number or not (abs(stated) <= LARGEST).all():
            raise DataError(
                "the obstacle has no place or no size",
                where=f"{where}, attribute {name}",
                expected="a finite number [length]",
                got=attributes.get(name),
                fix="mend the attribute, or make the file again",
            )
        values.append(float(stated.item()))
    if values[-1] <= 0.0:
        raise DataError(
            "the obstacle has no size",
            where=f"{where}, attribute obstacle_diameter",
            expected="a number above 0 [length]",
            got=values[-1],
            fix="mend the attribute, or make the file again",
        )
    values[-1] *= 0.5
    return np.array(values, np.float32)


def keep_outside(
    position: NDArray[np.float64], obstacle: NDArray[np.floating]
) -> NDArray[np.float64]:
    """Return positions of which those inside an obstacle are put on its surface.

    A point at the very centre stays there. Points outside are computed anew too, so
    they may change by a rounding: the bits of recorded predictions depend on it.

    Args:
        position: points [length], shape [point, axis].
        obstacle: centre and radius [length], shape [axis + 1].
    """
    centre = obstacle[:-1].astype(np.float64)
    radius = float(obstacle[-1])
    offset = position - centre
    distance = np.sqrt((offset * offset).sum(axis=1))
    is_inside = (distance < radius) & (distance > 0.0)
    stretch = np.ones(len(position))
    stretch[is_inside] = radius / distance[is_inside]
    return np.asarray(centre + stretch[:, None] * offset)
