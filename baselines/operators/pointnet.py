"""PointNet: the largest response of a neighbourhood, feature by feature."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lagbench.baselines.layers import Linear, mlp

from .operator import Losses, Operator

__all__ = ["PointNet"]


class PointNet(Operator):
    r"""The set layer of PointNet++ (Qi et al. 2017) on edge updates.

    .. math::

        x_i' = \gamma\Bigl(\max_{j \in N(i) \cup \{i\}} h(x_j, m_{ij})\Bigr), \quad m_{ii} = 0

    with MLPs of one hidden layer; m_ij stands where PointNet++ has relative positions.
    """

    method = "GNS + PointNetConv"

    def __init__(self, latent: int, hidden: int) -> None:
        super().__init__(latent, hidden)
        self.of_node = Linear(2 * latent, hidden)
        self.of_edge = Linear(latent, hidden, bias=False)
        self.local = nn.Sequential(nn.ReLU(inplace=True), Linear(hidden, latent))
        self.whole = mlp([latent, hidden, latent], norm=False)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the update of each node."""
        sender, receiver = edge_index
        of_node = self.of_node(node)
        said = self.local(of_node.index_select(0, sender) + self.of_edge(edge))
        itself = self.local(of_node.clone())
        index = receiver[:, None].expand_as(said)
        return self.whole(itself.scatter_reduce(0, index, said, "amax")), {}
