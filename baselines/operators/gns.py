"""GNS: the sum of a node's messages."""

from __future__ import annotations

import torch
from torch import Tensor

from .operator import Losses, Operator, sum_edges


class GNS(Operator):
    r"""The interaction network of Sanchez-Gonzalez et al. (2020).

    .. math:: a_i = \sum_j m_{ij}

    With the network's node MLP:
    :math:`x_i' = \mathrm{MLP}([x_i \Vert \textstyle\sum_j m_{ij}])`.
    """

    method = "GNS"
    reads_nodes = False

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the aggregate of each node."""
        return sum_edges(edge_index, edge, len(node)), {}
