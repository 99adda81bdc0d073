"""Transformer: scaled dot-product attention with edges in keys and values."""

from __future__ import annotations

from torch_geometric.nn import TransformerConv

from .operator import Convolution


class Transformer(Convolution):
    r"""The graph transformer of Shi et al. (2021): PyG's TransformerConv.

    .. math::

        a_i &= W_1 s_i + \sum_{j \in N(i)} \alpha_{ij} (W_2 s_j + W_5 m_{ij}) \\
        \alpha_{ij} &= \mathrm{softmax}_j
            \frac{(W_3 s_i)^T (W_4 s_j + W_5 m_{ij})}{\sqrt{d}}
    """

    method = "GNS + TransformerConv"
    layer = TransformerConv
