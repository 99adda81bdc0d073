"""CoRGI: GNS with convolutions on a grid beside its layers."""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import Field
from torch import Tensor

from .baseline import DatasetInfo
from .graph import edge_features
from .network import EncodeProcessDecode
from .operators.gns import GNS
from .operators.operator import Losses, Operator
from .particle_grid import ParticleGrid, Stencil
from .simulator import GraphNetwork, GraphNetworkOptions, ParticleState
from .unet import NODES_PER_COARSE_NODE, UNet


class GridOptions(GraphNetworkOptions):
    """Options of a graph network and of a grid."""

    of_weights = GraphNetworkOptions.of_weights | {"cells"}

    cells: int = Field(default=16, ge=4)  # cells of the grid across the box


class CoRGI(GraphNetwork):
    r"""GNS with convolutional residual global interactions (Ji et al. 2025).

    .. math::

        x_i &= \mathrm{GNS}(x^0)_i + G(\mathrm{CNN}(\bar x))_i \\
        \bar x_n &= \textstyle\sum_i b_{ni} x^0_i / \sum_i b_{ni}

    The encoded particles x^0 are averaged at the nodes n of a grid by quadratic
    B-splines b; G takes the nodes' features back to the particles. The CNN is the U-Net
    of NeuralMPM, whose output starts at 0: an untrained CoRGI is GNS. Source: arXiv
    2511.22938; grid, splines and widths are ours.
    """

    method = "CoRGI"
    operator: ClassVar[type[Operator]] = GNS
    recipes = "recipes/particle-networks.yaml"
    Options = GridOptions
    options: GridOptions
    network: EncodeProcessDecode

    def __init__(self, options: GridOptions, info: DatasetInfo) -> None:
        super().__init__(options, info)
        periodic = info.box.periodic
        self.nodes = ParticleGrid(
            info.bounds,
            options.cells,
            multiple=NODES_PER_COARSE_NODE,
            periodic=periodic,
        )
        width = 4 * max(1, options.latent // 8)  # groups of the norms divide it
        self.convolutions = UNet(options.latent + 1, options.latent, width, periodic)

    def predict(
        self,
        state: ParticleState,
        edge_index: Tensor,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the standardised target [1], shape [particle, axis], and no losses."""
        network = self.network
        encoded = network.node_encoder(self._node_features(state))
        edge = edge_features(state.position, edge_index, self.radius, self.box)
        edge = network.edge_encoder(edge)
        node = encoded
        for layer in network.processor:
            node, edge, _ = layer(node, edge_index, edge)

        stencil = self.nodes.stencil(state.position, state.sample)
        field = mean_at_nodes(self.nodes, stencil, encoded, int(state.sample[-1]) + 1)
        felt = self.nodes.gather(stencil, self.convolutions(field))
        return network.decoder(node + felt), {}


def mean_at_nodes(
    grid: ParticleGrid, stencil: Stencil, value: Tensor, windows: int
) -> Tensor:
    """Return the particles' mean values at the nodes, and their share of matter [1].

    The share is that of the mean node around a particle. Without matter both are 0.

    Returns:
        Shape [window, channel + 1, x node, y node], or with z nodes.
    """
    with_mass = torch.cat([value, torch.ones_like(value[:, :1])], dim=1)
    sums = grid.spread(stencil, with_mass, windows)
    mass = sums[:, -1:]
    axes = tuple(range(1, mass.ndim))
    full = (mass**2).sum(axes, keepdim=True) / mass.sum(axes, keepdim=True)
    # Far nodes of a spline have little matter, and no less of its mean.
    mean = sums[:, :-1] / mass.clamp(min=1e-6)
    return torch.cat([mean, mass / full], dim=1)
