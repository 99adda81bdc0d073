"""Differentiable twin of :mod:`lagbench.data.grid`: the fields of the training loss.

The same quadratic B-splines, counted nodes and central differences, in torch, with gradients to
positions and velocities. Arrays of particles have shape [..., particle, 2] and fields
[..., x node, y node]; or windows lie side by side in one row, as in
:class:`~lagbench.baselines.baseline.Batch`: particles then have shape [particle, 2] and `sample`
says which window each belongs to, fields have shape [window, x node, y node].
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

__all__ = [
    "Fields",
    "Transfer",
    "central_differences",
    "counted_nodes",
    "differentiable_nodes",
    "divergence",
    "fields",
    "node_velocity",
    "transfer",
    "vorticity",
]


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
        return differentiable_nodes(self.counted)

    @cached_property
    def vorticity(self) -> Tensor:
        """``dv/dx - du/dy`` [unit of u / length]; 0, not NaN, where not differentiable."""
        return vorticity(self.velocity, self.grid.spacing) * self.differentiable

    @cached_property
    def divergence(self) -> Tensor:
        """``du/dx + dv/dy`` [unit of u / length]; 0, not NaN, where not differentiable."""
        return divergence(self.velocity, self.grid.spacing) * self.differentiable


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
    """Return the grid fields of particles.

    Args:
        position: particle positions [length], shape [..., particle, 2].
        velocity: particle velocities u, shape [..., particle, 2]; per frame gives 1/frame.
        grid: grid of the fields.
        full: weight of a full interior node, :meth:`lagbench.data.grid.Grid.full_weight` [1].
        sample: see :func:`transfer`.
        windows: see :func:`transfer`.
        counted: nodes that count, those of the truth when a prediction is judged; by default
            those of these particles.
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
    get no gradient.

    Args:
        position: particle positions [length], shape [..., particle, 2].
        velocity: particle velocities u, shape [..., particle, 2].
        grid: grid of the fields.
        sample: window of each particle, int64, shape [particle], for positions of shape
            [particle, 2] of several windows; by default leading axes are the windows.
        windows: number of windows, with `sample`; by default one more than its largest, which
            a GPU has to be waited for.

    Raises:
        UsageError: the shapes differ or do not end in [particle, 2].
    """
    _check(position, velocity, sample)
    if sample is None:
        leading = tuple(position.shape[:-2])
        windows = math.prod(leading)
        particles = position.shape[-2]
        sample = torch.arange(windows, device=position.device).repeat_interleave(particles)
    else:
        if windows is None:
            windows = int(sample.max()) + 1 if len(sample) else 0
        leading = (windows,)
    sums = _scatter(position.reshape(-1, 2), velocity.reshape(-1, 2), grid, sample, windows)
    sums = sums.reshape(*leading, grid.nodes, grid.nodes, 3)
    return Transfer(sums[..., 0], sums[..., 1:])


def _check(position: Tensor, velocity: Tensor, sample: Tensor | None) -> None:
    axes = position.ndim >= 2 if sample is None else position.shape[:1] == sample.shape and position.ndim == 2
    if position.shape != velocity.shape or not axes or position.shape[-1] != 2:
        raise UsageError(
            "positions, velocities and windows do not fit",
            expected="two tensors of one shape [..., particle, 2], or [particle, 2] with sample [particle]",
            got=f"{tuple(position.shape)}, {tuple(velocity.shape)}"
            + ("" if sample is None else f" and sample {tuple(sample.shape)}"),
        )


def _scatter(x: Tensor, u: Tensor, grid: Grid, sample: Tensor, windows: int) -> Tensor:
    """Return ``sum(w), sum(w u_x), sum(w u_y)``, shape [window, x node, y node, 3]."""
    inside = ((x >= 0.0) & (x <= 1.0)).all(dim=-1, keepdim=True)
    # Replaced before any arithmetic: 0 times NaN would be NaN, in the gradient too.
    x, u = torch.where(inside, x, 0.5), torch.where(inside, u, 0.0)
    s = x * grid.cells - grid.origin
    base = torch.floor(s.detach() - 0.5)
    weight = _spline(s - base)
    side = grid.nodes + _LOW + _HIGH
    column, row = (base.long() + _LOW).unbind(dim=-1)
    three = torch.arange(3, device=x.device)
    corner = (sample * side + column) * side + row
    node = corner[:, None, None] + (three[:, None] * side + three)
    w = weight[:, :, None, 0] * weight[:, None, :, 1] * inside[..., None]
    carried = torch.cat([torch.ones_like(u[:, :1]), u], dim=-1)
    values = w[..., None] * carried[:, None, None]
    sums = values.new_zeros(windows * side * side, 3).index_add(0, node.flatten(), values.reshape(-1, 3))
    return sums.reshape(windows, side, side, 3)[:, _LOW:-_HIGH, _LOW:-_HIGH]


def _spline(s: Tensor) -> Tensor:
    """Return the weights of the three nodes of each axis, shape [particle, node, 2]."""
    return torch.stack([0.5 * (1.5 - s) ** 2, 0.75 - (s - 1.0) ** 2, 0.5 * (s - 0.5) ** 2], dim=1)


def counted_nodes(weight: Tensor, full: float) -> Tensor:
    """Return the nodes with at least :data:`~lagbench.data.grid.COUNTED_SHARE` of a full node's weight."""
    return weight.detach() >= COUNTED_SHARE * full


