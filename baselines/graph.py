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

Bounds = tuple[tuple[float, float], tuple[float, float]]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MARGIN = 1e-6  # cells are wider than the radius by this share, more than rounding can move a particle
FAR = 1 << 20  # cells that are told apart on either side of the origin; what lies beyond shares the last


@torch.no_grad()
def radius_graph(
    position: Tensor, radius: float, sample: Tensor | None = None, *, self_edges: bool = False
) -> Tensor:
    """Connect all pairs of particles within a radius, itself included, without a cap on neighbours.

    Return senders and receivers, int64, shape [2, edge]: both directions of every pair, sorted by receiver,
    then sender. Particles of different windows, which `sample` names in ascending order, are never
    connected, and those whose position is no finite number have no edges.
    """
    where = "radius_graph"
    if position.ndim != 2 or position.shape[1] != 2:
        got = tuple(position.shape)
        raise UsageError("positions have the wrong shape", where=where, expected="[particle, 2]", got=got)
    if not (math.isfinite(radius) and radius > 0.0):
        raise UsageError("the radius is no length", where=where, expected="a positive number", got=radius)
    fits = sample is None or (sample.shape == position.shape[:1] and bool((sample[1:] >= sample[:-1]).all()))
    if sample is not None and not fits:
        raise UsageError(
            "windows do not fit the particles",
            where="radius_graph, sample",
            expected=f"{len(position)} ascending numbers",
            got=f"shape {tuple(sample.shape)}",
        )
    search = _graph_numpy if position.device.type == "cpu" else _graph_torch
    return search(position, radius, sample, self_edges)


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
    """Search as :func:`_graph_numpy`, with torch operations alone, on any device."""
    x = position.detach().double()
    kept = x.isfinite().all(dim=1).nonzero().squeeze(1)
    window = x.new_zeros(len(x), dtype=torch.int64) if sample is None else sample
    x, key = x[kept], window[kept]
    stride: Tensor | int = 0
    if len(x):
        cell = (x * (1.0 / (radius * (1.0 + MARGIN)))).floor().clamp(-FAR, FAR).long()
        cell = cell - cell.amin(dim=0)
        columns, rows = cell.amax(dim=0)
        stride = rows + 2  # stays on the device
        key = (key * (columns + 2) + cell[:, 0]) * stride + cell[:, 1]
    key, order = key.sort()
    x, particle = x[order], kept[order]
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
    i, j = particle[i[near]], particle[j[near]]
    edges = [(i << 32) | j, (j << 32) | i]
    if self_edges:
        edges.append((kept << 32) | kept)
    sorted_edges = torch.cat(edges).sort().values
    return torch.stack([sorted_edges & 0xFFFFFFFF, sorted_edges >> 32])


MATERIALS = 4  # that datasets.yaml knows: 0 liquid, 1 jelly, 2 snow, 3 rope
EMBEDDING = 16  # numbers that a material is embedded in
EDGE_FEATURES = 3  # displacement over radius along x and y, distance over radius
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


def wall_distance(position: Tensor, bounds: Bounds, reach: float) -> Tensor:
    """Return the distances to left, right, bottom and top wall over the reach [length], clipped to [-1, 1].

    A wall farther away than the reach looks like one at it; outside the box they are negative.
    """
    (left, right), (bottom, top) = bounds
    x, y = position.unbind(dim=-1)
    distance = torch.stack([x - left, right - x, y - bottom, top - y], dim=-1)
    return (distance / reach).clamp(-1.0, 1.0)


def edge_features(position: Tensor, edge_index: Tensor, radius: float) -> Tensor:
    """Return ``((x_s - x_r) / radius, (y_s - y_r) / radius, distance / radius)``, shape [edge, 3]."""
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
    """

    def __init__(
        self,
        bounds: Bounds,
        velocity: Scale,
        acceleration: Scale,
        reach: float,
        *,
        velocities: int = 5,
        moving_walls: bool = False,
    ) -> None:
        super().__init__()
        self.velocities = velocities  # last per-frame velocities that a particle shows
        self.velocity = velocity
        self.acceleration = acceleration
        self.bounds = bounds  # of the box, (low, high) along x and y [length]
        self.reach = reach  # how far a wall is seen [length]
        self.moving_walls = moving_walls  # whether the velocities of the walls are features too
        self.embedding = nn.Embedding(MATERIALS, EMBEDDING)

    @property
    def count(self) -> int:
        """Features of one particle: with five velocities 30, or 38 with moving walls."""
        return 2 * self.velocities + _WALLS + EMBEDDING + 2 * _WALLS * self.moving_walls

    def forward(
        self, position: Tensor, velocity: Tensor, material: Tensor, wall_velocity: Tensor | None = None
    ) -> Tensor:
        """Return the features of each particle, shape [particle, count].

        Velocities, oldest first, have shape [particle, velocities, 2]; those of the walls as each particle
        sees them shape [particle, 4, 2], and None counts as walls at rest.
        """
        distance = wall_distance(position, self.bounds, self.reach)
        changes = self.acceleration(velocity.diff(dim=1)).flatten(1)
        kind = self.embedding(material).to(position.dtype)
        parts = [self.velocity(velocity[:, -1]), changes, distance, kind]
        if self.moving_walls:
            felt = distance.new_zeros(len(distance), _WALLS, 2)
            if wall_velocity is not None:
                nearness = 1.0 - distance.clamp(min=0.0)
                felt = nearness.unsqueeze(-1) * wall_velocity / self.velocity.std
            parts.append(felt.flatten(1))
        return torch.cat(parts, dim=1)
