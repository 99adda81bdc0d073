"""Differentiable twin of :mod:`lagbench.data.grid`: the fields of the training loss.

The same quadratic B-splines, counted nodes and central differences, in torch, with gradients to
positions and velocities. Arrays of particles have shape [..., particle, 2] and fields
[..., x node, y node]; or windows lie side by side in one row, as in
:class:`~lagbench.baselines.baseline.Batch`: particles then have shape [particle, 2] and `sample`
says which window each belongs to, fields have shape [window, x node, y node].

And :class:`ParticleGrid`, the grid of a network, with the same splines b:

    spread:  g_ij = sum_p b(x_p - x_i) b(y_p - y_j) v_p        (P2G)
    gather:  v_p  = sum_ij b(x_p - x_i) b(y_p - y_j) g_ij      (G2P)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import pad

from lagbench.data.grid import COUNTED_SHARE, EMPTY_SHARE, Grid
from lagbench.errors import UsageError

from .graph import Bounds

__all__ = ["Fields", "ParticleGrid", "Stencil", "counted_nodes", "fields", "node_velocity", "transfer"]


_LOW, _HIGH = 1, 2  # rows that the stencil of a particle in the unit box can reach past the grid


@dataclass(frozen=True)
class Transfer:
    """Sums over the particles around each node."""

    weight: Tensor  # sum(w) [1], shape [..., x node, y node]
    momentum: Tensor  # sum(w u) [unit of u], shape [..., x node, y node, 2]


@dataclass(frozen=True)
class Fields:
    """Grid fields with gradients."""

    grid: Grid  # where the nodes lie
    weight: Tensor  # sum(w) [1], shape [..., x node, y node]
    velocity: Tensor  # node velocity, 0 at empty nodes [unit of u], shape [..., x node, y node, 2]
    counted: Tensor  # nodes that count, bool, shape [..., x node, y node]
    full: float  # weight of a full interior node [1]

    @property
    def density(self) -> Tensor:
        """Density relative to the initial one [1], shape [..., x node, y node]."""
        return self.weight / self.full

    @cached_property
    def differentiable(self) -> Tensor:
        """Nodes at which vorticity and divergence stand, bool, shape [..., x node, y node]."""
        # the four neighbours exist and count
        across = self.counted[..., 2:, 1:-1] & self.counted[..., :-2, 1:-1]
        along = self.counted[..., 1:-1, 2:] & self.counted[..., 1:-1, :-2]
        return pad(across & along, (1, 1, 1, 1))

    @cached_property
    def vorticity(self) -> Tensor:
        """``dv/dx - du/dy`` (Eq. 5.19) [unit of u / length]; 0, not NaN, where not differentiable."""
        u, v = self.velocity.unbind(dim=-1)
        return (self._differences(v)[0] - self._differences(u)[1]) * self.differentiable

    @cached_property
    def divergence(self) -> Tensor:
        """``du/dx + dv/dy`` [unit of u / length]; 0, not NaN, where not differentiable."""
        u, v = self.velocity.unbind(dim=-1)
        return (self._differences(u)[0] + self._differences(v)[1]) * self.differentiable

    def _differences(self, field: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``df/dx`` and ``df/dy``, 0 on the rim of the grid where no central difference exists."""
        along_x = (field[..., 2:, :] - field[..., :-2, :]) / (2.0 * self.grid.spacing)
        along_y = (field[..., :, 2:] - field[..., :, :-2]) / (2.0 * self.grid.spacing)
        return pad(along_x, (0, 0, 1, 1)), pad(along_y, (1, 1))


def fields(
    position: Tensor,
    velocity: Tensor,
    grid: Grid,
    *,
    full: float,
    sample: Tensor | None = None,
    windows: int | None = None,
    counted: Tensor | None = None,
) -> Fields:
    """Return the grid fields of particles, at the nodes that count: by default their own.

    ``full`` is the weight of a full interior node; a prediction is judged at the nodes of the truth.
    """
    sums = transfer(position, velocity, grid, sample=sample, windows=windows)
    if counted is None:
        counted = counted_nodes(sums.weight, full)
    return Fields(grid, sums.weight, node_velocity(sums, full), counted, full)


