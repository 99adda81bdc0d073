"""PaiNN: scalars and vectors that exchange messages through filters of distance."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from .equivariant import EquivariantNetwork, Norm, Particles, sum_vectors
from .graph import safe_length
from .network import LayeredNetwork
from .operators.operator import sum_edges

BASIS = 20  # radial functions


def radial_basis(distance: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return :math:`\sin(n \pi d) / d` and the cutoff, shapes [edge, 20], [edge, 1].

    The distance d is over the radius, shape [edge, 1]. The cutoff falls from 1 at 0 to
    0 at 1: :math:`(\cos(\pi d) + 1) / 2`.
    """
    numbers = torch.arange(1, BASIS + 1, device=distance.device)
    basis = math.pi * numbers * torch.sinc(numbers * distance)
    cutoff = (torch.cos(math.pi * distance) + 1.0) / 2.0
    return basis, cutoff


class PaiNNLayer(nn.Module):
    r"""A message and an update block, Eqs. 7 to 9 of Schütt et al. (2021).

    .. math::

        s_i &\leftarrow s_i + \textstyle\sum_j \phi_s(s_j) W_s(d_{ij}) \\
        v_i &\leftarrow v_i + \textstyle\sum_j v_j \phi_v(s_j) W_v(d_{ij})
            + \phi_r(s_j) W_r(d_{ij}) r_{ij} / d_{ij} \\
        v_i &\leftarrow v_i + a_v(s_i, \lVert V v_i \rVert) U v_i \\
        s_i &\leftarrow s_i + a_s(s_i, \lVert V v_i \rVert)
            + a_{sv}(s_i, \lVert V v_i \rVert) \langle U v_i, V v_i \rangle

    Scalars and vectors are normalised before each block (:class:`.equivariant.Norm`).
    """

    def __init__(self, latent: int) -> None:
        super().__init__()
        self.norm = Norm(latent)
        self.filter = nn.Linear(BASIS, 3 * latent)
        self.message = two_layers(latent, latent, 3 * latent)
        self.update_norm = Norm(latent)
        self.mix = nn.Linear(latent, 2 * latent, bias=False)
        self.update = two_layers(2 * latent, latent, 3 * latent)

    def forward(
        self,
        scalar: Tensor,
        vector: Tensor,
        particles: Particles,
        basis: Tensor,
        cutoff: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return updated scalars [node, latent] and vectors [node, latent, axis]."""
        edge_index = particles.edge_index
        sender = edge_index[0]
        nodes = len(scalar)
        own_scalar, own_vector = self.norm(scalar, vector)
        message = self.message(own_scalar)[sender]
        message = message * self.filter(basis) * cutoff
        of_scalar, of_vector, of_way = message.chunk(3, dim=1)
        direction = particles.way / particles.distance.clamp(min=1e-6)
        edge_vector = of_vector[:, :, None] * own_vector[sender]
        edge_vector = edge_vector + of_way[:, :, None] * direction[:, None]
        scalar = scalar + sum_edges(edge_index, of_scalar, nodes)
        vector = vector + sum_vectors(edge_index, edge_vector, nodes)

        own_scalar, own_vector = self.update_norm(scalar, vector)
        mixed = self.mix(own_vector.transpose(1, 2)).transpose(1, 2)
        u, v = mixed.chunk(2, dim=1)
        length = safe_length(v).squeeze(2)
        gates = self.update(torch.cat([own_scalar, length], dim=1))
        own, product, scale = gates.chunk(3, dim=1)
        scalar = scalar + own + product * (u * v).sum(dim=2)
        vector = vector + scale[:, :, None] * u
        return scalar, vector


def two_layers(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Return two linear layers with SiLU between them."""
    return nn.Sequential(
        nn.Linear(inputs, hidden), nn.SiLU(), nn.Linear(hidden, outputs)
    )


class PaiNNLayers(LayeredNetwork):
    """Scalars and vectors of the input, layers, and one vector of each particle."""

    def __init__(self, *, scalars: int, vectors: int, latent: int, layers: int) -> None:
        super().__init__()
        self.scalar_encoder = two_layers(scalars, latent, latent)
        self.vector_encoder = nn.Linear(vectors, latent, bias=False)
        self.layers = nn.ModuleList()
        for _ in range(layers):
            self.layers.append(PaiNNLayer(latent))
        self.decoder = nn.Linear(latent, 1, bias=False)
        nn.init.zeros_(self.decoder.weight)

    def forward(self, particles: Particles) -> Tensor:
        """Return vectors [1], shape [particle, axis]."""
        scalar = self.scalar_encoder(particles.scalar)
        by_axis = self.vector_encoder(particles.vector.transpose(1, 2))
        vector = by_axis.transpose(1, 2)
        basis, cutoff = radial_basis(particles.distance)
        for layer in self.layers:
            scalar, vector = layer(scalar, vector, particles, basis, cutoff)
        output: Tensor = self.decoder(vector.transpose(1, 2)).squeeze(2)
        return output


class PaiNN(EquivariantNetwork):
    """The polarizable atom interaction network of Schütt, Unke and Gastegger (2021).

    Its vectors start from those of the particle instead of 0 (see
    :mod:`.equivariant`), and its output is a mixture of them.
    """

    method = "PaiNN"
    layers = PaiNNLayers
