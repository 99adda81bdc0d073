"""The fields of :mod:`lagbench.data.grid` in torch, for the training loss.

The same quadratic B-splines, counted nodes and central differences, with gradients to
positions and velocities. Arrays of particles have shape [..., particle, 2] and fields
[..., x node, y node]. Or windows lie side by side in one row, as in
:class:`~lagbench.baselines.baseline.Batch`: particles then have shape [particle, 2],
`sample` names the window of each particle, and fields have shape [window, x node, y
node].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import pad

from lagbench.data.grid import COUNTED_SHARE, EMPTY_SHARE, Grid
from lagbench.errors import UsageError

# rows of nodes that a particle in the unit box can reach beyond the grid's own nodes
_ROWS_BELOW = 1
_ROWS_ABOVE = 2


@dataclass(frozen=True)
class TensorTransfer:
    """Sums over the particles around each node, as tensors."""

    weight: Tensor  # sum(w) [1], shape [..., x node, y node]
    momentum: Tensor  # sum(w u) [unit of u], shape [..., x node, y node, 2]


@dataclass(frozen=True)
class TensorFields:
    """Grid fields with gradients."""

    grid: Grid  # where the nodes lie
    weight: Tensor  # sum(w) [1], shape [..., x node, y node]
    # node velocity, 0 at empty nodes [unit of u], shape [..., x node, y node, 2]
    velocity: Tensor
    counted: Tensor  # nodes that count, bool, shape [..., x node, y node]
    full_weight: float  # weight of a full interior node [1]

    @property
    def density(self) -> Tensor:
        """Density relative to the initial one [1], shape [..., x node, y node]."""
        return self.weight / self.full_weight

    @cached_property
    def differentiable(self) -> Tensor:
        """Nodes whose four neighbours exist and count, bool, [..., x node, y node].

        Vorticity and divergence are defined at these nodes.
        """
        right = self.counted[..., 2:, 1:-1]
        left = self.counted[..., :-2, 1:-1]
        above = self.counted[..., 1:-1, 2:]
        below = self.counted[..., 1:-1, :-2]
        along_x = right & left
        along_y = above & below
        return pad(along_x & along_y, (1, 1, 1, 1))

    @cached_property
    def vorticity(self) -> Tensor:
        """``dv/dx - du/dy`` (Eq. 5.19) [unit of u / length].

        It is 0, not NaN, where the fields are not differentiable.
        """
        u, v = self.velocity.unbind(dim=-1)
        _, du_dy = self._differentiate(u)
        dv_dx, _ = self._differentiate(v)
        curl = dv_dx - du_dy
        return curl * self.differentiable

    @cached_property
    def divergence(self) -> Tensor:
        """``du/dx + dv/dy`` [unit of u / length].

        It is 0, not NaN, where the fields are not differentiable.
        """
        u, v = self.velocity.unbind(dim=-1)
        du_dx, _ = self._differentiate(u)
        _, dv_dy = self._differentiate(v)
        trace = du_dx + dv_dy
        return trace * self.differentiable

    def _differentiate(self, field: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``df/dx`` and ``df/dy`` by central differences; 0 on the rim."""
        double_spacing = 2.0 * self.grid.spacing
        right = field[..., 2:, :]
        left = field[..., :-2, :]
        above = field[..., :, 2:]
        below = field[..., :, :-2]
        slope_x = (right - left) / double_spacing
        slope_y = (above - below) / double_spacing
        rim_x = (0, 0, 1, 1)
        rim_y = (1, 1)
        return pad(slope_x, rim_x), pad(slope_y, rim_y)


def tensor_fields(
    sums: TensorTransfer,
    grid: Grid,
    full_weight: float,
    counted: Tensor | None = None,
) -> TensorFields:
    """Return the grid fields of particles.

    Velocity is ``sum(w u) / sum(w)``, and 0 where the weight is below EMPTY_SHARE of
    full.

    Args:
        sums: sums over the particles around each node.
        grid: where the nodes lie.
        full_weight: weight of a full interior node [1].
        counted: nodes that count; by default those of the particles. The fields of a
            prediction take the nodes of the truth.
    """
    weight = sums.weight
    if counted is None:
        least_counted = COUNTED_SHARE * full_weight
        counted = weight.detach() >= least_counted
    least_filled = EMPTY_SHARE * full_weight
    is_filled = (weight >= least_filled) & (weight > 0.0)
    # Empty nodes divide by 1: a quotient that `where` drops must not have an infinite
    # gradient.
    divisor = torch.where(is_filled, weight, 1.0)
    quotient = sums.momentum / divisor[..., None]
    has_velocity = is_filled[..., None]
    velocity = torch.where(has_velocity, quotient, 0.0)
    return TensorFields(grid, weight, velocity, counted, full_weight)


