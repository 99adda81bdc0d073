"""PointNet: the largest response of a neighbourhood, feature by feature."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .operator import Losses, Operator


class PointNet(Operator):
    r"""The set layer of PointNet++ (Qi et al. 2017) on edge updates.

    .. math:: a_i = \max_{j \in N(i) \cup \{i\}} h(s_j, m_{ij}), \quad m_{ii} = 0

    h is an MLP of one hidden layer; m_ij stands where PointNet++ has relative
    positions, the network's node MLP where it has its second MLP.
    """

    method = "GNS + PointNetConv"

    def __init__(self, inputs: int, latent: int, hidden: int) -> None:
        super().__init__(inputs, latent, hidden)
        self.of_node = nn.Linear(inputs, hidden)
        self.of_edge = nn.Linear(latent, hidden, bias=False)
        output = nn.Linear(hidden, latent)
        self.local = nn.Sequential(nn.ReLU(inplace=True), output)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the aggregate of each node."""
        sender, receiver = edge_index
        hidden_node = self.of_node(node)
        hidden_sender = hidden_node.index_select(0, sender)
        hidden_edge = hidden_sender + self.of_edge(edge)
        message = self.local(hidden_edge)
        # The layer works in place, and the loop of a node starts from the same values.
        loop_message = self.local(hidden_node.clone())

        index = receiver[:, None].expand_as(message)
        return loop_message.scatter_reduce(0, index, message, "amax"), {}
