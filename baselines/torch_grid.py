"""Differentiable twin of :mod:`lagbench.data.grid`: the fields of the training loss.

The same quadratic B-splines, counted nodes and central differences, in torch, with
gradients to positions and velocities. Arrays of particles have shape [..., particle, 2]
and fields [..., x node, y node]; or windows lie side by side in one row, as in
:class:`~lagbench.baselines.baseline.Batch`: particles then have shape [particle, 2] and
`sample` says which window each belongs to, fields have shape [window, x node, y node].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from lagbench.data.grid import COUNTED_SHARE, EMPTY_SHARE, Grid
from lagbench.errors import UsageError

_LOW = 1
_HIGH = 2  # rows that the stencil of a particle in the unit box can reach past the grid


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
    # node velocity, 0 at empty nodes [unit of u], shape [..., x node, y node, 2]
    velocity: Tensor
    counted: Tensor  # nodes that count, bool, shape [..., x node, y node]
    full: float  # weight of a full interior node [1]

    @property
    def density(self) -> Tensor:
        """Density relative to the initial one [1], shape [..., x node, y node]."""
        return self.weight / self.full

    @cached_property
    def differentiable(self) -> Tensor:
        """Nodes at which vorticity and divergence stand, bool, shape [..., x node, y
        node].
        """
        # the four neighbours exist and count
        across = self.counted[..., 2:, 1:-1] & self.counted[..., :-2, 1:-1]
        along = self.counted[..., 1:-1, 2:] & self.counted[..., 1:-1, :-2]
        return pad(across & along, (1, 1, 1, 1))

    @cached_property
    def vorticity(self) -> Tensor:
        """``dv/dx - du/dy`` (Eq. 5.19) [unit of u / length]; 0, not NaN, where not
        differentiable.
        """
        u, v = self.velocity.unbind(dim=-1)
        return (self._differences(v)[0] - self._differences(u)[1]) * self.differentiable

    @cached_property
    def divergence(self) -> Tensor:
        """``du/dx + dv/dy`` [unit of u / length]; 0, not NaN, where not
        differentiable.
        """
        u, v = self.velocity.unbind(dim=-1)
        return (self._differences(u)[0] + self._differences(v)[1]) * self.differentiable

    def _differences(self, field: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``df/dx`` and ``df/dy``, 0 on the rim of the grid where no central
        difference exists.
        """
        along_x = (field[..., 2:, :] - field[..., :-2, :]) / (2.0 * self.grid.spacing)
        along_y = (field[..., :, 2:] - field[..., :, :-2]) / (2.0 * self.grid.spacing)
        return pad(along_x, (0, 0, 1, 1)), pad(along_y, (1, 1))


def fields(
    sums: Transfer, grid: Grid, full: float, counted: Tensor | None = None
) -> Fields:
    """Return the grid fields of particles, at the nodes that count: by default their
    own.

    ``full`` is the weight of a full interior node; a prediction is judged at the nodes
    of the truth. Velocity is ``sum(w u) / sum(w)``, 0 where the weight is below
    EMPTY_SHARE of full.
    """
    if counted is None:
        counted = sums.weight.detach() >= COUNTED_SHARE * full
    filled = (sums.weight >= EMPTY_SHARE * full) & (sums.weight > 0.0)
    # Empty nodes divide by 1: a quotient that is thrown away must not have an infinite
    # gradient.
    weight = torch.where(filled, sums.weight, 1.0)
    velocity = torch.where(filled[..., None], sums.momentum / weight[..., None], 0.0)
    return Fields(grid, sums.weight, velocity, counted, full)


def transfer(
    position: Tensor,
    velocity: Tensor,
    grid: Grid,
    *,
    sample: Tensor | None = None,
    windows: int | None = None,
) -> Transfer:
    """Sum weights and momenta of the particles at the nodes.

    Particles outside the unit box, or with a position that is no number, carry no
    weight and get no gradient. Without ``windows`` their number is one more than the
    largest sample, which a GPU has to be waited for.
    """
    if sample is None:
        axes = position.ndim >= 2
    else:
        axes = position.shape[:1] == sample.shape and position.ndim == 2
    if position.shape != velocity.shape or not axes or position.shape[-1] != 2:
        raise UsageError(
            "positions, velocities and windows do not fit",
            expected="two tensors of one shape [..., particle, 2], or [particle, 2] "
            "with sample [particle]",
            got=f"{tuple(position.shape)}, {tuple(velocity.shape)}"
            + ("" if sample is None else f" and sample {tuple(sample.shape)}"),
        )
    if sample is None:
        leading = tuple(position.shape[:-2])
        windows = math.prod(leading)
        particles = position.shape[-2]
        sample = torch.arange(windows, device=position.device).repeat_interleave(
            particles
        )
    else:
        if windows is None:
            if len(sample):
                windows = int(sample.max()) + 1
            else:
                windows = 0
        leading = (windows,)
    x = position.reshape(-1, 2)
    u = velocity.reshape(-1, 2)
    inside = ((x >= 0.0) & (x <= 1.0)).all(dim=-1, keepdim=True)
    # Replaced before any arithmetic: 0 times NaN would be NaN, in the gradient too.
    x = torch.where(inside, x, 0.5)
    u = torch.where(inside, u, 0.0)
    s = x * grid.cells - grid.origin
    base = torch.floor(s.detach() - 0.5)
    side = grid.nodes + _LOW + _HIGH
    column, row = (base.long() + _LOW).unbind(dim=-1)
    node = nine_nodes(sample, column, row, (side, side))
    w = spline_weights(s - base) * inside[..., None]
    carried = torch.cat([torch.ones_like(u[:, :1]), u], dim=-1)
    values = w[..., None] * carried[:, None, None]
    sums = values.new_zeros(windows * side * side, 3).index_add(
        0, node.flatten(), values.reshape(-1, 3)
    )
    sums = sums.reshape(windows, side, side, 3)[:, _LOW:-_HIGH, _LOW:-_HIGH]
    sums = sums.reshape(*leading, grid.nodes, grid.nodes, 3)
    return Transfer(sums[..., 0], sums[..., 1:])


def spline_weights(s: Tensor) -> Tensor:
    """Return the spline's weights of the nine nodes around particles, shape [particle,
    3, 3].
    """
    b = torch.stack(
        [0.5 * (1.5 - s) ** 2, 0.75 - (s - 1.0) ** 2, 0.5 * (s - 0.5) ** 2], dim=1
    )
    return b[:, :, None, 0] * b[:, None, :, 1]


def spline_slopes(s: Tensor) -> Tensor:
    """Return the slopes of those weights along x and y [1/cell], shape [particle, 2, 3,
    3].
    """
    b = torch.stack(
        [0.5 * (1.5 - s) ** 2, 0.75 - (s - 1.0) ** 2, 0.5 * (s - 0.5) ** 2], dim=1
    )
    d = torch.stack([s - 1.5, 2.0 - 2.0 * s, s - 0.5], dim=1)
    along_x = d[:, :, None, 0] * b[:, None, :, 1]
    along_y = b[:, :, None, 0] * d[:, None, :, 1]
    return torch.stack([along_x, along_y], dim=1)


def nine_nodes(
    layer: Tensor, column: Tensor, row: Tensor, shape: tuple[int, int]
) -> Tensor:
    """Return the numbers of the nine nodes from a corner on, among those of all layers
    of a shape.
    """
    columns, rows = shape
    three = torch.arange(3, device=row.device)
    corner = (layer * columns + column) * rows + row
    return corner[:, None, None] + (three[:, None] * rows + three)
