"""Particles of a full box that a velocity field carries, the field known at scattered points.

Between the points the field is linear on their Delaunay triangles. Beyond a wall stand mirror
images of the points near it, so that the field meets the wall's condition half-way: where
walls hold the fluid, the image of u is ``2 u_wall - u``; where they let it slide, its normal
component is reversed.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .floor import Floats, Given

Field = Callable[[Floats], Floats]
"""From points [length], shape [point, 2], to velocities there [length/frame]."""

DEPTH = 4.0
"""Depth of the layer that is mirrored, in spacings of the points."""


def linear_field(points: Floats, values: Floats) -> Field:
    """Return the field that is linear between points, and beyond them that of the nearest one."""
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import KDTree

    linear = LinearNDInterpolator(points, values)

    def field(at: Floats) -> Floats:
        found = np.asarray(linear(at), np.float64)
        beyond = np.isnan(found[:, 0])
        if beyond.any():
            found[beyond] = values[KDTree(points).query(at[beyond])[1]]
        return found

    return field


def mirrored(given: Given, points: Floats, values: Floats, walls: Floats) -> tuple[Floats, Floats]:
    """Return points and velocities there, each [point, 2], with those that the walls reflect.

    ``walls`` are their velocities, left, right, bottom, top [length/frame], shape [4, 2].
    """
    (left, right), (bottom, top) = given.size.bounds
    depth = DEPTH * np.sqrt((right - left) * (top - bottom) / len(points))
    places, speeds = [points], [values]
    for wall, (axis, where) in enumerate([(0, left), (0, right), (1, bottom), (1, top)]):
        near = np.abs(points[:, axis] - where) < depth
        image, speed = points[near].copy(), values[near].copy()
        image[:, axis] = 2.0 * where - image[:, axis]
        if given.driven:
            speed = 2.0 * walls[wall] - speed
        else:
            speed[:, axis] *= -1.0
        places.append(image)
        speeds.append(speed)
    return np.concatenate(places), np.concatenate(speeds)