def transfer(
    position: Tensor,
    velocity: Tensor,
    grid: Grid,
    *,
    sample: Tensor | None = None,
    windows: int | None = None,
) -> TensorTransfer:
    """Sum weights and momenta of the particles at the nodes.

    Particles outside the unit box, or with a position that is no number, carry no
    weight and get no gradient. Without ``windows`` their number is one more than the
    largest sample; a GPU makes the caller wait for it.

    Raises:
        UsageError: the shapes do not fit each other.
    """
    _check_shapes(position, velocity, sample)
    leading: tuple[int, ...]
    if sample is None:
        leading = tuple(position.shape[:-2])
        particles = position.shape[-2]
        windows = math.prod(leading)
        window_numbers = torch.arange(windows, device=position.device)
        sample = window_numbers.repeat_interleave(particles)
    else:
        if windows is None:
            windows = _count_windows(sample)
        leading = (windows,)

    x = position.reshape(-1, 2)
    u = velocity.reshape(-1, 2)
    is_axis_inside = (x >= 0.0) & (x <= 1.0)
    is_inside = is_axis_inside.all(dim=-1, keepdim=True)
    # Replaced before any arithmetic: 0 times NaN would be NaN, in the gradient too.
    x = torch.where(is_inside, x, 0.5)
    u = torch.where(is_inside, u, 0.0)

    s = x * grid.cells - grid.origin  # position in cells, counted from node 0
    base = torch.floor(s.detach() - 0.5)
    side = grid.nodes + _ROWS_BELOW + _ROWS_ABOVE
    corner = base.long() + _ROWS_BELOW
    places = three_places(corner)
    node = number_nodes(sample, places, (side, side))
    weight = spline_weights(s - base)
    weight = weight * is_inside[..., None]  # [particle, 3, 3]

    one = torch.ones_like(u[:, :1])
    carried = torch.cat([one, u], dim=-1)  # (1, u, v)
    carried = carried[:, None, None]
    contributions = weight[..., None] * carried
    contributions = contributions.reshape(-1, 3)
    node_count = windows * side * side
    sums = contributions.new_zeros(node_count, 3)
    sums = sums.index_add(0, node.flatten(), contributions)
    sums = sums.reshape(windows, side, side, 3)

    # The grid's own nodes, without the rows that particles at the walls can reach.
    own = slice(_ROWS_BELOW, -_ROWS_ABOVE)
    sums = sums[:, own, own]
    sums = sums.reshape(*leading, grid.nodes, grid.nodes, 3)
    weight_sum = sums[..., 0]
    momentum = sums[..., 1:]
    return TensorTransfer(weight_sum, momentum)


def _check_shapes(position: Tensor, velocity: Tensor, sample: Tensor | None) -> None:
    """Refuse positions, velocities and windows whose shapes do not fit each other."""
    if sample is None:
        axes_fit = position.ndim >= 2
    else:
        particles = position.shape[:1]
        axes_fit = position.ndim == 2 and particles == sample.shape
    has_one_shape = position.shape == velocity.shape
    if axes_fit and has_one_shape and position.shape[-1] == 2:
        return

    shapes = f"{tuple(position.shape)}, {tuple(velocity.shape)}"
    if sample is not None:
        shapes += f" and sample {tuple(sample.shape)}"
    raise UsageError(
        f"positions, velocities and windows do not fit: {shapes}, expected two "
        "tensors of one shape [..., particle, 2], or [particle, 2] with sample "
        "[particle]"
    )


def _count_windows(sample: Tensor) -> int:
    if not len(sample):
        return 0
    last_window = int(sample.max())
    return last_window + 1


def spline_weights(s: Tensor) -> Tensor:
    """Return the weights of the nodes around particles, 3 along each axis.

    The shape is [particle, 3, 3] in two dimensions, [particle, 3, 3, 3] in three.
    ``s`` is where particles lie from the first of their nodes on [cell].
    """
    values = spline_values(s)
    along_x = values[:, :, None, 0]
    along_y = values[:, None, :, 1]
    weight = along_x * along_y
    if values.shape[2] == 3:
        along_z = values[:, None, None, :, 2]
        weight = weight[..., None] * along_z
    return weight


def spline_values(s: Tensor) -> Tensor:
    """Return the spline at three nodes along each axis, shape [particle, 3, axis]."""
    first = 0.5 * (1.5 - s) ** 2
    second = 0.75 - (s - 1.0) ** 2
    third = 0.5 * (s - 0.5) ** 2
    return torch.stack([first, second, third], dim=1)


def three_places(corner: Tensor) -> list[Tensor]:
    """Return the numbers of three nodes along each axis, each [particle, 3].

    ``corner`` holds the first of them, int64, shape [particle, axis].
    """
    offset = torch.arange(3, device=corner.device)
    places = []
    for first in corner.unbind(dim=1):
        place = first[:, None] + offset
        places.append(place)
    return places


def number_nodes(
    layer: Tensor, places: Sequence[Tensor], shape: Sequence[int]
) -> Tensor:
    """Return the numbers of the nodes around particles, shape [particle, 3, ...].

    Nodes are numbered through all layers, the last axis fastest.

    Args:
        layer: layer of each particle, int64, shape [particle].
        places: numbers of three nodes along each axis, int64, each of shape
            [particle, 3].
        shape: nodes along each axis.
    """
    dimension = len(shape)
    one_node = [1] * dimension
    node = layer.view(-1, *one_node)
    for axis, place in enumerate(places):
        along_axis = [1] * dimension
        along_axis[axis] = 3
        place_along_axis = place.view(-1, *along_axis)
        node = node * shape[axis] + place_along_axis
    return node
