"""Networks whose prediction turns and mirrors with the particles.

Such a network sees numbers that no rotation changes and vectors that turn with the
particles. Its output is a sum of vectors with coefficients of the numbers. Three parts
of a data set break the symmetry: walls, a force or an obstacle, and gravity. They enter
as vectors, so the prediction turns if they turn too. Where none of them acts, the
prediction turns with the particles alone.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from .baseline import DatasetInfo
from .deviations import root_mean_square
from .graph import EMBEDDING, Standardisation, edge_features, wall_distance
from .network import LayeredNetwork
from .operators.gns import GNS
from .operators.operator import Losses, Operator, sum_edges
from .simulator import GraphNetwork, GraphNetworkOptions, ParticleState


class Particles(NamedTuple):
    """Input of an equivariant network."""

    # material, obstacle, and products of all pairs of the vectors [1], which do not
    # turn; shape [particle, scalar]
    scalar: Tensor
    # the last velocity first [1], which turn; shape [particle, vector, axis]
    vector: Tensor
    edge_index: Tensor  # senders and receivers, int64, shape [2, edge]
    way: Tensor  # from receiver to sender [radius], shape [edge, axis]
    distance: Tensor  # length of the way [radius], shape [edge, 1]


class EquivariantNetwork(GraphNetwork):
    """A graph network of scalars and vectors; a model names its layers.

    The vectors of a particle are its last velocity, the changes that led to it, the
    sum of ``(1 - distance) n`` of near walls with their normals n, the velocities of
    near walls, force and obstacle, and one learnt vector for gravity, 0 at the start.
    All axes have the same scale, and no mean is taken off.
    """

    operator: ClassVar[type[Operator]] = GNS
    recipes = "recipes/particle-networks.yaml"
    layers: ClassVar[Callable[..., LayeredNetwork]]

    def __init__(self, options: GraphNetworkOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.gravity = nn.Parameter(torch.zeros(info.box.dimension))

    def _make_network(self) -> LayeredNetwork:
        """Return the network; untrained, it returns zeros."""
        return self.layers(
            scalars=self.scalars,
            vectors=self.vectors,
            latent=self.options.latent,
            layers=self.options.layers,
        )

    @property
    def vectors(self) -> int:
        """Vectors of a particle."""
        options = self.options
        forcing = options.body_force + options.obstacle
        return options.velocities + 2 + options.wall_velocity + forcing

    @property
    def scalars(self) -> int:
        """Scalars of a particle."""
        products = self.vectors * (self.vectors + 1) // 2
        return EMBEDDING + self.options.obstacle + products

    def _standardisation(self, name: str, *, noise: float) -> Standardisation:
        """Return one scale for all axes, and no mean."""
        std = root_mean_square(self.info.statistics[f"{name}_std"])
        axes = self.info.box.dimension
        return Standardisation([0.0] * axes, [std] * axes, noise=noise)

    def predict(
        self,
        state: ParticleState,
        edge_index: Tensor,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the standardised target [1], shape [particle, axis], and no losses."""
        edge = edge_features(state.position, edge_index, self.radius, self.box)
        vector, scalar = self._vectors(state)
        rows, columns = torch.triu_indices(*[vector.shape[1]] * 2)
        product = (vector[:, rows] * vector[:, columns]).sum(dim=2)
        # The root keeps products of large vectors, as of impacts, in their scale.
        product = product * (1.0 + product**2) ** -0.25
        material = self.features.embedding(state.material)
        scalar = torch.cat([material.to(product), scalar, product], dim=1)
        particles = Particles(scalar, vector, edge_index, edge[:, :-1], edge[:, -1:])
        return self.network(particles), {}

    def _vectors(self, state: ParticleState) -> tuple[Tensor, Tensor]:
        """Return the vectors of each particle, and the distance to an obstacle."""
        axes = self.info.box.dimension
        features = self.features
        last_velocity = self.velocity(state.velocity[:, -1:])
        changes = self.acceleration(state.velocity.diff(dim=1))
        distance = wall_distance(
            state.position, features.bounds, features.reach, features.periodic
        )
        low, high = distance.view(-1, axes, 2).unbind(dim=2)
        gravity = self.gravity.expand_as(low)
        vectors = [last_velocity, changes, (high - low)[:, None], gravity[:, None]]
        if self.options.wall_velocity:
            felt_velocity = torch.zeros_like(low)
            if state.wall_velocity is not None:
                wall_velocity = state.wall_velocity[:, 0][state.sample]
                nearness = 1.0 - distance.clamp(min=0.0)
                felt_velocity = (nearness[:, :, None] * wall_velocity).sum(dim=1)
            vectors.append(self.velocity(felt_velocity)[:, None])

        forcing = self._forcing_features(state)
        if self.options.body_force:
            vectors.append(forcing[:, None, :axes])
        scalar = forcing[:, :0]
        if self.options.obstacle:
            vectors.append(forcing[:, None, -axes:])
            scalar = forcing[:, -axes - 1 : -axes]
        return torch.cat(vectors, dim=1), scalar


class Norm(nn.Module):
    """A LayerNorm of scalars; vectors over the root mean square of their lengths.

    Vectors that are short beside 1 stay as they are. Without norms the products of
    vectors grow from layer to layer, as a particle has twenty neighbours.
    """

    def __init__(self, latent: int) -> None:
        super().__init__()
        self.scalar = nn.LayerNorm(latent)

    def forward(self, scalar: Tensor, vector: Tensor) -> tuple[Tensor, Tensor]:
        """Return scalars [row, latent] and vectors [row, latent, axis]."""
        square = (vector**2).sum(dim=2, keepdim=True).mean(dim=1, keepdim=True)
        return self.scalar(scalar), vector / (1.0 + square).sqrt()


def sum_vectors(edge_index: Tensor, edge: Tensor, nodes: int) -> Tensor:
    """Return the sum of the edges' vectors to each node, [node, channel, axis]."""
    sums = sum_edges(edge_index, edge.flatten(1), nodes)
    return sums.view(nodes, *edge.shape[1:])


def count_neighbours(edge_index: Tensor, node: Tensor) -> Tensor:
    """Return how many edges each node receives, at least 1; shape [node, 1]."""
    ones = node.new_ones(edge_index.shape[1], 1)
    return sum_edges(edge_index, ones, len(node)).clamp(min=1.0)
