"""Grid fields of particles: quadratic B-spline transfer, vorticity, divergence.

Node velocity is ``sum_p(w u) / sum_p(w)`` with ``w(d) = b(d_x / h) b(d_y / h)`` and

    b(s) = 3/4 - s^2             for |s| <= 1/2,
    b(s) = (3/2 - |s|)^2 / 2     for 1/2 <= |s| <= 3/2, else 0.

The scorer, the plots and the differentiable twin in the training loss share this one
definition. Arrays of particles have shape [..., particle, 2], fields [..., x node, y
node]; leading axes are frames or scenarios, and a batch gives the same bits as its
frames alone.
"""

from __future__ import annotations

import enum
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.errors import UsageError

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

COUNTED_SHARE = 0.35
"""Least share of a full interior node's weight from which a node counts.

Nodes at walls (1/2) count, nodes at corners (1/4) do not.
"""

EMPTY_SHARE = 1e-3
"""Below this share of a full node's weight a node is empty and its velocity is 0."""

# Rows by which the stencil of a particle in the unit box can reach past the grid.
_ROWS_BELOW = 1
_ROWS_ABOVE = 2


class Placement(enum.StrEnum):
    """Where the nodes of a grid lie."""

    CELL_CENTRES = "cell_centres"
    NODES = "nodes"


@dataclass(frozen=True)
class Grid:
    """Square grid of nodes over the unit box.

    >>> Grid(4, Placement.CELL_CENTRES).axis
    array([0.125, 0.375, 0.625, 0.875])
    """

    cells: int  # cells across the box
    # nodes at (i + 1/2) / cells (cell centres) or at i / cells (nodes)
    placement: Placement = Placement.CELL_CENTRES

    def __post_init__(self) -> None:
        """Accept the placement's name as it stands in datasets.yaml."""
        if self.cells < 2:
            raise UsageError(
                "a grid needs cells",
                where="cells",
                expected="at least 2",
                got=self.cells,
            )
        object.__setattr__(self, "placement", Placement(self.placement))

    @property
    def spacing(self) -> float:
        """Distance h between neighbouring nodes [length]."""
        return 1.0 / self.cells

    @property
    def nodes(self) -> int:
        """Nodes along one side."""
        return self.cells + (self.placement is Placement.NODES)

    @property
    def origin(self) -> float:
        """Position of node 0 in units of h: 1/2 or 0."""
        if self.placement is Placement.CELL_CENTRES:
            return 0.5
        return 0.0

    @property
    def axis(self) -> Floats:
        """Positions of the nodes along one side [length], shape [nodes]."""
        return (np.arange(self.nodes) + self.origin) / self.cells

    def full_weight(self, particles: int, area: float) -> float:
        """Return the weight ``N h^2 / A`` of a node deep inside the material [1].

        Args:
            particles: particles N of the scenario.
            area: area A that they cover at first [length^2].
        """
        return particles * self.spacing**2 / area


@dataclass(frozen=True)
class Transfer:
    """Sums over the particles around each node."""

    weight: Floats  # sum(w) [1], shape [..., x node, y node]
    momentum: Floats  # sum(w u) [unit of u], shape [..., x node, y node, 2]


@dataclass(frozen=True)
class Fields:
    """Grid fields of one frame or a batch of frames."""

    grid: Grid  # where the nodes lie
    weight: Floats  # sum(w) [1], shape [..., x node, y node]
    # node velocity, 0 at empty nodes [unit of u], shape [..., x node, y node, 2]
    velocity: Floats
    counted: Mask  # nodes that count, shape [..., x node, y node]
    full: float  # weight of a full interior node [1]

    @property
    def density(self) -> Floats:
        """Density relative to the initial one [1], shape [..., x node, y node]."""
        return self.weight / self.full

    @cached_property
    def differentiable(self) -> Mask:
        """Nodes with vorticity and divergence, shape [..., x node, y node]."""
        return differentiable_nodes(self.counted)

    @cached_property
    def vorticity(self) -> Floats:
        """``dv/dx - du/dy`` [unit of u / length], NaN where not differentiable."""
        slope = vorticity(self.velocity, self.grid.spacing)
        return np.where(self.differentiable, slope, np.nan)

    @cached_property
    def divergence(self) -> Floats:
        """``du/dx + dv/dy`` [unit of u / length], NaN where not differentiable."""
        slope = divergence(self.velocity, self.grid.spacing)
        return np.where(self.differentiable, slope, np.nan)


