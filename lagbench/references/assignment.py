"""Partners in another cloud: which of its particles each of ours follows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import UNIT_SQUARE, Box, Floats

MOST_TOGETHER = 4096
"""Particles among which the best assignment is sought: its time grows with the cube."""


def assign_particles(
    position: Floats,
    other_position: Floats,
    material: NDArray[np.integer],
    other_material: NDArray[np.integer],
    box: Box = UNIT_SQUARE,
    *,
    most_together: int = MOST_TOGETHER,
) -> NDArray[np.intp]:
    """Return for each particle its partner in another cloud.

    Within each material the sum of squared distances is least, once the clouds are
    moved so that their means agree. Along a periodic axis, where a cloud has no mean,
    they stay and distances are the shortest. More than ``most_together`` particles
    are halved along the longest side of their cloud, both clouds at the same rank,
    until there are no more than that. Where the other cloud has fewer or more particles
    of a material, some are taken more than once, or not at all, evenly over their
    numbers. Particles of a material that the other cloud lacks get partners among all
    of its particles, of which there is at least one.

    Args:
        position: our positions [length], shape [particle, axis].
        other_position: positions of the other cloud [length], shape [other, axis].
        material: material of each of our particles, shape [particle].
        other_material: material of each particle of the other cloud, shape [other].
        box: box that holds the particles.
        most_together: particles of a material that are assigned together, at most.

    Returns:
        Indices into the other cloud, shape [particle].
    """
    partner = np.empty(len(position), np.intp)
    for kind in np.unique(material):
        ours = np.flatnonzero(material == kind)
        pool = np.flatnonzero(other_material == kind)
        if not pool.size:
            pool = np.arange(len(other_position))
        numbers = np.arange(len(ours))
        places = numbers * len(pool) // len(ours)
        chosen = pool[places]
        here = _centre(position[ours], box)
        there = _centre(other_position[chosen], box)
        matched = _match(here, there, box, most_together)
        partner[ours] = chosen[matched]
    return partner


def _centre(position: Floats, box: Box) -> Floats:
    """Return positions from the mean of their cloud, from 0 along periodic axes."""
    mean = np.where(box.periodic, 0.0, position.mean(axis=0))
    return np.asarray(position - mean)


def _match(
    here: Floats, there: Floats, box: Box, most_together: int
) -> NDArray[np.intp]:
    """Return for each point here the index of its point there; there are as many."""
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist

    count = len(here)
    if count > most_together:
        # Halves along the longest side are matched apart.
        partner = np.empty(count, np.intp)
        sides = np.ptp(here, axis=0)
        axis = int(np.argmax(sides))
        half = count // 2
        order = np.argsort(here[:, axis], kind="stable")
        other_order = np.argsort(there[:, axis], kind="stable")
        for part in (slice(None, half), slice(half, None)):
            ours = order[part]
            others = other_order[part]
            matched = _match(here[ours], there[others], box, most_together)
            partner[ours] = others[matched]
        return partner
    if box.is_periodic:
        cost = np.zeros((count, len(there)))
        for axis, is_periodic in enumerate(box.periodic):
            way = here[:, axis, None] - there[:, axis]
            if is_periodic:
                period = box.lengths[axis]
                way -= period * np.rint(way / period)
            cost += way**2
    else:
        cost = cdist(here, there, "sqeuclidean")
    _, matched = linear_sum_assignment(cost)
    return np.asarray(matched, np.intp)
