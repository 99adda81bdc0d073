"""Grid fields of particles: quadratic B-spline transfer, vorticity, divergence.

Node velocity is ``sum_p(w u) / sum_p(w)``. The weight w is the product over the axes of
``b(d / h)``, with d the way from node to particle along the axis and

    b(s) = 3/4 - s^2             for |s| <= 1/2,
    b(s) = (3/2 - |s|)^2 / 2     for 1/2 <= |s| <= 3/2, else 0.

The scorer, the plots and the differentiable fields in the training loss share this one
definition. A box has two or three axes, between walls or periodic. Arrays of particles
have shape [..., particle, axis]. Fields have one axis of nodes for each axis of the
box: [..., x node, y node] in two dimensions, written [..., *node] below. Leading axes
are frames or scenarios, and a batch gives the same bits as its frames alone.
"""

from __future__ import annotations

import enum
import itertools
import math
import operator
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.errors import UsageError

from .box import UNIT_SQUARE, Box

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

COUNTED_SHARE = 0.35
"""Least share of a full interior node's weight from which a node counts.

Nodes at walls (1/2) count, nodes at corners (1/4) do not.
"""

MOST_CELLS = 4096
"""Cells across a score grid."""

MOST_NODES = 20_000_000
"""Nodes of a score grid: 4096 cells across a square, 270 across a cube of side 1.

A field of float64 has 160 MB then, and a score needs several of them.
"""

EMPTY_SHARE = 1e-3
"""Below this share of a full node's weight a node is empty and its velocity is 0."""

# Rows by which the stencil of a particle in the unit box can reach past the grid.
_ROWS_BELOW = 1
_ROWS_ABOVE = 2


def most_cells(box: Box) -> int:
    """Return the most cells across a length of 1 of a score grid in a box.

    The grid has at most :data:`MOST_NODES` nodes. In a box with very long periods the
    result may be small, or not positive.

    >>> from lagbench.data.box import unit_box
    >>> most_cells(unit_box(2)), most_cells(unit_box(3))
    (4096, 270)
    """
    # volume of the grid, which ends at 0 and 1 along axes with walls
    volume = float(np.prod(np.where(box.periodic, box.lengths, 1.0)))
    # the largest c with volume (c + 1)^d nodes; the one is the last node of an axis
    nodes_across = math.pow(MOST_NODES / volume, 1.0 / box.dimension)
    return min(MOST_CELLS, math.floor(nodes_across) - 1)


class Placement(enum.StrEnum):
    """Where the nodes of a grid lie."""

    CELL_CENTRES = "cell_centres"
    NODES = "nodes"

    @property
    def is_full_box(self) -> bool:
        """Whether fluid fills the boxes with such nodes; others have a free surface."""
        return self is Placement.CELL_CENTRES