def transfer(
    position: Tensor,
    velocity: Tensor,
    grid: Grid,
    *,
    sample: Tensor | None = None,
    windows: int | None = None,
) -> Transfer:
    """Sum weights and momenta of the particles at the nodes.

    Particles outside the unit box, or with a position that is no number, carry no weight and
    get no gradient. Without ``windows`` their number is one more than the largest sample, which a GPU has
    to be waited for.
    """
    axes = position.ndim >= 2 if sample is None else position.shape[:1] == sample.shape and position.ndim == 2
    if position.shape != velocity.shape or not axes or position.shape[-1] != 2:
        raise UsageError(
            "positions, velocities and windows do not fit",
            expected="two tensors of one shape [..., particle, 2], or [particle, 2] with sample [particle]",
            got=f"{tuple(position.shape)}, {tuple(velocity.shape)}"
            + ("" if sample is None else f" and sample {tuple(sample.shape)}"),
        )
    if sample is None:
        leading = tuple(position.shape[:-2])
        windows = math.prod(leading)
        particles = position.shape[-2]
        sample = torch.arange(windows, device=position.device).repeat_interleave(particles)
    else:
        if windows is None:
            windows = int(sample.max()) + 1 if len(sample) else 0
        leading = (windows,)
    x, u = position.reshape(-1, 2), velocity.reshape(-1, 2)
    inside = ((x >= 0.0) & (x <= 1.0)).all(dim=-1, keepdim=True)
    # Replaced before any arithmetic: 0 times NaN would be NaN, in the gradient too.
    x, u = torch.where(inside, x, 0.5), torch.where(inside, u, 0.0)
    s = x * grid.cells - grid.origin
    base = torch.floor(s.detach() - 0.5)
    side = grid.nodes + _LOW + _HIGH
    column, row = (base.long() + _LOW).unbind(dim=-1)
    node = _nine(sample, column, row, (side, side))
    w = _weights(s - base) * inside[..., None]
    carried = torch.cat([torch.ones_like(u[:, :1]), u], dim=-1)
    values = w[..., None] * carried[:, None, None]
    sums = values.new_zeros(windows * side * side, 3).index_add(0, node.flatten(), values.reshape(-1, 3))
    sums = sums.reshape(windows, side, side, 3)[:, _LOW:-_HIGH, _LOW:-_HIGH]
    sums = sums.reshape(*leading, grid.nodes, grid.nodes, 3)
    return Transfer(sums[..., 0], sums[..., 1:])


def _weights(s: Tensor) -> Tensor:
    """Return the spline's weights of the nine nodes around particles, shape [particle, 3, 3]."""
    b = torch.stack([0.5 * (1.5 - s) ** 2, 0.75 - (s - 1.0) ** 2, 0.5 * (s - 0.5) ** 2], dim=1)
    return b[:, :, None, 0] * b[:, None, :, 1]


