"""Neighbour search: every pair of particles within a radius, exactly, on CPU and GPU.

A pair is connected where, in float64 of the positions as they are stored,

    (x_i - x_j)^2 + (y_i - y_j)^2 <= radius^2.

Particles are sorted by square cells a little wider than the radius. In the order
(column, row) the cells above a particle's own, and the three beside it in the next
column, are two runs of consecutive particles; their distances are all that has to be
computed. NumPy does this on the CPU, torch elsewhere, with the same roundings: they
agree to the last edge.

What a graph network sees: motion, walls and material of a particle, its neighbours'
places; of positions only differences, so that away from walls the features do not
change when all particles move by one vector.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree
from torch import Tensor, nn

from lagbench.errors import UsageError

Bounds = tuple[tuple[float, float], tuple[float, float]]

# cells are wider than the radius by this share, more than rounding can move a particle
MARGIN = 1e-6
# cells that are told apart on either side of the origin; what lies beyond shares the
# last
FAR = 1 << 20


@torch.no_grad()
def radius_graph(
    position: Tensor,
    radius: float,
    sample: Tensor | None = None,
    *,
    self_edges: bool = False,
    most: int | None = None,
) -> Tensor:
    """Connect all pairs of particles within a radius, itself included.

    Return senders and receivers, int64, shape [2, edge]: both directions of every pair,
    sorted by receiver, then sender. Particles of different windows, which `sample`
    names in ascending order, are never connected, and those whose position is no finite
    number have no edges.

    With ``most``, a receiver hears that many neighbours, the nearest; of equally far
    ones any. So not all pairs have both directions (SuperGAT's link loss takes what is
    not heard as unlinked). Where matter has collapsed to a heap, memory is then
    bounded, and so is time unless thousands lie at the very same place.
    """
    where = "radius_graph"
    if position.ndim != 2 or position.shape[1] != 2:
        got = tuple(position.shape)
        raise UsageError(
            "positions have the wrong shape",
            where=where,
            expected="[particle, 2]",
            got=got,
        )
    if not (math.isfinite(radius) and radius > 0.0):
        raise UsageError(
            "the radius is no length",
            where=where,
            expected="a positive number",
            got=radius,
        )
    fits = sample is None or (
        sample.shape == position.shape[:1] and bool((sample[1:] >= sample[:-1]).all())
    )
    if sample is not None and not fits:
        raise UsageError(
            "windows do not fit the particles",
            where=f"{where}, sample",
            expected=f"{len(position)} ascending numbers",
            got=f"shape {tuple(sample.shape)}",
        )
    x = position.detach().double()
    if sample is None:
        window = torch.zeros(len(x), dtype=torch.int64, device=x.device)
    else:
        window = sample
    if most is not None:
        near = nearest_edges(
            x.cpu().numpy(), window.cpu().numpy(), radius, self_edges, most
        )
        edges = torch.from_numpy(np.sort(near)).to(x.device)
    elif x.device.type == "cpu":
        edges = torch.from_numpy(
            np.sort(edge_numbers(np, x.numpy(), window.numpy(), radius, self_edges))
        )
    else:
        edges = edge_numbers(torch, x, window, radius, self_edges).sort().values
    return torch.stack([edges & 0xFFFFFFFF, edges >> 32])


def edge_numbers(xp: Any, x: Any, window: Any, radius: float, self_edges: bool) -> Any:  # noqa: ANN401
    """Return receiver * 2^32 + sender of every edge, by arrays of NumPy or of torch as
    ``xp``.
    """
    repeat = np.repeat if xp is np else torch.repeat_interleave
    kept = xp.where(xp.isfinite(x).all(1))[0]
    x = x[kept]
    key = window[kept]
    stride = 0
    if len(x):
        cell = xp.floor(x * (1.0 / (radius * (1.0 + MARGIN))))
        cell = xp.asarray(xp.clip(cell, -FAR, FAR), dtype=xp.int64)
        cell = cell - xp.amin(cell, 0)
        columns, rows = xp.amax(cell, 0)
        # An empty row after each column and an empty column after each window keep them
        # apart.
        stride = rows + 2
        key = (key * (columns + 2) + cell[:, 0]) * stride + cell[:, 1]
    order = xp.argsort(key, stable=True)
    x = x[order]
    key = key[order]
    particle = kept[order]
    own = xp.arange(len(x), device=x.device)
    above = xp.searchsorted(key, key + 2)
    beside = xp.searchsorted(key, key + (stride - 1))
    past = xp.searchsorted(key, key + (stride + 2))
    start = xp.concatenate([own + 1, beside])
    count = xp.concatenate([above - (own + 1), past - beside])
    # the one repeat: a GPU is waited for at each
    run = repeat(xp.arange(len(count), device=x.device), count)
    if len(own):
        i = run % len(own)
    else:
        i = run
    j = (
        xp.arange(len(run), device=x.device)
        + (start - (xp.cumsum(count, 0) - count))[run]
    )
    along_x, along_y = xp.stack([x[:, 0], x[:, 1]])
    dx = along_x[i] - along_x[j]
    dy = along_y[i] - along_y[j]
    near = xp.where(dx * dx + dy * dy <= radius * radius)[0]
    i = particle[i[near]]
    j = particle[j[near]]
    if self_edges:
        loops = [(kept << 32) | kept]
    else:
        loops = []
    return xp.concatenate([(i << 32) | j, (j << 32) | i, *loops])


def nearest_edges(
    x: NDArray[np.float64],
    window: NDArray[np.int64],
    radius: float,
    self_edges: bool,
    most: int,
) -> NDArray[np.int64]:
    """Return receiver * 2^32 + sender of every edge to one of the nearest ``most``
    within the radius.

    ``x`` are positions [length], shape [particle, 2], ``window`` the number of the
    window of each.
    """
    kept = np.flatnonzero(np.isfinite(x).all(axis=1))
    x = x[kept]
    window = window[kept]
    if not len(x):
        return np.empty(0, np.int64)
    # no two windows within the radius of each other
    apart = np.column_stack([x, 4.0 * radius * window])
    # itself is one of those found, but where more than that lie at its very place
    beyond = radius * (1.0 + MARGIN)
    _, found = KDTree(apart).query(
        apart, k=np.arange(1, min(most + 1, len(x)) + 1), distance_upper_bound=beyond
    )
    own = np.arange(len(x))[:, None]
    j = np.minimum(found, len(x) - 1)
    dx, dy = np.moveaxis(x[own] - x[j], -1, 0)
    near = (found < len(x)) & (found != own) & (dx * dx + dy * dy <= radius * radius)
    i, rank = np.nonzero(near & (near.cumsum(axis=1) <= most))
    if self_edges:
        loops = [(kept << 32) | kept]
    else:
        loops = []
    return np.concatenate([(kept[i] << 32) | kept[j[i, rank]], *loops])


MATERIALS = 4  # that datasets.yaml knows: 0 liquid, 1 jelly, 2 snow, 3 rope
EMBEDDING = 16  # numbers that a material is embedded in
EDGE_FEATURES = 3  # displacement over radius along x and y, distance over radius
_WALLS = 4  # left, right, bottom, top, the order of wall_velocity in scenario files


class Scale(nn.Module):
    """Standardisation by train statistics: ``(x - mean) / sqrt(std^2 + noise^2)``."""

    mean: Tensor  # mean over train, (x, y)
    std: Tensor  # standard deviation over train, (x, y)

    def __init__(
        self, mean: Sequence[float], std: Sequence[float], *, noise: float = 0.0
    ) -> None:
        super().__init__()
        widened = (torch.tensor(std, dtype=torch.float64) ** 2 + noise**2).sqrt()
        # Facts and options travel with the weights and rebuild these, unrounded by half
        # precision.
        self.register_buffer(
            "mean", torch.tensor(mean, dtype=torch.float32), persistent=False
        )
        self.register_buffer("std", widened.to(torch.float32), persistent=False)

    def forward(self, value: Tensor) -> Tensor:
        """Return the standardised value [1]."""
        return (value - self.mean) / self.std

    def inverse(self, standardised: Tensor) -> Tensor:
        """Return the value in its own unit."""
        return standardised * self.std + self.mean


def wall_distance(position: Tensor, bounds: Bounds, reach: float) -> Tensor:
    """Return the distances to left, right, bottom and top wall over the reach [length],
    clipped to [-1, 1].

    A wall farther away than the reach looks like one at it; outside the box they are
    negative.
    """
    (left, right), (bottom, top) = bounds
    x, y = position.unbind(dim=-1)
    distance = torch.stack([x - left, right - x, y - bottom, top - y], dim=-1)
    return (distance / reach).clamp(-1.0, 1.0)


def edge_features(position: Tensor, edge_index: Tensor, radius: float) -> Tensor:
    """Return ``((x_s - x_r) / radius, (y_s - y_r) / radius, distance / radius)``, shape
    [edge, 3].
    """
    sender, receiver = edge_index
    displacement = (
        position.index_select(0, sender) - position.index_select(0, receiver)
    ) / radius
    # The gradient of a norm is NaN at 0, where two particles coincide; that of this
    # root is 0.
    square = (displacement**2).sum(dim=-1, keepdim=True)
    distance = torch.where(square > 0.0, square, 1.0).sqrt() * (square > 0.0)
    return torch.cat([displacement, distance], dim=-1)


class NodeFeatures(nn.Module):
    """Features of a particle: 2 of each velocity, 4 of walls, 16 of material, 8 of
    moving walls if asked.

    The last velocities are shown as the last one and the changes that led to it, each
    over its own deviation: in velocities alone the changes, of which the next is to be
    predicted, are hundredths.

    Moving walls: the per-frame velocity of each wall over the velocity scale, times
    ``1 - distance / reach`` (0 beyond the reach), so that it acts where the wall is
    near.
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
        # whether the velocities of the walls are features too
        self.moving_walls = moving_walls
        self.embedding = nn.Embedding(MATERIALS, EMBEDDING)

    @property
    def count(self) -> int:
        """Features of one particle: with five velocities 30, or 38 with moving
        walls.
        """
        return 2 * self.velocities + _WALLS + EMBEDDING + 2 * _WALLS * self.moving_walls

    def forward(
        self,
        position: Tensor,
        velocity: Tensor,
        material: Tensor,
        wall_velocity: Tensor | None = None,
    ) -> Tensor:
        """Return the features of each particle, shape [particle, count].

        Velocities, oldest first, have shape [particle, velocities, 2]; those of the
        walls as each particle sees them shape [particle, 4, 2], and None counts as
        walls at rest.
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
