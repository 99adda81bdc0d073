"""EGNN: messages of distances, and forces along the ways between particles."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .equivariant import EquivariantNetwork, Particles, count_neighbours
from .graph import safe_length
from .network import EdgeMLP, LayeredNetwork, mlp
from .operators.operator import sum_edges


class EGNNLayer(nn.Module):
    r"""Equations 3 to 7 of Satorras et al. (2021), with every vector of a particle.

    .. math::

        m_{ij} &= \phi_e(h_i, h_j, \lVert x_i - x_j \rVert^2) \\
        h_i &\leftarrow h_i + \phi_h(h_i, \textstyle\sum_j m_{ij}) \\
        a_i &\leftarrow a_i + \textstyle\sum_k \phi_k(h_i) u_{ik}
            + \frac{1}{|N(i)|} \sum_j (x_i - x_j) \phi_x(m_{ij})
    """

    def __init__(self, latent: int, vectors: int) -> None:
        super().__init__()
        self.distance = nn.Linear(1, latent)
        self.message = EdgeMLP(latent, latent)
        self.force = mlp([latent, latent, 1], norm=False)
        self.share = mlp([latent, latent, vectors], norm=False)
        self.update = mlp([2 * latent, latent, latent])
        for last_layer in (self.force[-1], self.share[-1]):
            for parameter in last_layer.parameters():
                nn.init.zeros_(parameter)

    def forward(
        self,
        node: Tensor,
        particles: Particles,
        way: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return updated nodes, and the change of each acceleration [1].

        ``way`` leads from receiver to sender [radius], shape [edge, axis].
        """
        edge_index = particles.edge_index
        square = safe_length(way) ** 2
        message = self.message(self.distance(square), node, edge_index)
        force = sum_edges(edge_index, -way * self.force(message), len(node))
        force = force / count_neighbours(edge_index, node)
        messages = sum_edges(edge_index, message, len(node))
        node = node + self.update(torch.cat([node, messages], dim=1))
        own = self.share(node)[:, :, None] * particles.vector
        return node, own.sum(dim=1) + force


class EGNNLayers(LayeredNetwork):
    r"""Layers that also move the particles, by the velocity that they predict.

    .. math:: x_i \leftarrow x_i + (v_i + a_i) / L

    L is the number of layers. ``velocity`` and ``acceleration`` are the units of v and
    a [radius].
    """

    def __init__(
        self,
        *,
        scalars: int,
        vectors: int,
        latent: int,
        layers: int,
        velocity: float,
        acceleration: float,
    ) -> None:
        super().__init__()
        self.velocity = velocity
        self.acceleration = acceleration
        self.encoder = mlp([scalars, latent, latent])
        self.layers = nn.ModuleList()
        for _ in range(layers):
            self.layers.append(EGNNLayer(latent, vectors))

    def forward(self, particles: Particles) -> Tensor:
        """Return accelerations [1], shape [particle, axis]."""
        node = self.encoder(particles.scalar)
        last_velocity = particles.vector[:, 0]
        acceleration = torch.zeros_like(last_velocity)
        moved = torch.zeros_like(last_velocity)  # [radius]
        sender, receiver = particles.edge_index
        for layer in self.layers:
            way = particles.way + moved[sender] - moved[receiver]
            node, change = layer(node, particles, way)
            acceleration = acceleration + change
            velocity = self.velocity * last_velocity + self.acceleration * acceleration
            moved = moved + velocity / len(self.layers)
        return acceleration


class EGNN(EquivariantNetwork):
    """The equivariant graph network of Satorras, Hoogeboom and Welling (2021).

    Messages are normalised, as in the other graph networks. Force, obstacle and walls
    are vectors that turn with the particles (see :mod:`.equivariant`).
    """

    method = "EGNN"

    def _make_network(self) -> LayeredNetwork:
        """Return the network; untrained, it returns zeros."""
        return EGNNLayers(
            scalars=self.scalars,
            vectors=self.vectors,
            latent=self.options.latent,
            layers=self.options.layers,
            velocity=float(self.velocity.std[0]) / self.radius,
            acceleration=float(self.acceleration.std[0]) / self.radius,
        )