@dataclass(frozen=True)
class Grid:
    """Grid of nodes with one spacing along all axes.

    Along an axis with walls the nodes cover [0, 1], along a periodic axis the box.

    >>> Grid(4, Placement.CELL_CENTRES).axis
    array([0.125, 0.375, 0.625, 0.875])
    """

    cells: int  # cells across a length of 1
    # nodes at (i + 1/2) / cells (cell centres) or at i / cells (nodes)
    placement: Placement = Placement.CELL_CENTRES
    box: Box = UNIT_SQUARE  # that holds the particles

    def __post_init__(self) -> None:
        """Check the cells, and accept the placement's name as in datasets.yaml.

        Raises:
            UsageError: fewer than two cells, or a periodic axis that is not three or
                more whole cells long.
        """
        if self.cells < 2:
            raise UsageError(
                f"a grid needs cells: {self.cells}; give more cells", where="cells"
            )
        object.__setattr__(self, "placement", Placement(self.placement))
        if not self.box.has_whole_cells(self.cells):
            raise UsageError(
                f"a periodic axis is no whole number of cells long: {self.cells} "
                f"cells across a length of 1, box {self.box.bounds}; another number "
                "of cells",
                where="cells",
            )

    @property
    def dimension(self) -> int:
        """Number of axes: 2 or 3."""
        return self.box.dimension

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """Nodes along each axis."""
        lengths = self.box.lengths.tolist()
        node_counts = []
        for length, is_periodic in zip(lengths, self.box.periodic, strict=True):
            count = self.nodes
            if is_periodic:
                count = round(length * self.cells)
            node_counts.append(count)
        return tuple(node_counts)

    @cached_property
    def section(self) -> Grid:
        """Grid of the middle plane across z; in two dimensions the grid itself."""
        box = self.box
        if box.dimension == 2:
            return self
        plane = Box(box.low[:2], box.high[:2], box.periodic[:2])
        return Grid(self.cells, self.placement, plane)

    @property
    def middle_layer(self) -> int:
        """Number along z of the nodes of the middle plane, in three dimensions."""
        height = self.places(2) - self.box.centre[2]
        return int(np.argmin(np.abs(height)))

    @property
    def start(self) -> Floats:
        """Lower end of the grid [length], shape [axis]."""
        return np.where(self.box.periodic, self.box.low, 0.0)

    def places(self, axis: int) -> Floats:
        """Return the positions of the nodes along an axis [length], shape [node]."""
        distance = (np.arange(self.shape[axis]) + self.origin) / self.cells
        return np.asarray(self.start[axis] + distance, np.float64)

    @property
    def spacing(self) -> float:
        """Distance h between neighbouring nodes [length]."""
        return 1.0 / self.cells

    @property
    def nodes(self) -> int:
        """Nodes along an axis with walls."""
        return self.cells + (self.placement is Placement.NODES)

    @property
    def origin(self) -> float:
        """Way from the lower end of the grid to node 0 in units of h: 1/2 or 0."""
        if self.placement is Placement.CELL_CENTRES:
            return 0.5
        return 0.0

    @property
    def axis(self) -> Floats:
        """Positions of the nodes along an axis with walls [length], shape [nodes]."""
        return (np.arange(self.nodes) + self.origin) / self.cells

    def full_weight(self, particles: int, area: float) -> float:
        """Return the weight ``N h^d / A`` of a node deep inside the material [1].

        Args:
            particles: particles N of the scenario.
            area: area or volume A that they cover at first [length^d].
        """
        return particles * self.spacing**self.dimension / area


@dataclass(frozen=True)
class Transfer:
    """Sums over the particles around each node."""

    weight: Floats  # sum(w) [1], shape [..., *node]
    momentum: Floats  # sum(w u) [unit of u], shape [..., *node, axis]


