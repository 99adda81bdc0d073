"""The contract of an operator: how a node aggregates the messages of its edges."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

__all__ = ["Losses", "Operator", "sum_edges"]

Losses = Mapping[str, Tensor]  # losses of an operator's own by name, each a scalar


class Operator(nn.Module):
    """An aggregation; node MLP, LayerNorm and residual follow it in the network.

    Class attributes:
        method: name of a graph network with this operator on the board.
        weights: weight of each of its own losses in training.
        reads_nodes: whether it reads the nodes; else the network does not sum the
            messages for it.

    Args:
        inputs: width of a node's input.
        latent: width of an edge and of the aggregate.
        hidden: width of hidden layers, if it has any.
    """

    method: ClassVar[str]
    weights: ClassVar[Mapping[str, float]] = {}
    reads_nodes: ClassVar[bool] = True

    def __init__(self, inputs: int, latent: int, hidden: int) -> None:
        super().__init__()
        self.inputs = inputs
        self.latent = latent
        self.hidden = hidden

    @abstractmethod
    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the aggregate of each node, and losses of the operator if any.

        Args:
            node: latent of each particle, by default beside the sum of the updates of
                the edges that it receives, shape [particle, inputs].
            edge_index: senders and receivers, shape [2, edge].
            edge: update of each edge, shape [edge, latent].
            generator: source of random numbers; None asks for the same draw every time.

        Returns:
            Aggregates, shape [particle, latent], and losses by name.
        """


class Convolution(Operator):
    """A convolution of PyTorch Geometric that takes edge features."""

    layer: ClassVar[Callable[..., nn.Module]]

    def __init__(self, inputs: int, latent: int, hidden: int) -> None:
        super().__init__(inputs, latent, hidden)
        self.conv = self.layer(inputs, latent, edge_dim=latent)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the aggregate of each node."""
        return self.conv(node, edge_index, edge), {}


def sum_edges(edge_index: Tensor, edge: Tensor, nodes: int) -> Tensor:
    """Return the sum of the edges to each node, shape [node, latent]."""
    _, receiver = edge_index
    sums = edge.new_zeros(nodes, edge.shape[1])
    return sums.index_add_(0, receiver, edge)
