"""Neighbour search: every pair of particles within a radius, exactly, on CPU and GPU.

A pair is connected where, in float64 of the positions as they are stored,

    (x_i - x_j)^2 + (y_i - y_j)^2 <= radius^2.

Particles are sorted by square cells a little wider than the radius. In the order (column, row)
the cells above a particle's own, and the three beside it in the next column, are two runs of
consecutive particles; their distances are all that has to be computed. NumPy does this on the
CPU, torch elsewhere; both compute the inequality with the same roundings and agree to the last edge.

What a graph network sees: motion, walls and material of a particle, its neighbours' places.

Positions enter only as differences, so that away from walls the features do not change when
all particles move by the same vector.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lagbench.errors import UsageError

from .baseline import Facts, Pair

__all__ = [
    "radius_graph",
    "EDGE_FEATURES",
    "MATERIALS",
    "NodeFeatures",
    "Scale",
    "edge_features",
    "wall_distance",
]


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MARGIN = 1e-6
"""Cells are wider than the radius by this share, more than rounding can move a particle."""

FAR = 1 << 20
"""Cells that are told apart on either side of the origin; what lies beyond shares the last."""


@torch.no_grad()
def radius_graph(
    position: Tensor, radius: float, sample: Tensor | None = None, *, self_edges: bool = False
) -> Tensor:
    """Connect all pairs of particles within a radius, without a cap on neighbours.

    Args:
        position: particle positions [length], shape [particle, 2].
        radius: largest distance of a pair [length], itself included.
        sample: window of each particle, ascending, int64, shape [particle]; particles of
            different windows are never connected. One window by default.
        self_edges: whether a particle is connected to itself too.

    Returns:
        ``edge_index``, int64, shape [2, edge]: senders and receivers, both directions of every
        pair, sorted by receiver, then sender. Particles whose position is no finite number have
        no edges.

    Raises:
        UsageError: a shape does not fit, `sample` descends, or the radius is no positive number.
    """
    _check(position, radius, sample)
    if position.device.type == "cpu":
        return _graph_numpy(position, radius, sample, self_edges)
    return _graph_torch(position, radius, sample, self_edges)


def _check(position: Tensor, radius: float, sample: Tensor | None) -> None:
    if position.ndim != 2 or position.shape[1] != 2:
        raise UsageError(
            "positions have the wrong shape",
            where="radius_graph",
            expected="[particle, 2]",
            got=tuple(position.shape),
        )
    if not (math.isfinite(radius) and radius > 0.0):
        raise UsageError(
            "the radius is no length", where="radius_graph", expected="a positive number", got=radius
        )
    if sample is None:
        return
    if sample.shape != position.shape[:1] or bool((sample[1:] < sample[:-1]).any()):
        raise UsageError(
            "windows do not fit the particles",
            where="radius_graph, sample",
            expected=f"{len(position)} ascending numbers",
            got=f"shape {tuple(sample.shape)}",
        )


def _graph_numpy(position: Tensor, radius: float, sample: Tensor | None, self_edges: bool) -> Tensor:
    """Search on the CPU."""
    x = position.detach().double().numpy()
    finite = np.isfinite(x).all(axis=1)
    kept = np.flatnonzero(finite)
    window = np.zeros(len(x), np.int64) if sample is None else sample.numpy()
    key, stride = _cells_numpy(x[kept], window[kept], radius)
    order = np.argsort(key, kind="stable")
    i, j = _pairs_numpy(x[kept[order]], key[order], stride, radius)
    particle = kept[order]
    i, j = particle[i], particle[j]
    edges = [(i << 32) | j, (j << 32) | i]
    if self_edges:
        edges.append((kept << 32) | kept)
    sorted_edges = np.concatenate(edges)
    sorted_edges.sort()
    return torch.from_numpy(np.stack([sorted_edges & 0xFFFFFFFF, sorted_edges >> 32]))


def _cells_numpy(x: Floats, window: Ints, radius: float) -> tuple[Ints, int]:
    """Return each particle's cell number, ascending along y, and the step to the next column."""
    if not len(x):
        return np.zeros(0, np.int64), 0
    cell = np.floor(x * (1.0 / (radius * (1.0 + MARGIN)))).clip(-FAR, FAR).astype(np.int64)
    cell -= cell.min(axis=0)
    columns, rows = cell.max(axis=0)
    # An empty row after each column and an empty column after each window keep them apart.
    stride = int(rows) + 2
    return (window * (columns + 2) + cell[:, 0]) * stride + cell[:, 1], stride


