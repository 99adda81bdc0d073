"""Neighbour search, and the features of a graph network's nodes and edges.

A k-d tree of scipy finds every pair of particles within a radius, exactly, in float64
of the positions as they are stored; positions on a GPU make the way to the CPU.

A graph network sees motion, walls and material of a particle, and the places of its
neighbours. It sees differences of positions only, so that away from walls the features
do not change when one vector moves all particles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from lagbench.data.box import UNIT_SQUARE, Box
from lagbench.errors import UsageError
from lagbench.tensors import TensorBox

from .deviations import replace_zeros

Bounds = Sequence[tuple[float, float]]
"""Low and high end of the box along each axis."""


@torch.no_grad()
def radius_graph(
    position: Tensor,
    radius: float,
    sample: Tensor | None = None,
    *,
    box: Box = UNIT_SQUARE,
) -> Tensor:
    """Connect all pairs of particles within a radius, itself included.

    Return senders and receivers, int64, shape [2, edge]: both directions of every pair,
    sorted by receiver, then sender. Particles of different windows are never connected.
    Particles whose position is no finite number have no edges.

    Args:
        position: positions [length], shape [particle, axis].
        radius: connectivity radius [length].
        sample: window of each particle, ascending, shape [particle].
        box: box that holds the particles; across periodic axes the shortest distance
            counts.

    Raises:
        UsageError: shapes do not fit, or the radius is no positive number.
    """
    if position.shape[1:] != (box.dimension,) or not 0.0 < radius < math.inf:
        raise UsageError(
            f"positions of shape {tuple(position.shape)} and radius {radius}; expected "
            f"are [particle, {box.dimension}] and a length"
        )
    x = position.detach().double().cpu().numpy()
    window = np.zeros(len(x), np.int64)
    if sample is not None:
        window = sample.cpu().numpy()

    # receiver * 2^32 + sender of every edge
    edges = [np.empty(0, np.int64)]
    is_finite = np.isfinite(x).all(axis=1)
    for number in np.unique(window[is_finite]):
        members = np.flatnonzero(is_finite & (window == number))
        pairs = box.tree(x[members]).query_pairs(radius, output_type="ndarray")
        first, second = members[pairs].T
        edges += [(first << 32) | second, (second << 32) | first]
    sorted_edges = np.sort(np.concatenate(edges))
    numbers = torch.from_numpy(sorted_edges).to(position.device)
    return torch.stack([numbers & 0xFFFFFFFF, numbers >> 32])


MATERIALS = 4  # in datasets.yaml: 0 liquid, 1 jelly, 2 snow, 3 rope
EMBEDDING = 16  # numbers that a material is embedded in


class Standardisation(nn.Module):
    """Standardisation by train statistics: ``(x - mean) / sqrt(std^2 + noise^2)``.

    A component without a deviation has that of :func:`.deviations.replace_zeros`.
    """

    mean: Tensor  # mean over train, shape [axis]
    std: Tensor  # standard deviation over train, shape [axis]

    def __init__(
        self,
        mean: Sequence[float],
        std: Sequence[float],
        *,
        noise: float = 0.0,
    ) -> None:
        super().__init__()
        exact_std = torch.tensor(std, dtype=torch.float64)
        variance = exact_std**2 + noise**2
        deviations = replace_zeros(variance.sqrt().tolist())
        std_with_noise = torch.tensor(deviations, dtype=torch.float64)
        mean_tensor = torch.tensor(mean, dtype=torch.float32)
        std_tensor = std_with_noise.to(torch.float32)
        # Not in the files of weights, where half precision would round them: dataset
        # info and options rebuild them.
        self.register_buffer("mean", mean_tensor, persistent=False)
        self.register_buffer("std", std_tensor, persistent=False)

    def forward(self, value: Tensor) -> Tensor:
        """Return the standardised value [1]."""
        return (value - self.mean) / self.std

    def inverse(self, standardised: Tensor) -> Tensor:
        """Return the value in its own unit."""
        return standardised * self.std + self.mean


def wall_distance(
    position: Tensor,
    bounds: Bounds,
    reach: float,
    periodic: Sequence[bool] = (False, False, False),
) -> Tensor:
    """Return distances to the two walls of each axis over the reach [1].

    Those along x come first. A periodic axis has no walls, and they count as out of
    reach.

    They are clipped to [-1, 1]: a wall farther away than the reach looks like one at
    it; outside the box distances are negative. The shape is [..., wall].
    """
    distances = []
    components = position.unbind(dim=-1)
    for x, interval, is_periodic in zip(components, bounds, periodic, strict=False):
        low, high = interval
        if is_periodic:
            out_of_reach = torch.full_like(x, reach)
            distances += [out_of_reach, out_of_reach]
        else:
            distances += [x - low, high - x]
    distance = torch.stack(distances, dim=-1)
    relative_distance = distance / reach
    return relative_distance.clamp(-1.0, 1.0)


def edge_features(
    position: Tensor,
    edge_index: Tensor,
    radius: float,
    box: TensorBox,
) -> Tensor:
    """Return displacement and distance of each edge over the radius, [edge, axis + 1].

    The displacement is the way from receiver to sender.

    Args:
        position: positions [length], shape [particle, axis].
        edge_index: senders and receivers, int64, shape [2, edge].
        radius: connectivity radius [length].
        box: box that holds the particles.
    """
    sender, receiver = edge_index
    sender_position = position.index_select(0, sender)
    receiver_position = position.index_select(0, receiver)
    displacement = box.displacement(receiver_position, sender_position) / radius
    distance = safe_length(displacement)
    return torch.cat([displacement, distance], dim=-1)


def safe_length(vector: Tensor) -> Tensor:
    """Return the lengths of vectors, shape [..., 1] from [..., axis].

    The gradient of a norm is NaN at 0, where two particles coincide; here it is 0. The
    length of a vector with NaN is 0 too.
    """
    squares = vector**2
    square = squares.sum(dim=-1, keepdim=True)
    is_positive = square > 0.0
    radicand = torch.where(is_positive, square, 1.0)
    return radicand.sqrt() * is_positive


class NodeFeatures(nn.Module):
    """Features of a particle: velocities, walls, material, and moving walls if asked.

    In two dimensions there are 2 numbers of each velocity, 4 of walls, 16 of the
    material and 8 of moving walls. The velocities are the last one and the changes that
    led to it, each over its own deviation: in velocities alone the changes, of which
    the network predicts the next, are hundredths.

    Moving walls: the velocity per frame of each wall over the velocity's deviation,
    times ``1 - distance / reach`` (0 beyond the reach), so that it acts where the wall
    is near.
    """

    def __init__(
        self,
        bounds: Bounds,
        velocity: Standardisation,
        acceleration: Standardisation,
        reach: float,
        *,
        velocities: int = 5,
        moving_walls: bool = False,
        periodic: Sequence[bool] = (False, False, False),
        wall_particles: bool = False,
    ) -> None:
        super().__init__()
        self.dimension = len(bounds)
        self.periodic = tuple(periodic)  # axes without walls
        self.velocities = velocities  # number of last velocities per particle
        self.velocity = velocity
        self.acceleration = acceleration
        self.bounds = bounds  # of the box, (low, high) along each axis [length]
        self.reach = reach  # how far a particle sees a wall [length]
        self.moving_walls = moving_walls  # whether wall velocities are features too
        self.embedding = nn.Embedding(MATERIALS + wall_particles, EMBEDDING)

    @property
    def count(self) -> int:
        """Features of a particle: with five velocities 30, or 38 with moving walls."""
        axes = self.dimension
        walls = 2 * axes
        moving_wall_features = axes * walls * self.moving_walls
        return axes * self.velocities + walls + EMBEDDING + moving_wall_features

    def forward(
        self,
        position: Tensor,
        velocity: Tensor,
        material: Tensor,
        wall_velocity: Tensor | None = None,
    ) -> Tensor:
        """Return the features of each particle, shape [particle, count].

        Args:
            position: positions [length], shape [particle, axis].
            velocity: last velocities, oldest first, shape [particle, velocities, axis].
            material: material of each particle, shape [particle].
            wall_velocity: velocities of the walls in the window of each particle,
                shape [particle, wall, axis]; None stands for walls at rest.
        """
        last_velocity = self.velocity(velocity[:, -1])
        acceleration = velocity[:, 1:] - velocity[:, :-1]
        changes = self.acceleration(acceleration)
        distance = wall_distance(position, self.bounds, self.reach, self.periodic)
        embedded = self.embedding(material)
        embedded = embedded.to(position.dtype)
        parts = [last_velocity, changes.flatten(1), distance, embedded]
        if self.moving_walls:
            shape = (*distance.shape, self.dimension)
            felt_velocity = distance.new_zeros(shape)
            if wall_velocity is not None:
                nearness = 1.0 - distance.clamp(min=0.0)
                felt_velocity = nearness.unsqueeze(-1) * wall_velocity
                felt_velocity = felt_velocity / self.velocity.std
            parts.append(felt_velocity.flatten(1))
        return torch.cat(parts, dim=1)