def fields(
    position: ArrayLike,
    velocity: ArrayLike,
    grid: Grid,
    *,
    full: float,
    counted: Mask | None = None,
) -> Fields:
    """Return the grid fields of particles.

    Args:
        position: particle positions [length], shape [..., particle, 2].
        velocity: particle velocities u, shape [..., particle, 2]; per frame gives
            1/frame.
        grid: grid of the fields.
        full: weight of a full interior node, :meth:`Grid.full_weight` [1].
        counted: nodes that count, those of the truth when a prediction is scored; by
            default those of these particles.
    """
    sums = transfer(position, velocity, grid)
    if counted is None:
        counted = counted_nodes(sums.weight, full)
    return Fields(grid, sums.weight, node_velocity(sums, full), counted, full)


def transfer(position: ArrayLike, velocity: ArrayLike, grid: Grid) -> Transfer:
    """Sum weights and momenta of the particles at the nodes.

    Particles outside the unit box, or with a position that is no number, carry no
    weight.

    Args:
        position: particle positions [length], shape [..., particle, 2].
        velocity: particle velocities u, shape [..., particle, 2].
        grid: grid of the fields.

    Raises:
        UsageError: the shapes differ or do not end in [particle, 2].
    """
    x = np.asarray(position, np.float64)
    u = np.asarray(velocity, np.float64)
    if x.shape != u.shape or x.ndim < 2 or x.shape[-1] != 2:
        raise UsageError(
            "positions and velocities do not fit",
            expected="two arrays of one shape [..., particle, 2]",
            got=f"{x.shape} and {u.shape}",
        )
    # sum(w) and both components of sum(w u), shape [..., 3, x node, y node]
    sums = np.empty((*x.shape[:-2], 3, grid.nodes, grid.nodes))
    for frame in np.ndindex(x.shape[:-2]):  # a frame fits the cache, a batch does not
        _scatter(x[frame], u[frame], grid, sums[frame])
    momentum = np.moveaxis(sums[..., 1:, :, :], -3, -1)
    return Transfer(weight=sums[..., 0, :, :], momentum=momentum)


def _scatter(x: Floats, u: Floats, grid: Grid, out: Floats) -> None:
    """Write ``sum(w)`` and both components of ``sum(w u)`` of one frame.

    Args:
        x: particle positions [length], shape [particle, 2].
        u: particle velocities, shape [particle, 2].
        grid: grid of the fields.
        out: receives the sums, shape [3, x node, y node].
    """
    # NaN is not inside either.
    all_inside = x.min(initial=0.0) >= 0.0 and x.max(initial=1.0) <= 1.0
    if not all_inside:
        inside = ((x >= 0.0) & (x <= 1.0)).all(axis=1)
        x = x[inside]
        u = u[inside]
    base, weights = _spline_weights(x, grid)
    along_x, along_y = np.ascontiguousarray(u.T)

    # Number of the lowest of the 9 nodes around each particle, on a grid with margins.
    side = grid.nodes + _ROWS_BELOW + _ROWS_ABOVE
    base += _ROWS_BELOW
    base[0] *= side
    corner = (base[0] + base[1]).astype(np.intp)

    # Node numbers stay those of the corner; the target is shifted to the node instead.
    size = side * side
    padded_size = size + 2 * side + 2
    weight_sum = np.zeros(padded_size, np.float64)
    # Both components go into one sum of complex numbers, which takes less time than two
    # sums of real ones.
    momentum_sum = np.zeros(padded_size, np.complex128)
    weight = np.empty(len(corner))
    product = np.empty(len(corner), np.complex128)
    for i in range(3):
        for k in range(3):
            shift = i * side + k
            np.multiply(weights[0, i], weights[1, k], out=weight)
            np.add.at(weight_sum[shift:], corner, weight)
            np.multiply(weight, along_x, out=product.real)
            np.multiply(weight, along_y, out=product.imag)
            np.add.at(momentum_sum[shift:], corner, product)

    inner = slice(_ROWS_BELOW, -_ROWS_ABOVE)
    padded_sums = (weight_sum, momentum_sum.real, momentum_sum.imag)
    for field, padded_sum in zip(out, padded_sums, strict=True):
        field[:] = padded_sum[:size].reshape(side, side)[inner, inner]