def _pairs_numpy(x: Floats, key: Ints, stride: int, radius: float) -> tuple[Ints, Ints]:
    """Return the pairs among particles sorted by cell, each once."""
    own = np.arange(len(x))
    above = np.searchsorted(key, key + 2)
    beside = np.searchsorted(key, key + (stride - 1))
    past = np.searchsorted(key, key + (stride + 2))
    start = np.concatenate([own + 1, beside])
    count = np.concatenate([above - (own + 1), past - beside])
    i = np.repeat(np.concatenate([own, own]), count)
    j = np.arange(len(i)) + np.repeat(start - (np.cumsum(count) - count), count)
    x_0, x_1 = x.T.copy()
    dx, dy = x_0[i] - x_0[j], x_1[i] - x_1[j]
    near = np.flatnonzero(dx * dx + dy * dy <= radius * radius)
    return i[near], j[near]


def _graph_torch(position: Tensor, radius: float, sample: Tensor | None, self_edges: bool) -> Tensor:
    """Search with torch operations alone, on any device."""
    x = position.detach().double()
    kept = x.isfinite().all(dim=1).nonzero().squeeze(1)
    window = x.new_zeros(len(x), dtype=torch.int64) if sample is None else sample
    key, stride = _cells_torch(x[kept], window[kept], radius)
    key, order = key.sort()
    particle = kept[order]
    i, j = _pairs_torch(x[particle], key, stride, radius)
    i, j = particle[i], particle[j]
    edges = [(i << 32) | j, (j << 32) | i]
    if self_edges:
        edges.append((kept << 32) | kept)
    sorted_edges = torch.cat(edges).sort().values
    return torch.stack([sorted_edges & 0xFFFFFFFF, sorted_edges >> 32])


def _cells_torch(x: Tensor, window: Tensor, radius: float) -> tuple[Tensor, Tensor | int]:
    """Return what :func:`_cells_numpy` returns; the step stays on the device."""
    if not len(x):
        return window, 0
    cell = (x * (1.0 / (radius * (1.0 + MARGIN)))).floor().clamp(-FAR, FAR).long()
    cell = cell - cell.amin(dim=0)
    columns, rows = cell.amax(dim=0)
    stride = rows + 2
    return (window * (columns + 2) + cell[:, 0]) * stride + cell[:, 1], stride


def _pairs_torch(x: Tensor, key: Tensor, stride: Tensor | int, radius: float) -> tuple[Tensor, Tensor]:
    """Return what :func:`_pairs_numpy` returns."""
    own = torch.arange(len(x), device=x.device)
    above = torch.searchsorted(key, key + 2)
    beside = torch.searchsorted(key, key + (stride - 1))
    past = torch.searchsorted(key, key + (stride + 2))
    start = torch.cat([own + 1, beside])
    count = torch.cat([above - (own + 1), past - beside])
    run = torch.repeat_interleave(count)
    i = torch.cat([own, own])[run]
    j = torch.arange(len(run), device=x.device) + (start - (count.cumsum(0) - count))[run]
    x_0, x_1 = x.T.contiguous()
    dx, dy = x_0[i] - x_0[j], x_1[i] - x_1[j]
    near = (dx * dx + dy * dy <= radius * radius).nonzero().squeeze(1)
    return i[near], j[near]


MATERIALS = 4
"""Liquid, jelly, snow, rope."""

EMBEDDING = 16
"""Numbers that a material is embedded in."""

EDGE_FEATURES = 3
"""Displacement over radius along x and y, distance over radius."""

_WALLS = 4  # left, right, bottom, top, the order of wall_velocity in scenario files


class Scale(nn.Module):
    """Standardisation by train statistics: ``(x - mean) / sqrt(std^2 + noise^2)``."""

    mean: Tensor  # mean over train, (x, y)
    std: Tensor  # standard deviation over train, (x, y)

    def __init__(self, mean: Sequence[float], std: Sequence[float], *, noise: float = 0.0) -> None:
        super().__init__()
        widened = (torch.tensor(std, dtype=torch.float64) ** 2 + noise**2).sqrt()
        # Facts and options travel with the weights and rebuild these, unrounded by half precision.
        self.register_buffer("mean", torch.tensor(mean, dtype=torch.float32), persistent=False)
        self.register_buffer("std", widened.to(torch.float32), persistent=False)

    def forward(self, value: Tensor) -> Tensor:
        """Return the standardised value [1]."""
        return (value - self.mean) / self.std

    def inverse(self, standardised: Tensor) -> Tensor:
        """Return the value in its own unit."""
        return standardised * self.std + self.mean


