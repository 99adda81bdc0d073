"""Transformer: scaled dot-product attention with edges in keys and values."""

from __future__ import annotations

import torch
from torch import Tensor
from torch_geometric.nn import TransformerConv

from .operator import Losses, Operator

__all__ = ["Transformer"]


class Transformer(Operator):
    r"""The graph transformer of Shi et al. (2021): PyG's TransformerConv.

    .. math::

        x_i' &= W_1 x_i + \sum_{j \in N(i)} \alpha_{ij} (W_2 x_j + W_5 m_{ij}) \\
        \alpha_{ij} &= \mathrm{softmax}_j
            \frac{(W_3 x_i)^T (W_4 x_j + W_5 m_{ij})}{\sqrt{d}}
    """

    method = "GNS + TransformerConv"

    def __init__(self, latent: int, hidden: int) -> None:
        super().__init__(latent, hidden)
        self.conv = TransformerConv(2 * latent, latent, edge_dim=latent)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the update of each node."""
        return self.conv(node, edge_index, edge), {}