def node_velocity(sums: Transfer, full: float) -> Tensor:
    """Return ``sum(w u) / sum(w)``, 0 where the weight is below EMPTY_SHARE of full."""
    filled = (sums.weight >= EMPTY_SHARE * full) & (sums.weight > 0.0)
    # Empty nodes divide by 1: a quotient that is thrown away must not have an infinite gradient.
    weight = torch.where(filled, sums.weight, 1.0)
    return torch.where(filled[..., None], sums.momentum / weight[..., None], 0.0)


def differentiable_nodes(counted: Tensor) -> Tensor:
    """Return the nodes whose four neighbours exist and count."""
    across = counted[..., 2:, 1:-1] & counted[..., :-2, 1:-1]
    along = counted[..., 1:-1, 2:] & counted[..., 1:-1, :-2]
    return pad(across & along, (1, 1, 1, 1))


def central_differences(field: Tensor, spacing: float) -> tuple[Tensor, Tensor]:
    """Return ``df/dx`` and ``df/dy``, 0 on the rim of the grid where no central difference exists.

    Args:
        field: values at the nodes, shape [..., x node, y node].
        spacing: distance h between nodes [length].
    """
    along_x = (field[..., 2:, :] - field[..., :-2, :]) / (2.0 * spacing)
    along_y = (field[..., :, 2:] - field[..., :, :-2]) / (2.0 * spacing)
    return pad(along_x, (0, 0, 1, 1)), pad(along_y, (1, 1))


def vorticity(velocity: Tensor, spacing: float) -> Tensor:
    """Return ``omega = dv/dx - du/dy`` (Eq. 5.19); solid-body rotation Omega gives 2 Omega.

    Args:
        velocity: node velocity, shape [..., x node, y node, 2].
        spacing: distance h between nodes [length].
    """
    u, v = velocity.unbind(dim=-1)
    return central_differences(v, spacing)[0] - central_differences(u, spacing)[1]


def divergence(velocity: Tensor, spacing: float) -> Tensor:
    """Return ``du/dx + dv/dy``; an incompressible flow gives 0.

    Args:
        velocity: node velocity, shape [..., x node, y node, 2].
        spacing: distance h between nodes [length].
    """
    u, v = velocity.unbind(dim=-1)
    return central_differences(u, spacing)[0] + central_differences(v, spacing)[1]
