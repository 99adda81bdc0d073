"""Particles to nodes and back by quadratic B-splines, on the grid of a network.

    spread:  g_i = sum_p w_pi v_p        (P2G)
    gather:  v_p = sum_i w_pi g_i        (G2P)

with w_pi the product over the axes of b(x_p - x_i), and the b of
:mod:`lagbench.data.grid`. Both take one :class:`Stencil` and have gradients to
positions and values. A box has two or three axes, between walls or periodic: along a
periodic axis the last node is a neighbour of the first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from lagbench.data.box import AXES, Box
from lagbench.tensors import TensorBox

from .baseline import DatasetInfo
from .graph import Bounds, wall_distance


class Stencil(NamedTuple):
    """The nodes around each particle: 9 in two dimensions, 27 in three."""

    weight: Tensor  # of each node [1], shape [particle, 9]; they sum to 1
    # number of the node among those of all layers, int64, shape [particle * 9]
    node: Tensor


class ParticleGrid(nn.Module):
    """Square or cubic cells, symmetric about the middle of the box.

    Walls lie between two nodes. A periodic axis is a whole number of cells long, and
    its first node lies half a cell from the seam; there cells may be longer or shorter
    than along other axes.

    Each window, or material, has its own layer of nodes, so its particles do not mix
    with others.

    Args:
        bounds: box (low, high) along each axis [length]; particles lie in it.
        cells: cells across the widest side of the box.
        multiple: number that divides the nodes of each axis.
        periodic: whether each axis repeats itself; by default there are walls only.
    """

    low: Tensor
    high: Tensor
    cell: Tensor  # width of a cell along each axis [length], float64, shape [axis]

    def __init__(
        self,
        bounds: Bounds,
        cells: int,
        *,
        multiple: int = 1,
        periodic: Sequence[bool] | None = None,
    ) -> None:
        super().__init__()
        box = Box.from_bounds(bounds, periodic)
        self.box = TensorBox(box)
        self.bounds = bounds
        widest_side = max(high - low for low, high in bounds)
        self.spacing = widest_side / cells

        cell_widths = []
        for axis, (start, end) in enumerate(bounds):
            width = self.spacing
            if box.periodic[axis]:
                # The multiple of nodes that is nearest to the number of spacings in the
                # period, but at least three: a particle touches three different nodes.
                nearest_multiples = round((end - start) / self.spacing / multiple)
                fewest_multiples = math.ceil(3 / multiple)
                nodes = multiple * max(nearest_multiples, fewest_multiples)
                width = (end - start) / nodes
                numbers = torch.arange(nodes, dtype=torch.float64)
                places = start + (numbers + 0.5) * width
            else:
                nodes = math.ceil((end - start) / self.spacing - 1e-6) + 2
                nodes += -nodes % multiple
                numbers = torch.arange(nodes, dtype=torch.float64)
                middle = (start + end) / 2
                places = middle + (numbers - (nodes - 1) / 2) * self.spacing
            cell_widths.append(width)
            self.register_buffer(f"axis_{AXES[axis]}", places.float(), persistent=False)

        ends = torch.tensor(bounds)
        low = ends[:, 0]
        high = ends[:, 1]
        cell = torch.tensor(cell_widths, dtype=torch.float64)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)
        self.register_buffer("cell", cell, persistent=False)

    @property
    def dimension(self) -> int:
        """Number of axes: 2 or 3."""
        return len(self.bounds)

    @property
    def periodic(self) -> tuple[bool, ...]:
        """Whether each axis repeats itself."""
        return self.box.box.periodic

    @property
    def axes(self) -> tuple[Tensor, ...]:
        """Places of the nodes along each axis [length], each of shape [node]."""
        places = []
        for name in AXES[: self.dimension]:
            buffer = self.get_buffer(f"axis_{name}")
            places.append(buffer)
        return tuple(places)

    @property
    def shape(self) -> tuple[int, ...]:
        """Nodes along each axis."""
        return tuple(len(axis) for axis in self.axes)

    @property
    def walls(self) -> list[int]:
        """Numbers of the walls that there are, two of each axis."""
        numbers = []
        for axis, is_periodic in enumerate(self.periodic):
            if not is_periodic:
                numbers += [2 * axis, 2 * axis + 1]
        return numbers

    def stencil(self, position: Tensor, layer: Tensor) -> Stencil:
        """Return the nodes around each particle.

        Args:
            position: positions [length], shape [particle, axis].
            layer: layer of nodes of each particle, int64, shape [particle].
        """
        first_places = [axis[0] for axis in self.axes]
        origin = torch.stack(first_places)
        distance = position - origin
        s = distance / self.cell.to(position)  # in cells
        corner = torch.floor(s.detach() - 0.5)  # lowest of three nodes along each axis
        # NaN must not become an index.
        corner = corner.nan_to_num(0.0)

        # On the far wall the third node has weight 0 and may not exist: the stencil
        # stays inside. Along a periodic axis the lowest node may have a number below 0.
        first = []
        last = []
        for is_periodic, nodes in zip(self.periodic, self.shape, strict=True):
            first.append(-math.inf if is_periodic else 0.0)
            last.append(math.inf if is_periodic else nodes - 3.0)
        corner = corner.clamp(s.new_tensor(first), s.new_tensor(last))
        s = s - corner

        # the spline at three nodes along each axis, shape [particle, 3, axis]
        near = 0.5 * (1.5 - s) ** 2
        middle = 0.75 - (s - 1.0) ** 2
        far = 0.5 * (s - 0.5) ** 2
        values = torch.stack([near, middle, far], dim=1)
        weight = values[:, :, None, 0] * values[:, None, :, 1]
        if self.dimension == 3:
            weight = weight[..., None] * values[:, None, None, :, 2]

        # Nodes are numbered through all layers, the last axis fastest.
        offset = torch.arange(3, device=position.device)
        one_node = [1] * self.dimension
        node = layer.view(-1, *one_node)
        for axis, lowest in enumerate(corner.long().unbind(dim=1)):
            place = lowest[:, None] + offset
            if self.periodic[axis]:
                place = place % self.shape[axis]
            along_axis = list(one_node)
            along_axis[axis] = 3
            node = node * self.shape[axis] + place.view(-1, *along_axis)
        return Stencil(weight.flatten(1), node.flatten())

    def momenta(
        self, position: Tensor, velocity: Tensor, sample: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return weights and momenta at the nodes.

        The weights [1] have shape [window, x node, y node], the momenta [unit of the
        velocity] [window, axis, x node, y node]. Particles beyond a wall count on it.

        Args:
            position: positions [length], shape [particle, axis].
            velocity: shape [particle, axis].
            sample: window of each particle, ascending, shape [particle].
        """
        stencil = self.stencil(self.box.inside(position), sample)
        one = torch.ones_like(velocity[:, :1])
        value = torch.cat([one, velocity], dim=1)
        sums = self.spread(stencil, value, int(sample[-1]) + 1)
        return sums[:, 0], sums[:, 1:]

    def slopes(self, field: Tensor) -> tuple[Tensor, Tensor]:
        """Return central differences along x and y at the inner nodes [unit/length].

        The field has shape [..., x node, y node]. The box has two dimensions.
        """
        right = field[..., 2:, 1:-1]
        left = field[..., :-2, 1:-1]
        above = field[..., 1:-1, 2:]
        below = field[..., 1:-1, :-2]
        return (right - left) / (2 * self.spacing), (above - below) / (2 * self.spacing)

    def spread(self, stencil: Stencil, value: Tensor, layers: int) -> Tensor:
        """Return the weighted sums of the particles' values at the nodes (P2G).

        Args:
            stencil: nodes around each particle, and their weights.
            value: of the particles, shape [particle, channel].
            layers: number of separate grids, such as one per window and material;
                particles of two layers do not mix.

        Returns:
            Shape [layer, channel, x node, y node]; in three dimensions the z nodes are
            a last axis.
        """
        weight = stencil.weight[:, :, None]
        contributions = weight * value[:, None]
        contributions = contributions.flatten(0, 1)  # [particle * node, channel]

        shape = self.shape
        channels = value.shape[1]
        node_count = layers * math.prod(shape)
        sums = value.new_zeros(node_count, channels)
        sums = sums.index_add(0, stencil.node, contributions)
        by_node = sums.view(layers, *shape, channels)
        # The exporter to ONNX understands no axis below 0 here.
        last_axis = self.dimension + 1
        return by_node.movedim(last_axis, 1)

    def gather(self, stencil: Stencil, field: Tensor) -> Tensor:
        """Return a field at the particles, shape [particle, channel].

        ``field`` has shape [layer, channel, x node, y node], or with z nodes.
        """
        weight = stencil.weight
        channels = field.shape[1]
        nodes_around = weight.shape[1]
        last_axis = self.dimension + 1
        by_node = field.movedim(1, last_axis)
        by_node = by_node.reshape(-1, channels)
        if self.dimension == 3:
            # Products with 27 nodes would fill the memory: this sums at once.
            node = stencil.node.view(-1, nodes_around)
            # It takes one type only, and a product takes two.
            dtype = torch.promote_types(by_node.dtype, weight.dtype)
            by_node = by_node.to(dtype)
            weight = weight.to(dtype)
            return embedding_bag(node, by_node, per_sample_weights=weight, mode="sum")
        nearby = by_node.index_select(0, stencil.node)
        nearby = nearby.view(-1, nodes_around, channels)
        weighted = weight[:, :, None] * nearby
        return weighted.sum(dim=1)

    def offsets(self, stencil: Stencil, position: Tensor) -> Tensor:
        """Return the way from each particle to its nodes [length], [particle, 9, 2].

        The box has two dimensions and walls.
        """
        columns, rows = self.shape
        axis_x, axis_y = self.axes
        nodes_of_layer = columns * rows
        node = stencil.node.view(-1, 9) % nodes_of_layer
        column = node // rows
        row = node % rows
        x = axis_x[column]
        y = axis_y[row]
        place = torch.stack([x, y], dim=2)
        return place - position[:, None]

    def wall_distance(self, reach: float) -> Tensor:
        """Return the nodes' distances to the walls over the reach [1], clipped to
        [-1, 1].

        They are those of :func:`~lagbench.baselines.graph.wall_distance`. Periodic axes
        have no walls. The shape is [wall, x node, y node].
        """
        coordinates = torch.meshgrid(*self.axes, indexing="ij")
        node = torch.stack(coordinates, dim=-1)
        distance = wall_distance(node, self.bounds, reach, self.periodic)
        by_wall = distance.movedim(-1, 0)
        return by_wall[self.walls].contiguous()

    def beside_walls(self) -> Tensor:
        """Return 1 at the two rows of nodes beside each wall, else 0.

        A wall on a row of nodes has this row only. The shape is [wall, x node, y node].
        """
        distance = self.wall_distance(self.spacing)
        # a wall on nodes has its neighbours at 1, up to rounding
        is_beside = distance.abs() < 0.999
        return is_beside.to(torch.float32)


def score_grid(info: DatasetInfo) -> ParticleGrid | None:
    """Return a grid with the spacing of the scorer's, for losses of fields.

    There is one in two dimensions between walls only.
    """
    if info.box.dimension != 2 or info.box.is_periodic:
        return None
    widest_side = float(info.box.lengths.max())
    return ParticleGrid(info.bounds, max(1, round(widest_side * info.score_cells)))