def _spline_weights(x: Floats, grid: Grid) -> tuple[Floats, Floats]:
    """Return the lowest of each particle's three nodes per axis, and their weights.

    Shapes [axis, particle] and [axis, node, particle].
    """
    s = x.T * grid.cells
    s -= grid.origin
    base = np.floor(s - 0.5)
    s -= base
    weights = np.empty((len(s), 3, s.shape[1]))
    for node, centre in enumerate((1.5, 1.0, 0.5)):
        weight = weights[:, node]
        np.subtract(s, centre, out=weight)
        np.square(weight, out=weight)
        if centre == 1.0:
            np.subtract(0.75, weight, out=weight)
        else:
            weight *= 0.5
    return base, weights


def counted_nodes(weight: Floats, full: float) -> Mask:
    """Return the nodes with at least :data:`COUNTED_SHARE` of the full weight."""
    return weight >= COUNTED_SHARE * full


def node_velocity(sums: Transfer, full: float) -> Floats:
    """Return ``sum(w u) / sum(w)``; 0 below :data:`EMPTY_SHARE` of the full weight."""
    filled = (sums.weight >= EMPTY_SHARE * full) & (sums.weight > 0.0)
    velocity = np.zeros_like(sums.momentum)
    np.divide(
        sums.momentum, sums.weight[..., None], out=velocity, where=filled[..., None]
    )
    return velocity


def differentiable_nodes(counted: Mask) -> Mask:
    """Return the nodes whose four neighbours exist and count."""
    inner = np.zeros_like(counted)
    inner[..., 1:-1, 1:-1] = (
        counted[..., 2:, 1:-1]
        & counted[..., :-2, 1:-1]
        & counted[..., 1:-1, 2:]
        & counted[..., 1:-1, :-2]
    )
    return inner


def vorticity(velocity: Floats, spacing: float) -> Floats:
    """Return ``omega = dv/dx - du/dy`` (Eq. 5.19).

    Solid-body rotation Omega gives 2 Omega. Central differences, 0 on the rim of the
    grid where there is none.

    Args:
        velocity: node velocity, shape [..., x node, y node, 2].
        spacing: distance h between nodes [length].
    """
    u = velocity[..., 0]
    v = velocity[..., 1]
    slope = np.zeros(u.shape)
    slope[..., 1:-1, :] = (v[..., 2:, :] - v[..., :-2, :]) / (2.0 * spacing)
    slope[..., 1:-1] -= (u[..., 2:] - u[..., :-2]) / (2.0 * spacing)
    return slope


def divergence(velocity: Floats, spacing: float) -> Floats:
    """Return ``du/dx + dv/dy``; an incompressible flow gives 0.

    The differences are those of the vorticity.

    Args:
        velocity: node velocity, shape [..., x node, y node, 2].
        spacing: distance h between nodes [length].
    """
    u = velocity[..., 0]
    v = velocity[..., 1]
    slope = np.zeros(u.shape)
    slope[..., 1:-1, :] = (u[..., 2:, :] - u[..., :-2, :]) / (2.0 * spacing)
    slope[..., 1:-1] += (v[..., 2:] - v[..., :-2]) / (2.0 * spacing)
    return slope