@dataclass(frozen=True)
class Fields:
    """Grid fields of one frame or a batch of frames."""

    grid: Grid  # where the nodes lie
    weight: Floats  # sum(w) [1], shape [..., *node]
    # node velocity, 0 at empty nodes [unit of u], shape [..., *node, axis]
    velocity: Floats
    counted: Mask  # nodes that count, shape [..., *node]
    full: float  # weight of a full interior node [1]

    @property
    def density(self) -> Floats:
        """Density relative to the initial one [1], shape [..., *node]."""
        return self.weight / self.full

    @cached_property
    def differentiable(self) -> Mask:
        """Nodes with vorticity and divergence, shape [..., *node]."""
        return differentiable_nodes(self.counted, self.grid.box.periodic)

    @cached_property
    def vorticity(self) -> Floats:
        """The curl [unit of u / length], NaN where not differentiable.

        Its shape is [..., *node]; in three dimensions [..., *node, axis].
        """
        slope = curl(self.velocity, self.grid.spacing, self.grid.box.periodic)
        is_defined = self.differentiable
        if self.grid.dimension == 3:
            is_defined = is_defined[..., None]
        return np.where(is_defined, slope, np.nan)

    @cached_property
    def section(self) -> Fields:
        """Fields in the middle plane across z; in two dimensions all of them.

        The vorticity there is the component across the plane, divergence that of the
        velocity in the plane.
        """
        if self.grid.dimension == 2:
            return self
        return self.slice_across_z(self.grid.middle_layer)

    def slice_across_z(self, layer: int) -> Fields:
        """Return the fields in one plane across z, in three dimensions.

        Args:
            layer: index along z of the plane's nodes, from 0.
        """
        return Fields(
            self.grid.section,
            self.weight[..., layer],
            self.velocity[..., layer, :2],
            self.counted[..., layer],
            self.full,
        )

    @cached_property
    def divergence(self) -> Floats:
        """Sum of slopes [unit of u / length], NaN where not differentiable."""
        slope = divergence(self.velocity, self.grid.spacing, self.grid.box.periodic)
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
        position: particle positions [length], shape [..., particle, axis].
        velocity: particle velocities u, shape [..., particle, axis]; per frame gives
            1/frame.
        grid: grid of the fields.
        full: weight of a full interior node, :meth:`Grid.full_weight` [1].
        counted: nodes that count, those of the truth when a prediction is scored; by
            default those of these particles.
    """
    sums = transfer(position, velocity, grid)
    if counted is None:
        counted = counted_nodes(sums.weight, full)
    mean_velocity = node_velocity(sums, full)
    return Fields(grid, sums.weight, mean_velocity, counted, full)


def transfer(position: ArrayLike, velocity: ArrayLike, grid: Grid) -> Transfer:
    """Sum weights and momenta of the particles at the nodes.

    Particles outside the unit box along an axis with walls, or with a position that is
    no number, carry no weight. Along a periodic axis the nodes repeat.

    Args:
        position: particle positions [length], shape [..., particle, axis].
        velocity: particle velocities u, shape [..., particle, axis].
        grid: grid of the fields.

    Raises:
        UsageError: the shapes differ or do not end in [particle, axis].
    """
    x = np.asarray(position, np.float64)
    u = np.asarray(velocity, np.float64)
    dimension = grid.dimension
    if x.shape != u.shape or x.ndim < 2 or x.shape[-1] != dimension:
        raise UsageError(
            f"positions and velocities do not fit: got {x.shape} and {u.shape}, "
            f"expected two arrays of one shape [..., particle, {dimension}]; give "
            "both for the same particles",
            where="position and velocity",
        )
    # sum(w) and the components of sum(w u), shape [..., 1 + axis, *node]
    batch_shape = x.shape[:-2]
    sums = np.empty((*batch_shape, 1 + dimension, *grid.shape))
    for frame in np.ndindex(batch_shape):  # a frame fits the cache, a batch does not
        _scatter(x[frame], u[frame], grid, sums[frame])
    by_component = np.moveaxis(sums, -1 - dimension, -1)  # [..., *node, 1 + axis]
    weight = by_component[..., 0]
    momentum = by_component[..., 1:]
    return Transfer(weight, momentum)


def _scatter(x: Floats, u: Floats, grid: Grid, out: Floats) -> None:
    """Write ``sum(w)`` and the components of ``sum(w u)`` of one frame.

    Args:
        x: particle positions [length], shape [particle, axis].
        u: particle velocities, shape [particle, axis].
        grid: grid of the fields.
        out: receives the sums, shape [1 + axis, *node].
    """
    box = grid.box
    x = box.wrap(x)
    # nearly always in truth; NaN is not inside either
    is_all_inside = x.min(initial=0.0) >= 0.0 and x.max(initial=1.0) <= 1.0
    if box.is_periodic or not is_all_inside:
        is_between = (x >= 0.0) & (x <= 1.0)
        is_inside = np.where(box.periodic, np.isfinite(x), is_between).all(axis=1)
        x = x[is_inside] - grid.start
        u = u[is_inside]
    base, weights = _spline_weights(x, grid)

    # Number of the lowest node around each particle, on a grid with margins. The
    # target is shifted to the other nodes instead.
    padded_shape = [count + _ROWS_BELOW + _ROWS_ABOVE for count in grid.shape]
    strides = [math.prod(padded_shape[axis + 1 :]) for axis in range(grid.dimension)]
    base += _ROWS_BELOW
    corner = base[0] * strides[0]
    for row, stride in zip(base[1:], strides[1:], strict=True):
        corner += stride * row
    corner = corner.astype(np.intp)
    size = math.prod(padded_shape)
    padded_size = size + 2 * sum(strides)

    # Two sums are one of complex numbers, which takes less time than two of real ones.
    # In two dimensions the weight is left over.
    components = list(np.ascontiguousarray(u.T))
    lone_sum = np.zeros(padded_size) if grid.dimension == 2 else None
    pair_count = (grid.dimension + 1) // 2
    pair_sums = [np.zeros(padded_size, np.complex128) for _ in range(pair_count)]
    weight = np.empty(len(x))
    product = np.empty(len(x), np.complex128)
    for offsets in itertools.product(range(3), repeat=grid.dimension):
        shift = sum(map(operator.mul, offsets, strides))
        np.multiply(weights[0, offsets[0]], weights[1, offsets[1]], out=weight)
        if grid.dimension == 3:
            weight *= weights[2, offsets[2]]
        if lone_sum is not None:
            np.add.at(lone_sum[shift:], corner, weight)
        for number, pair_sum in enumerate(pair_sums):
            second = 2 * number + (lone_sum is not None)
            if second == 0:
                product.real = weight
            else:
                np.multiply(weight, components[second - 1], out=product.real)
            np.multiply(weight, components[second], out=product.imag)
            np.add.at(pair_sum[shift:], corner, product)

    sums = [] if lone_sum is None else [lone_sum]
    for pair_sum in pair_sums:
        sums += [pair_sum.real, pair_sum.imag]
    for field, padded in zip(out, sums, strict=True):
        field[:] = _fold(padded[:size].reshape(padded_shape), grid)


def _fold(padded: Floats, grid: Grid) -> Floats:
    """Return the sums at the nodes of the grid.

    Margins of periodic axes are added at the other end, those of walls are dropped.
    """
    for axis, is_periodic in enumerate(grid.box.periodic):
        along = np.moveaxis(padded, axis, 0)
        inner = along[_ROWS_BELOW:-_ROWS_ABOVE]
        if is_periodic:
            inner = inner.copy()
            inner[-_ROWS_BELOW:] += along[:_ROWS_BELOW]
            inner[:_ROWS_ABOVE] += along[-_ROWS_ABOVE:]
        padded = np.moveaxis(inner, 0, axis)
    return padded


def _spline_weights(x: Floats, grid: Grid) -> tuple[Floats, Floats]:
    """Return the lowest of each particle's three nodes per axis, and their weights.

    Shapes [axis, particle] and [axis, node, particle].
    """
    s = x.T * grid.cells
    s -= grid.origin
    base = np.floor(s - 0.5)
    s -= base
    axes, particles = s.shape
    weights = np.empty((axes, 3, particles))
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
    is_filled = (sums.weight >= EMPTY_SHARE * full) & (sums.weight > 0.0)
    divisor = sums.weight[..., None]
    velocity = np.zeros_like(sums.momentum)
    np.divide(sums.momentum, divisor, out=velocity, where=is_filled[..., None])
    return velocity


def differentiable_nodes(
    counted: Mask, periodic: Sequence[bool] = (False, False)
) -> Mask:
    """Return the nodes whose neighbours along every axis exist and count.

    Args:
        counted: nodes that count, shape [..., *node].
        periodic: whether each axis repeats itself, shape [axis].
    """
    inner = np.ones_like(counted)
    for axis, is_periodic in enumerate(periodic):
        place = axis - len(periodic)
        # Views with that axis last; np.moveaxis would take as long as the differences.
        neighbour = counted.swapaxes(place, -1)
        along = inner.swapaxes(place, -1)
        along[..., 1:-1] &= neighbour[..., 2:] & neighbour[..., :-2]
        if is_periodic:
            along[..., 0] &= neighbour[..., 1] & neighbour[..., -1]
            along[..., -1] &= neighbour[..., 0] & neighbour[..., -2]
        else:
            along[..., 0] = False
            along[..., -1] = False
    return inner


def slope_along(
    field: Floats, axis: int, spacing: float, *, is_periodic: bool = False
) -> Floats:
    """Return central differences of a field along an axis [unit of the field / length].

    Between walls the two ends of the axis have no central difference: they are 0.

    Args:
        field: values at the nodes, shape [..., *node].
        axis: axis of the array, counted from its end: -1 for the last.
        spacing: distance h between nodes [length].
        is_periodic: whether the last node has the first one beside it.
    """
    slope = np.zeros(field.shape)
    double_spacing = 2.0 * spacing
    # Views with that axis last; np.moveaxis would take as long as the differences.
    value = field.swapaxes(axis, -1)
    along = slope.swapaxes(axis, -1)
    difference = value[..., 2:] - value[..., :-2]
    along[..., 1:-1] = difference / double_spacing
    if is_periodic:
        first_difference = value[..., 1] - value[..., -1]
        last_difference = value[..., 0] - value[..., -2]
        along[..., 0] = first_difference / double_spacing
        along[..., -1] = last_difference / double_spacing
    return slope


def curl(
    velocity: Floats, spacing: float, periodic: Sequence[bool] | None = None
) -> Floats:
    """Return the curl of a velocity field by central differences (Eq. 5.19).

    In two dimensions it is ``dv/dx - du/dy``, in three the vector ``d_j u_k - d_k u_j``
    for cyclic axes. A solid-body rotation Omega gives 2 Omega. Between walls the slopes
    are 0 on the rim of the grid.

    Args:
        velocity: node velocity, shape [..., *node, axis].
        spacing: distance h between nodes [length].
        periodic: whether each axis repeats itself, shape [axis]; none by default.

    Returns:
        Shape [..., *node] in two dimensions, [..., *node, axis] in three.
    """
    dimension = velocity.shape[-1]
    if periodic is None:
        periodic = [False] * dimension
    if dimension == 2 and not any(periodic):
        return vorticity(velocity, spacing)

    def slope(component: int, axis: int) -> Floats:
        return slope_along(
            velocity[..., component],
            axis - dimension,
            spacing,
            is_periodic=periodic[axis],
        )

    if dimension == 2:
        return slope(1, 0) - slope(0, 1)
    components = []
    for j, k in ((1, 2), (2, 0), (0, 1)):
        component = slope(k, j) - slope(j, k)
        components.append(component)
    return np.stack(components, axis=-1)


def vorticity(velocity: Floats, spacing: float) -> Floats:
    """Return ``omega = dv/dx - du/dy`` (Eq. 5.19) in two dimensions between walls.

    Solid-body rotation Omega gives 2 Omega. These are central differences. Along an
    axis the two ends have none: the derivative is 0 there.

    Args:
        velocity: node velocity, shape [..., x node, y node, 2].
        spacing: distance h between nodes [length].
    """
    u = velocity[..., 0]
    v = velocity[..., 1]
    double_spacing = 2.0 * spacing
    v_difference = v[..., 2:, :] - v[..., :-2, :]
    u_difference = u[..., 2:] - u[..., :-2]
    curl = np.zeros(u.shape)
    curl[..., 1:-1, :] = v_difference / double_spacing
    curl[..., 1:-1] -= u_difference / double_spacing
    return curl


def divergence(
    velocity: Floats, spacing: float, periodic: Sequence[bool] | None = None
) -> Floats:
    """Return ``du/dx + dv/dy (+ dw/dz)``; an incompressible flow gives 0.

    The differences are those of :func:`curl`.

    Args:
        velocity: node velocity, shape [..., *node, axis].
        spacing: distance h between nodes [length].
        periodic: whether each axis repeats itself, shape [axis]; none by default.

    Returns:
        Shape [..., *node].
    """
    dimension = velocity.shape[-1]
    if periodic is None:
        periodic = [False] * dimension
    total = np.zeros(velocity.shape[:-1])
    for axis, is_periodic in enumerate(periodic):
        total += slope_along(
            velocity[..., axis], axis - dimension, spacing, is_periodic=is_periodic
        )
    return total
