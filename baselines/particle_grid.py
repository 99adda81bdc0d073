"""Particles to nodes and back by quadratic B-splines, on the grid of a network.

    spread:  g_ij = sum_p b(x_p - x_i) b(y_p - y_j) v_p        (P2G)
    gather:  v_p  = sum_ij b(x_p - x_i) b(y_p - y_j) g_ij      (G2P)

with the b of :mod:`lagbench.data.grid`. Both take one :class:`Stencil` and have
gradients to positions and values.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from lagbench.data.box import Box
from lagbench.tensors import TensorBox

from .graph import Bounds, wall_distance
from .torch_grid import number_nine_nodes, spline_slopes, spline_weights

__all__ = ["ParticleGrid", "Stencil"]


class Stencil(NamedTuple):
    """The nine nodes around each particle."""

    weight: Tensor  # of each node [1], shape [particle, 9]; they sum to 1
    # number of the node among those of all layers, int64, shape [particle * 9]
    node: Tensor


class ParticleGrid(nn.Module):
    """Square cells, symmetric about the middle of the box; walls lie between two nodes.

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
        self.box = TensorBox(Box.from_bounds(bounds))
        self.spacing = max(high - low for low, high in bounds) / cells
        axis_x = self._node_places(bounds[0], multiple)
        axis_y = self._node_places(bounds[1], multiple)
        self.register_buffer("axis_x", axis_x, persistent=False)
        self.register_buffer("axis_y", axis_y, persistent=False)
        self.register_buffer("low", torch.tensor(bounds)[:, 0], persistent=False)
        self.register_buffer("high", torch.tensor(bounds)[:, 1], persistent=False)

    def _node_places(self, interval: tuple[float, float], multiple: int) -> Tensor:
        """Return the nodes' places along an axis [length], shape [node]."""
        low, high = interval
        nodes = math.ceil((high - low) / self.spacing - 1e-6) + 2
        nodes += -nodes % multiple
        steps = torch.arange(nodes, dtype=torch.float64) - (nodes - 1) / 2
        places = (low + high) / 2 + steps * self.spacing
        return places.to(torch.float32)

    @property
    def shape(self) -> tuple[int, int]:
        """Nodes along x and y."""
        return len(self.axis_x), len(self.axis_y)

    def stencil(self, position: Tensor, layer: Tensor) -> Stencil:
        """Return the nine nodes around each particle.

        Args:
            position: positions [length], shape [particle, 2].
            layer: layer of nodes of each particle, int64, shape [particle].
        """
        corner, offset = self._locate(position)
        column, row = corner.long().unbind(dim=1)
        node = number_nine_nodes(layer, column, row, self.shape)
        return Stencil(spline_weights(offset).flatten(1), node.flatten())

    def _locate(self, position: Tensor) -> tuple[Tensor, Tensor]:
        """Return the first node around each particle, and the way from it [cell]."""
        columns, rows = self.shape
        origin = torch.stack([self.axis_x[0], self.axis_y[0]])
        s = (position - origin) / self.spacing
        # On the far wall the third node has weight 0 and may not exist; NaN must not
        # become an index.
        last_corner = s.new_tensor([columns - 3, rows - 3])
        corner = torch.floor(s.detach() - 0.5).nan_to_num(0.0)
        corner = corner.clamp(min=0.0).minimum(last_corner)
        return corner, s - corner

    def spread(self, stencil: Stencil, value: Tensor, layers: int) -> Tensor:
        """Return sums at the nodes, shape [layer, channel, x node, y node].

        ``value`` has shape [particle, channel].
        """
        columns, rows = self.shape
        contributions = stencil.weight[:, :, None] * value[:, None]
        sums = value.new_zeros(layers * columns * rows, value.shape[1])
        sums = sums.index_add(0, stencil.node, contributions.flatten(0, 1))
        return sums.view(layers, columns, rows, -1).permute(0, 3, 1, 2)

    def gather(self, stencil: Stencil, field: Tensor) -> Tensor:
        """Return a field at the particles, shape [particle, channel].

        ``field`` has shape [layer, channel, x node, y node].
        """
        channels = field.shape[1]
        by_node = field.permute(0, 2, 3, 1).reshape(-1, channels)
        nearby = by_node.index_select(0, stencil.node).view(-1, 9, channels)
        return (stencil.weight[:, :, None] * nearby).sum(dim=1)

    def accelerate(
        self, stencil: Stencil, position: Tensor, stress: Tensor, mass: Tensor
    ) -> Tensor:
        """Return accelerations (x, y) of nodes of matter under stress.

            m_i a_i = -sum_p s_p grad b_i(x_p),   m_i = sum_p b_i(x_p)

        This is the weak form of the material-point method (Sulsky, Chen and Schreyer
        1994), with grad per cell; a is 0 where there is no matter. As the b_i sum to 1
        and the s_p are symmetric, momentum and angular momentum of the nodes are
        conserved. The result has shape [layer, 2 frame, x node, y node].

        Args:
            stencil: nodes around ``position``.
            position: positions [length], shape [particle, 2].
            stress: components (xx, xy, yy), shape [particle, frame, 3].
            mass: result of :meth:`spread` for values of 1.
        """
        columns, rows = self.shape
        _, offset = self._locate(position)
        slopes = spline_slopes(offset).flatten(2)[..., None]  # [particle, 2, 9, 1]
        slope_x, slope_y = slopes.unbind(dim=1)
        xx, xy, yy = stress[:, None].unbind(dim=3)  # each [particle, 1, frame]

        pull_x = xx * slope_x + xy * slope_y
        pull_y = xy * slope_x + yy * slope_y
        force = -torch.stack([pull_x, pull_y], dim=3)  # [particle, 9, frame, 2]
        contributions = force.flatten(2).flatten(0, 1)
        sums = force.new_zeros(mass.numel(), contributions.shape[1])
        sums = sums.index_add(0, stencil.node, contributions)

        node_mass = mass.flatten().clamp(min=1e-9)
        acceleration = sums / node_mass[:, None]
        return acceleration.view(len(mass), columns, rows, -1).permute(0, 3, 1, 2)

    def offsets(self, stencil: Stencil, position: Tensor) -> Tensor:
        """Return the way from each particle to its nodes [length], [particle, 9, 2]."""
        columns, rows = self.shape
        node = stencil.node.view(-1, 9) % (columns * rows)
        x = self.axis_x[node // rows]
        y = self.axis_y[node % rows]
        return torch.stack([x, y], dim=2) - position[:, None]

    def wall_distance(self, reach: float) -> Tensor:
        """Return the nodes' distances to the walls, shape [wall, x node, y node].

        They are those of :func:`~lagbench.baselines.graph.wall_distance`.
        """
        x, y = torch.meshgrid(self.axis_x, self.axis_y, indexing="ij")
        distance = wall_distance(torch.stack([x, y], dim=-1), self.bounds, reach)
        return distance.permute(2, 0, 1).contiguous()

    def share_inside(self) -> Tensor:
        """Return the shares of the nodes' splines in the box [1], [x node, y node]."""
        low_x, low_y = self.low
        high_x, high_y = self.high
        share_x = self._axis_share_inside(self.axis_x, low_x, high_x)
        share_y = self._axis_share_inside(self.axis_y, low_y, high_y)
        return share_x[:, None] * share_y

    def _axis_share_inside(self, axis: Tensor, low: Tensor, high: Tensor) -> Tensor:
        below_high = _integrate_spline((high - axis) / self.spacing)
        below_low = _integrate_spline((low - axis) / self.spacing)
        return below_high - below_low

    def beside_walls(self) -> Tensor:
        """Return 1 at the two rows of nodes beside each wall, else 0.

        The shape is [wall, x node, y node].
        """
        is_beside = self.wall_distance(self.spacing).abs() < 1.0
        return is_beside.to(torch.float32)


def _integrate_spline(s: Tensor) -> Tensor:
    """Return the integral of the spline up to a distance s from its node [cell]."""
    s = s.clamp(-1.5, 1.5)
    inner = 0.5 + s * (0.75 - s * s / 3.0)
    tail = (1.5 - s.abs()) ** 3 / 6.0
    outer = torch.where(s < 0.0, tail, 1.0 - tail)
    return torch.where(s.abs() < 0.5, inner, outer)
