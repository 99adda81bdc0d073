"""Transformer: scaled dot-product attention with edges in keys and values."""

from __future__ import annotations

import torch
from torch import Tensor
from torch_geometric.nn import TransformerConv

from .operator import Losses, Operator


class Transformer(Operator):
    r"""The graph transformer of Shi et al. (2021): PyG's TransformerConv.

    .. math::

        a_i &= W_1 s_i + \sum_{j \in N(i)} \alpha_{ij} (W_2 s_j + W_5 m_{ij}) \\
        \alpha_{ij} &= \mathrm{softmax}_j
            \frac{(W_3 s_i)^T (W_4 s_j + W_5 m_{ij})}{\sqrt{d}}
    """

    method = "GNS + TransformerConv"

    def __init__(self, inputs: int, latent: int, hidden: int) -> None:
        super().__init__(inputs, latent, hidden)
        self.conv = TransformerConv(inputs, latent, edge_dim=latent)

    def forward(
        self, node: Tensor, edge_index: Tensor, edge: Tensor, *, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Losses]:
        """Return what each node gathers."""
        return self.conv(node, edge_index, edge), {}
