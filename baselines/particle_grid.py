"""Particles to nodes and back by quadratic B-splines, on the grid of a network.

    spread:  g_ij = sum_p b(x_p - x_i) b(y_p - y_j) v_p        (P2G)
    gather:  v_p  = sum_ij b(x_p - x_i) b(y_p - y_j) g_ij      (G2P)

with the b of :mod:`lagbench.data.grid`. Both share one :class:`Stencil` and have
gradients to positions and values.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from .graph import Bounds, wall_distance
from .torch_grid import nine_nodes, spline_slopes, spline_weights

__all__ = ["ParticleGrid", "Stencil"]


class Stencil(NamedTuple):
    """The nine nodes around each particle."""

    weight: Tensor  # of each node [1], shape [particle, 9]; they sum to 1
    # number of the node among those of all layers, int64, shape [particle * 9]
    node: Tensor


class ParticleGrid(nn.Module):
    """Square cells that lie in a box as its images do: walls between two nodes, the
    centre in the middle.

    Particles that do not mix, those of several windows or materials, each have a layer
    of nodes.

    Args:
        bounds: box (low, high) along x and y [length]; particles lie in it.
        cells: cells across the wider side of the box.
        multiple: number that divides the nodes of each axis.
    """

    axis_x: Tensor
    axis_y: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, bounds: Bounds, cells: int, *, multiple: int = 1) -> None:
        super().__init__()
        self.bounds = bounds
        self.spacing = max(high - low for low, high in bounds) / cells
        for name, (low, high) in zip(("axis_x", "axis_y"), bounds, strict=True):
            nodes = math.ceil((high - low) / self.spacing - 1e-6) + 2
            nodes += -nodes % multiple
            places = (
                torch.arange(nodes, dtype=torch.float64) - (nodes - 1) / 2
            ) * self.spacing
            axis = ((low + high) / 2 + places).to(torch.float32)
            self.register_buffer(name, axis, persistent=False)
        self.register_buffer("low", torch.tensor(bounds)[:, 0], persistent=False)
        self.register_buffer("high", torch.tensor(bounds)[:, 1], persistent=False)

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes along x and y."""
        return len(self.axis_x), len(self.axis_y)

    def stencil(self, position: Tensor, layer: Tensor) -> Stencil:
        """Return the nodes around positions [length], shape [particle, 2], in layers,
        int64, [particle].
        """
        base, s = self._corner(position)
        column, row = base.long().unbind(dim=1)
        node = nine_nodes(layer, column, row, self.shape)
        return Stencil(spline_weights(s).flatten(1), node.flatten())

    def _corner(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Return the first of the nodes around particles, and where they lie from it on
        [cell].
        """
        columns, rows = self.shape
        s = (position - torch.stack([self.axis_x[0], self.axis_y[0]])) / self.spacing
        # On the far wall the third node has weight 0 and may not exist; NaN must not
        # become an index.
        last = s.new_tensor([columns - 3, rows - 3])
        base = (
            torch.floor(s.detach() - 0.5).nan_to_num(0.0).clamp(min=0.0).minimum(last)
        )
        return base, s - base

    def spread(self, stencil: Stencil, value: Tensor, layers: int) -> Tensor:
        """Return sums at the nodes, [layer, channel, x node, y node], of values
        [particle, channel].
        """
        columns, rows = self.shape
        parts = (stencil.weight[:, :, None] * value[:, None]).flatten(0, 1)
        sums = value.new_zeros(layers * columns * rows, value.shape[1]).index_add(
            0, stencil.node, parts
        )
        return sums.view(layers, columns, rows, -1).permute(0, 3, 1, 2)

    def gather(self, stencil: Stencil, field: Tensor) -> Tensor:
        """Return a field, [layer, channel, x node, y node], at the particles,
        [particle, channel].
        """
        channels = field.shape[1]
        nodes = (
            field.permute(0, 2, 3, 1)
            .reshape(-1, channels)
            .index_select(0, stencil.node)
        )
        return (stencil.weight[:, :, None] * nodes.view(-1, 9, channels)).sum(dim=1)

    def pushed(
        self, stencil: Stencil, position: Tensor, stress: Tensor, mass: Tensor
    ) -> Tensor:
        """Return accelerations (x, y) of nodes of matter under stress, [layer, 2 frame,
        x node, y node].

            m_i a_i = -sum_p s_p grad b_i(x_p),   m_i = sum_p b_i(x_p)

        the weak form of the material-point method (Sulsky, Chen and Schreyer 1994),
        with grad per cell; 0 where there is no matter. As the b_i sum to 1 and the s_p
        are symmetric, momentum and angular momentum of the nodes are kept. ``stress``
        has components (xx, xy, yy), shape [particle, frame, 3]; the stencil is that of
        ``position``; ``mass`` is what :meth:`spread` returns of 1.
        """
        columns, rows = self.shape
        along_x, along_y = (
            spline_slopes(self._corner(position)[1]).flatten(2)[..., None].unbind(dim=1)
        )
        xx, xy, yy = stress[:, None].unbind(dim=3)
        force = -torch.stack(
            [xx * along_x + xy * along_y, xy * along_x + yy * along_y], dim=3
        )
        parts = force.flatten(2).flatten(0, 1)
        sums = force.new_zeros(mass.numel(), parts.shape[1]).index_add(
            0, stencil.node, parts
        )
        sums = sums / mass.flatten().clamp(min=1e-9)[:, None]
        return sums.view(len(mass), columns, rows, -1).permute(0, 3, 1, 2)

    def offsets(self, stencil: Stencil, position: Tensor) -> Tensor:
        """Return how far the nine nodes lie from each particle [length], shape
        [particle, 9, 2].
        """
        columns, rows = self.shape
        node = stencil.node.view(-1, 9) % (columns * rows)
        places = torch.stack(
            [self.axis_x[node // rows], self.axis_y[node % rows]], dim=2
        )
        return places - position[:, None]

    def wall_distance(self, reach: float) -> Tensor:
        """Return the nodes' distances to the walls as particles see theirs, shape
        [wall, x node, y node].
        """
        places = torch.stack(
            torch.meshgrid(self.axis_x, self.axis_y, indexing="ij"), dim=-1
        )
        return wall_distance(places, self.bounds, reach).permute(2, 0, 1).contiguous()

    def inside(self) -> Tensor:
        """Return the shares of the nodes' splines that lie in the box [1], shape [x
        node, y node].
        """
        of_x, of_y = (
            _below((high - axis) / self.spacing) - _below((low - axis) / self.spacing)
            for axis, low, high in zip(
                (self.axis_x, self.axis_y), self.low, self.high, strict=True
            )
        )
        return of_x[:, None] * of_y

    def beside_walls(self) -> Tensor:
        """Return 1 at the two rows of nodes beside each wall, else 0, shape [wall, x
        node, y node].
        """
        return (self.wall_distance(self.spacing).abs() < 1.0).to(torch.float32)


def _below(s: Tensor) -> Tensor:
    """Return the integral of the spline up to a distance from its node [cell]."""
    s = s.clamp(-1.5, 1.5)
    near = 0.5 + s * (0.75 - s * s / 3.0)
    far = (1.5 - s.abs()) ** 3 / 6.0
    return torch.where(s.abs() < 0.5, near, torch.where(s < 0.0, far, 1.0 - far))
