"""What a graph network sees: motion, walls and material of a particle, its neighbours' places.

Positions enter only as differences, so that away from walls the features do not change when
all particles move by the same vector.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .facts import Facts, Pair

__all__ = [
    "EDGE_FEATURES",
    "MATERIALS",
    "VELOCITIES",
    "NodeFeatures",
    "Scale",
    "edge_features",
    "wall_distance",
]

VELOCITIES = 5
"""Per-frame velocities that a particle shows, the last ones; they need one more position."""

MATERIALS = 4
"""Liquid, jelly, snow, rope."""

EMBEDDING = 16
"""Numbers that a material is embedded in."""

EDGE_FEATURES = 3
"""Displacement over radius along x and y, distance over radius."""

_WALLS = 4  # left, right, bottom, top, the order of wall_velocity in scenario files


class Scale(nn.Module):
    """Standardisation by train statistics: ``(x - mean) / sqrt(std^2 + noise^2)``.

    Args:
        mean: mean over train, (x, y).
        std: standard deviation over train, (x, y).
        noise: standard deviation of the noise added in training, same unit; it widens the data.
    """

    mean: Tensor
    std: Tensor

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


def wall_distance(position: Tensor, bounds: tuple[Pair, Pair], radius: float) -> Tensor:
    """Return the distances to the four walls over the radius, clipped to [-1, 1].

    Args:
        position: particle positions [length], shape [particle, 2].
        bounds: box (low, high) along x and y [length].
        radius: connectivity radius [length]; a wall farther away than it looks like one at it.

    Returns:
        Left, right, bottom, top; negative outside the box; shape [particle, 4].
    """
    (left, right), (bottom, top) = bounds
    x, y = position.unbind(dim=-1)
    distance = torch.stack([x - left, right - x, y - bottom, top - y], dim=-1)
    return (distance / radius).clamp(-1.0, 1.0)


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
    """Features of a particle: 10 of motion, 4 of walls, 16 of material, 8 of moving walls if asked.

    Moving walls: the per-frame velocity of each wall over the velocity scale, times
    ``1 - distance / radius`` (0 beyond the radius), so that it acts where the wall is near.

    Args:
        facts: public figures of the data set.
        velocity: standardisation of per-frame velocities.
        radius: connectivity radius [length].
        moving_walls: whether the velocities of the walls are features too.
    """

    def __init__(self, facts: Facts, velocity: Scale, radius: float, *, moving_walls: bool = False) -> None:
        super().__init__()
        self.velocity = velocity
        self.bounds = facts.bounds
        self.radius = radius
        self.moving_walls = moving_walls
        self.embedding = nn.Embedding(MATERIALS, EMBEDDING)

    @property
    def count(self) -> int:
        """Features of one particle: 30, or 38 with moving walls."""
        return 2 * VELOCITIES + _WALLS + EMBEDDING + 2 * _WALLS * self.moving_walls

    def forward(
        self, position: Tensor, velocity: Tensor, material: Tensor, wall_velocity: Tensor | None = None
    ) -> Tensor:
        """Return the features of each particle, shape [particle, count].

        Args:
            position: last positions [length], shape [particle, 2].
            velocity: last velocities, oldest first [length/frame], shape [particle, 5, 2].
            material: material of each particle, int64, shape [particle].
            wall_velocity: velocity of the walls as each particle sees them [length/frame], shape
                [particle, 4, 2]; None counts as walls at rest.
        """
        distance = wall_distance(position, self.bounds, self.radius)
        parts = [self.velocity(velocity).flatten(1), distance, self.embedding(material).to(position.dtype)]
        if self.moving_walls:
            parts.append(self._near_walls(distance, wall_velocity).flatten(1))
        return torch.cat(parts, dim=1)

    def _near_walls(self, distance: Tensor, wall_velocity: Tensor | None) -> Tensor:
        """Return the walls' velocities, faded out over the radius [1], shape [particle, 4, 2]."""
        if wall_velocity is None:
            return distance.new_zeros(len(distance), _WALLS, 2)
        nearness = 1.0 - distance.clamp(min=0.0)
        return nearness.unsqueeze(-1) * wall_velocity / self.velocity.std
