"""Refinement: the solver runs finer than the files that it writes.

With refinement r the solver has r times as many cells along each axis, r times as many
substeps a frame and r^d times as many particles as the size states. The file holds as
many particles as the size states: one of each r^d, the nearest to the places where the
run of refinement 1 has its particles at the start. Each stands for the mass of r^d.

In a full box the constants that act once a substep follow the substep: a share s that a
particle takes over from the grid becomes s / r, so that the rate s / dt stays. From
r = 3 on it is s / 3: smaller shares do not hold the noise of J. The mixing lengths
shrink with the cells, so what the solver adds to the equations falls as 1/r^2. On a
free surface the shares stay, and it falls as 1/r: J ends at 1 there, and the noise that
a smaller share leaves in J would push particles apart.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Size

from .draws import QUANTUM
from .split import InitialState

__all__ = ["recorded_particles", "refined"]

PER_AXIS = ("grid", "substeps_per_frame", "lattice", "lattice_x", "lattice_y")
"""Parameters that are r times as large."""

PER_SUBSTEP = (
    "velocity_relaxation",
    "jacobian_relaxation",
    "density_coupling",
    "shift",
)
"""Shares of a substep of a full box, of which r are taken in place of one."""

MOST_SHARED = 3
"""Refinement from which shares stay as they are: smaller ones no longer damp the noise
of J, and the run blows up.
"""

CANDIDATES = 16
"""Particles of the finer run among which the one nearest to a place is chosen."""


def refined(size: Size, times: int | None = None) -> Size:
    """Return the size on which the solver runs, with the parameters of a finer run.

    Args:
        size: the size as datasets.yaml states it.
        times: r; that of the size when None.
    """
    times = times or size.refinement
    if times == 1:
        return size
    factors = dict.fromkeys(PER_AXIS, times)
    factors["particles"] = times**size.dimension
    if not size.is_full_box:
        factors["wall"] = times  # a node; in a full box the walls are the bounds
    parameters = dict(size.parameters)
    for name, factor in factors.items():
        if name in parameters:
            value = factor * size.value(name)
            parameters[name] = parameters[name].model_copy(update={"value": value})
    for name in PER_SUBSTEP:
        if name in parameters and size.is_full_box:
            value = size.value(name) / min(times, MOST_SHARED)
            parameters[name] = parameters[name].model_copy(update={"value": value})
    return size.model_copy(update={"parameters": parameters, "subdivision": times})


def recorded_particles(coarse: InitialState, fine: InitialState) -> NDArray[np.int64]:
    """Return which particles of a finer run a file holds, shape [particle].

    In the order of the coarse run each takes the nearest particle of its material that
    is left; of two equally near ones the first. Distances are whole numbers, so that
    all machines choose alike.

    Args:
        coarse: the scenario at refinement 1, before its first substep.
        fine: the same scenario at a higher refinement.
    """
    # planning a generation loads no SciPy
    from scipy.spatial import cKDTree

    places = np.rint(coarse.position / QUANTUM).astype(np.int64)
    points = np.rint(fine.position / QUANTUM).astype(np.int64)
    chosen = np.full(len(places), -1)
    for material in np.unique(coarse.material).tolist():
        rows = np.flatnonzero(coarse.material == material)
        particles = np.flatnonzero(fine.material == material)
        count = min(CANDIDATES, len(particles))
        _, nearest = cKDTree(points[particles]).query(places[rows], k=count)
        candidates = particles[np.sort(nearest.reshape(len(rows), count), axis=1)]
        way = points[candidates] - places[rows][:, None]
        order = np.argsort((way * way).sum(axis=-1), axis=1, kind="stable")
        by_distance = np.take_along_axis(candidates, order, axis=1)
        is_taken = np.zeros(len(points), np.bool_)
        for row, choices in zip(rows.tolist(), by_distance, strict=True):
            free = choices[~is_taken[choices]]
            chosen[row] = free[0]
            is_taken[free[0]] = True
    return chosen