def _nine(layer: Tensor, column: Tensor, row: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return the numbers of the nine nodes from a corner on, among those of all layers of a shape."""
    columns, rows = shape
    three = torch.arange(3, device=row.device)
    corner = (layer * columns + column) * rows + row
    return corner[:, None, None] + (three[:, None] * rows + three)


def counted_nodes(weight: Tensor, full: float) -> Tensor:
    """Return the nodes with at least :data:`~lagbench.data.grid.COUNTED_SHARE` of a full node's weight."""
    return weight.detach() >= COUNTED_SHARE * full


def node_velocity(sums: Transfer, full: float) -> Tensor:
    """Return ``sum(w u) / sum(w)``, 0 where the weight is below EMPTY_SHARE of full."""
    filled = (sums.weight >= EMPTY_SHARE * full) & (sums.weight > 0.0)
    # Empty nodes divide by 1: a quotient that is thrown away must not have an infinite gradient.
    weight = torch.where(filled, sums.weight, 1.0)
    return torch.where(filled[..., None], sums.momentum / weight[..., None], 0.0)


class Stencil(NamedTuple):
    """The nine nodes around each particle."""

    weight: Tensor  # of each node [1], shape [particle, 9]; they sum to 1
    node: Tensor  # number of the node among those of all layers, int64, shape [particle * 9]


class ParticleGrid(nn.Module):
    """Square cells that lie in a box as its images do: walls between two nodes, the centre in the middle.

    Particles that do not mix, those of several windows or materials, each have a layer of nodes. ``cells``
    lie across the wider side of the box, and ``multiple`` divides the nodes of each axis.
    """

    axis_x: Tensor
    axis_y: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, bounds: Bounds, cells: int, *, multiple: int = 1) -> None:
        super().__init__()
        self.spacing = max(high - low for low, high in bounds) / cells
        for name, (low, high) in zip(("axis_x", "axis_y"), bounds, strict=True):
            nodes = math.ceil((high - low) / self.spacing - 1e-6) + 2
            nodes += -nodes % multiple
            places = (torch.arange(nodes, dtype=torch.float64) - (nodes - 1) / 2) * self.spacing
            axis = ((low + high) / 2 + places).to(torch.float32)
            self.register_buffer(name, axis, persistent=False)
        self.register_buffer("low", torch.tensor(bounds)[:, 0], persistent=False)
        self.register_buffer("high", torch.tensor(bounds)[:, 1], persistent=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes along x and y."""
        return len(self.axis_x), len(self.axis_y)

    def stencil(self, position: Tensor, layer: Tensor) -> Stencil:
        """Return the nodes around particles, each in its layer."""
        columns, rows = self.shape
        s = (position - torch.stack([self.axis_x[0], self.axis_y[0]])) / self.spacing
        # On the far wall the third node has weight 0 and may not exist; NaN must not become an index.
        last = s.new_tensor([columns - 3, rows - 3])
        base = torch.floor(s.detach() - 0.5).nan_to_num(0.0).clamp(min=0.0).minimum(last)
        column, row = base.long().unbind(dim=1)
        return Stencil(_weights(s - base).flatten(1), _nine(layer, column, row, self.shape).flatten())

    def spread(self, stencil: Stencil, value: Tensor, layers: int) -> Tensor:
        """Return the sums at the nodes, shape [layer, channel, x node, y node], of [particle, channel]."""
        columns, rows = self.shape
        parts = (stencil.weight[:, :, None] * value[:, None]).flatten(0, 1)
        sums = value.new_zeros(layers * columns * rows, value.shape[1]).index_add(0, stencil.node, parts)
        return sums.view(layers, columns, rows, -1).permute(0, 3, 1, 2)

    def gather(self, stencil: Stencil, field: Tensor) -> Tensor:
        """Return a field of shape [layer, channel, x node, y node] at the particles, [particle, channel]."""
        channels = field.shape[1]
        nodes = field.permute(0, 2, 3, 1).reshape(-1, channels).index_select(0, stencil.node)
        return (stencil.weight[:, :, None] * nodes.view(-1, 9, channels)).sum(dim=1)

    def wall_distance(self, reach: float) -> Tensor:
        """Return the distances to left, right, bottom and top wall over a reach, within [-1, 1].

        They are negative outside the box; shape [wall, x node, y node].
        """
        (left, bottom), (right, top) = self.low, self.high
        x, y = (self.axis_x[:, None].expand(self.shape), self.axis_y.expand(self.shape))
        distance = torch.stack([x - left, right - x, y - bottom, top - y])
        return (distance / reach).clamp(-1.0, 1.0)

    def beside_walls(self) -> Tensor:
        """Return 1 at the two rows of nodes beside each wall, else 0, shape [wall, x node, y node]."""
        return (self.wall_distance(self.spacing).abs() < 1.0).to(torch.float32)