def wall_distance(position: Tensor, bounds: tuple[Pair, Pair], reach: float) -> Tensor:
    """Return the distances to the four walls over the reach, clipped to [-1, 1].

    Args:
        position: particle positions [length], shape [particle, 2].
        bounds: box (low, high) along x and y [length].
        reach: how far a wall is seen [length]; one farther away looks like one at it.

    Returns:
        Left, right, bottom, top; negative outside the box; shape [particle, 4].
    """
    (left, right), (bottom, top) = bounds
    x, y = position.unbind(dim=-1)
    distance = torch.stack([x - left, right - x, y - bottom, top - y], dim=-1)
    return (distance / reach).clamp(-1.0, 1.0)


def edge_features(position: Tensor, edge_index: Tensor, radius: float) -> Tensor:
    """Return displacement and distance from receiver to sender over the radius.

    Args:
        position: particle positions [length], shape [particle, 2].
        edge_index: senders and receivers, int64, shape [2, edge].
        radius: connectivity radius [length].

    Returns:
        ``((x_s - x_r) / radius, (y_s - y_r) / radius, distance / radius)``, shape [edge, 3].
    """
    sender, receiver = edge_index
    displacement = (position.index_select(0, sender) - position.index_select(0, receiver)) / radius
    # The gradient of a norm is NaN at 0, where two particles coincide; that of this root is 0.
    square = (displacement**2).sum(dim=-1, keepdim=True)
    distance = torch.where(square > 0.0, square, 1.0).sqrt() * (square > 0.0)
    return torch.cat([displacement, distance], dim=-1)


class NodeFeatures(nn.Module):
    """Features of a particle: 2 of each velocity, 4 of walls, 16 of material, 8 of moving walls if asked.

    The last velocities are shown as the last one and the changes that led to it, each over its own
    deviation: in velocities alone the changes, of which the next is to be predicted, are hundredths.

    Moving walls: the per-frame velocity of each wall over the velocity scale, times
    ``1 - distance / reach`` (0 beyond the reach), so that it acts where the wall is near.

    Args:
        facts: public figures of the data set.
        velocity: standardisation of per-frame velocities.
        acceleration: standardisation of their changes.
        reach: how far a wall is seen [length].
        velocities: last per-frame velocities that a particle shows.
        moving_walls: whether the velocities of the walls are features too.
    """

    def __init__(
        self,
        facts: Facts,
        velocity: Scale,
        acceleration: Scale,
        reach: float,
        *,
        velocities: int = 5,
        moving_walls: bool = False,
    ) -> None:
        super().__init__()
        self.velocities = velocities
        self.velocity = velocity
        self.acceleration = acceleration
        self.bounds = facts.bounds
        self.reach = reach
        self.moving_walls = moving_walls
        self.embedding = nn.Embedding(MATERIALS, EMBEDDING)

    @property
    def count(self) -> int:
        """Features of one particle: with five velocities 30, or 38 with moving walls."""
        return 2 * self.velocities + _WALLS + EMBEDDING + 2 * _WALLS * self.moving_walls

    def forward(
        self, position: Tensor, velocity: Tensor, material: Tensor, wall_velocity: Tensor | None = None
    ) -> Tensor:
        """Return the features of each particle, shape [particle, count].

        Args:
            position: last positions [length], shape [particle, 2].
            velocity: last velocities, oldest first [length/frame], shape [particle, velocities, 2].
            material: material of each particle, int64, shape [particle].
            wall_velocity: velocity of the walls as each particle sees them [length/frame], shape
                [particle, 4, 2]; None counts as walls at rest.
        """
        distance = wall_distance(position, self.bounds, self.reach)
        changes = self.acceleration(velocity.diff(dim=1)).flatten(1)
        kind = self.embedding(material).to(position.dtype)
        parts = [self.velocity(velocity[:, -1]), changes, distance, kind]
        if self.moving_walls:
            parts.append(self._near_walls(distance, wall_velocity).flatten(1))
        return torch.cat(parts, dim=1)

    def _near_walls(self, distance: Tensor, wall_velocity: Tensor | None) -> Tensor:
        """Return the walls' velocities, faded out over the reach [1], shape [particle, 4, 2]."""
        if wall_velocity is None:
            return distance.new_zeros(len(distance), _WALLS, 2)
        nearness = 1.0 - distance.clamp(min=0.0)
        return nearness.unsqueeze(-1) * wall_velocity / self.velocity.std
