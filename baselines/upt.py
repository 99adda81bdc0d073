"""UPT: a transformer over supernodes of the whole box."""

from __future__ import annotations

import math
from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor, nn

from .corgi import GridOptions, mean_at_nodes
from .network import LayeredNetwork, mlp
from .operators.gns import GNS
from .operators.operator import Losses, Operator
from .particle_grid import ParticleGrid
from .simulator import GraphNetwork, ParticleState

WAVES = 4  # of the code of a position, along each axis


class UPTOptions(GridOptions):
    """Options of a universal physics transformer."""

    of_weights = GridOptions.of_weights | {"heads"}

    cells: int = Field(default=8, ge=4)  # cells of supernodes across the box
    heads: int = Field(default=4, ge=1)  # of attention; they divide model.latent


class UPTLayers(LayeredNetwork):
    r"""Encoder, approximator and decoder.

    .. math::

        q_i &= \phi(h_i, p(x_i)), \quad
            z_n = W [\textstyle\sum_i b_{ni} q_i / \sum_i b_{ni}, p(x_n)] \\
        z &\leftarrow \mathrm{Transformer}(z) \\
        y_i &= \psi(q_i + \mathrm{Attention}(q_i, z))

    h are the features of particles, b the splines of the supernodes n, p sines and
    cosines of a position.
    """

    def __init__(
        self,
        grid: ParticleGrid,
        *,
        features: int,
        latent: int,
        layers: int,
        heads: int,
    ) -> None:
        super().__init__()
        self.grid = grid
        codes = 2 * WAVES * grid.dimension
        self.encoder = mlp([features + codes, latent, latent])
        self.supernode = nn.Linear(latent + 1 + codes, latent)
        self.layers = nn.ModuleList()
        for _ in range(layers):
            layer = nn.TransformerEncoderLayer(
                latent,
                heads,
                2 * latent,
                dropout=0.0,
                activation="gelu",
                batch_first=True,
                norm_first=True,
            )
            self.layers.append(layer)
        self.norm = nn.LayerNorm(latent)
        self.attention = nn.MultiheadAttention(latent, heads, batch_first=True)
        self.decoder = mlp([latent, latent, latent, grid.dimension], norm=False)
        for parameter in self.decoder[-1].parameters():
            nn.init.zeros_(parameter)

    def forward(self, feature: Tensor, position: Tensor, sample: Tensor) -> Tensor:
        """Return the output of each particle, shape [particle, axis]."""
        code = self._encode(position)
        query = self.encoder(torch.cat([feature, code], dim=1))

        windows = int(sample[-1]) + 1
        stencil = self.grid.stencil(position, sample)
        field = mean_at_nodes(self.grid, stencil, query, windows)
        places = torch.cartesian_prod(*self.grid.axes)
        node_code = self._encode(places).expand(windows, -1, -1)
        by_node = field.flatten(2).transpose(1, 2)
        latents = self.supernode(torch.cat([by_node, node_code], dim=2))
        for layer in self.layers:
            latents = layer(latents)
        latents = self.norm(latents)

        counts = torch.bincount(sample).tolist()
        felt = []
        for own, latent in zip(query.split(counts), latents, strict=True):
            answer, _ = self.attention(own, latent, latent, need_weights=False)
            felt.append(answer)
        output: Tensor = self.decoder(query + torch.cat(felt))
        return output

    def _encode(self, position: Tensor) -> Tensor:
        """Return sines and cosines of positions in the box, shape [place, code].

        The longest wave is twice the side of the box, or the period.
        """
        waves = []
        for axis, (low, high) in enumerate(self.grid.bounds):
            longest = (2 - self.grid.periodic[axis]) * (high - low)
            numbers = 2.0 ** torch.arange(WAVES, device=position.device)
            place = (position[:, axis, None] - low) / longest
            phase = 2.0 * math.pi * numbers * place
            waves += [phase.sin(), phase.cos()]
        return torch.cat(waves, dim=1).to(position.dtype)


class UPT(GraphNetwork):
    """A universal physics transformer (Alkin et al. 2024) without a latent rollout.

    The supernodes are the nodes of a coarse grid, which take the mean of the particles
    around them, instead of particles that are drawn: so the order of particles has no
    effect. There is no graph and no pooling of supernodes, and every frame is encoded
    anew. Positions are those in the box: the prediction moves with particles and box
    together, and turns with nothing.
    """

    method = "UPT"
    operator: ClassVar[type[Operator]] = GNS
    recipes = "recipes/particle-networks.yaml"
    Options = UPTOptions
    options: UPTOptions

    def _make_network(self) -> LayeredNetwork:
        """Return the network; untrained, it returns zeros."""
        grid = ParticleGrid(
            self.info.bounds, self.options.cells, periodic=self.info.box.periodic
        )
        return UPTLayers(
            grid,
            features=self.features.count + self.forcing.count,
            latent=self.options.latent,
            layers=self.options.layers,
            heads=self.options.heads,
        )

    def find_edges(self, state: ParticleState) -> Tensor:
        """Return no edges: the network has no graph."""
        return torch.empty(2, 0, dtype=torch.int64, device=state.position.device)

    def predict(
        self,
        state: ParticleState,
        edge_index: Tensor,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the standardised target [1], shape [particle, axis], and no losses."""
        features = self._node_features(state)
        return self.network(features, state.position, state.sample), {}
