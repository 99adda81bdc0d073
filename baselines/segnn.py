"""SEGNN: messages and updates steered by directions, up to degree 1."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from .equivariant import (
    EquivariantNetwork,
    Norm,
    Particles,
    count_neighbours,
    sum_vectors,
)
from .graph import safe_length
from .network import LayeredNetwork
from .operators.operator import sum_edges


class SteerableLinear(nn.Module):
    r"""A linear layer steered by an attribute :math:`(1, a)` of degrees 0 and 1.

    .. math::

        s' &= W_1 s + W_2 \langle v, a \rangle + b \\
        v' &= W_3 s \, a + W_4 v

    These are all paths of the Clebsch-Gordan product between scalars and vectors; that
    of two vectors to a pseudovector is left out.
    """

    def __init__(
        self, scalars: int, vectors: int, outputs: int, output_vectors: int
    ) -> None:
        super().__init__()
        self.scalar = nn.Linear(scalars + vectors, outputs)
        self.along = nn.Linear(scalars, output_vectors, bias=False)
        self.vector = nn.Linear(vectors, output_vectors, bias=False)

    def forward(
        self, scalar: Tensor, vector: Tensor, attribute: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return scalars [row, outputs] and vectors [row, output_vectors, axis]."""
        axis = attribute[:, None]
        product = (vector * axis).sum(dim=2)
        next_scalar = self.scalar(torch.cat([scalar, product], dim=1))
        own = self.vector(vector.transpose(1, 2)).transpose(1, 2)
        return next_scalar, own + self.along(scalar)[:, :, None] * axis


class Gated(nn.Module):
    """A steerable layer, SiLU of its scalars, and its vectors times gates."""

    def __init__(self, scalars: int, vectors: int, latent: int) -> None:
        super().__init__()
        self.linear = SteerableLinear(scalars, vectors, 2 * latent, latent)

    def forward(
        self, scalar: Tensor, vector: Tensor, attribute: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return scalars [row, latent] and vectors [row, latent, axis]."""
        both, vector = self.linear(scalar, vector, attribute)
        scalar, gate = both.chunk(2, dim=1)
        return silu(scalar), torch.sigmoid(gate)[:, :, None] * vector


class SEGNNLayer(nn.Module):
    r"""Equations 11 and 12 of Brandstetter et al. (2022).

    .. math::

        m_{ij} &= \phi_m(f_i, f_j, d_{ij}; a_{ij}) \\
        f_i &\leftarrow f_i + \phi_f(f_i, \textstyle\sum_j m_{ij}; a_i)

    Features and sums of messages are normalised (:class:`.equivariant.Norm`).
    """

    def __init__(self, latent: int) -> None:
        super().__init__()
        self.norm = Norm(latent)
        self.sum_norm = Norm(latent)
        self.first_message = Gated(2 * latent + 1, 2 * latent, latent)
        self.second_message = Gated(latent, latent, latent)
        self.first_update = Gated(2 * latent, 2 * latent, latent)
        self.second_update = SteerableLinear(latent, latent, latent, latent)

    def forward(
        self,
        scalar: Tensor,
        vector: Tensor,
        particles: Particles,
        edge_attribute: Tensor,
        node_attribute: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return updated scalars [node, latent] and vectors [node, latent, axis]."""
        edge_index = particles.edge_index
        sender, receiver = edge_index
        own, own_vector = self.norm(scalar, vector)
        ends = torch.cat([own[receiver], own[sender], particles.distance], dim=1)
        end_vectors = torch.cat([own_vector[receiver], own_vector[sender]], dim=1)
        message = self.first_message(ends, end_vectors, edge_attribute)
        message_scalar, message_vector = self.second_message(*message, edge_attribute)

        nodes = len(scalar)
        scalar_sum = sum_edges(edge_index, message_scalar, nodes)
        vector_sum = sum_vectors(edge_index, message_vector, nodes)
        scalar_sum, vector_sum = self.sum_norm(scalar_sum, vector_sum)
        both = torch.cat([own, scalar_sum], dim=1)
        both_vectors = torch.cat([own_vector, vector_sum], dim=1)
        hidden = self.first_update(both, both_vectors, node_attribute)
        change, vector_change = self.second_update(*hidden, node_attribute)
        return scalar + change, vector + vector_change


class SEGNNLayers(LayeredNetwork):
    """A steerable encoder, layers, and one vector of each particle."""

    def __init__(self, *, scalars: int, vectors: int, latent: int, layers: int) -> None:
        super().__init__()
        self.encoder = SteerableLinear(scalars, vectors, latent, latent)
        self.layers = nn.ModuleList()
        for _ in range(layers):
            self.layers.append(SEGNNLayer(latent))
        self.norm = Norm(latent)
        self.hidden = Gated(latent, latent, latent)
        self.decoder = nn.Linear(latent, 1, bias=False)
        nn.init.zeros_(self.decoder.weight)

    def forward(self, particles: Particles) -> Tensor:
        """Return vectors [1], shape [particle, axis]."""
        edge_index = particles.edge_index
        edge_attribute = particles.way / particles.distance.clamp(min=1e-6)
        nodes = len(particles.scalar)
        # The mean direction of the neighbours, and that of the velocity.
        mean = sum_edges(edge_index, edge_attribute, nodes)
        mean = mean / count_neighbours(edge_index, particles.scalar)
        velocity = particles.vector[:, 0]
        node_attribute = mean + velocity / safe_length(velocity).clamp(min=1e-6)

        scalar, vector = self.encoder(
            particles.scalar, particles.vector, node_attribute
        )
        for layer in self.layers:
            scalar, vector = layer(
                scalar, vector, particles, edge_attribute, node_attribute
            )
        scalar, vector = self.norm(scalar, vector)
        _, vector = self.hidden(scalar, vector, node_attribute)
        output: Tensor = self.decoder(vector.transpose(1, 2)).squeeze(2)
        return output


class SEGNN(EquivariantNetwork):
    """The steerable graph network of Brandstetter et al. (2022), of degree 1.

    The attribute of an edge is its direction, that of a particle the mean of them plus
    the direction of its velocity. Degree 1 needs no table of Clebsch-Gordan
    coefficients: a layer is that of e3nn (see the tests) with two components in two
    dimensions.
    """

    method = "SEGNN"
    layers = SEGNNLayers
