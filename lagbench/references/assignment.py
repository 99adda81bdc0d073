"""Partners in another cloud: which of its particles each of ours follows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .predictor import Floats


def assign_particles(
    position: Floats,
    other_position: Floats,
    material: NDArray[np.integer],
    other_material: NDArray[np.integer],
) -> NDArray[np.intp]:
    """Return for each particle its partner in another cloud.

    Within each material the sum of squared distances is least, once the clouds are
    moved so that their means agree. Where the other cloud has fewer or more particles
    of a material, some are taken more than once, or not at all, evenly over their
    numbers. A material that it lacks is matched to all of its particles.

    Args:
        position: our positions [length], shape [particle, 2].
        other_position: positions of the other cloud [length], shape [other, 2].
        material: material of each of our particles, shape [particle].
        other_material: material of each particle of the other cloud, shape [other].

    Returns:
        Indices into the other cloud, shape [particle].
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist

    partner = np.empty(len(position), np.intp)
    for kind in np.unique(material):
        ours = np.flatnonzero(material == kind)
        pool = np.flatnonzero(other_material == kind)
        if not pool.size:
            pool = np.arange(len(other_position))
        chosen = pool[np.arange(len(ours)) * len(pool) // len(ours)]
        here = position[ours] - position[ours].mean(axis=0)
        there = other_position[chosen] - other_position[chosen].mean(axis=0)
        cost = cdist(here, there, "sqeuclidean")
        partner[ours] = chosen[linear_sum_assignment(cost)[1]]
    return partner
