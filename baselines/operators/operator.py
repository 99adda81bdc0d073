"""The contract of an operator: how a particle gathers what its neighbours tell it."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

__all__ = ["Losses", "Operator", "summed"]

Losses = Mapping[str, Tensor]  # losses of an operator's own by name, each a scalar


class Operator(nn.Module):
    """An aggregation; node MLP, LayerNorm and residual follow it in the network.

    Class attributes: method: what the board calls a graph network with this operator.
        weights: weight of each of its own losses in training. reads_nodes: whether it
        looks at the nodes; else they are not put beside the sums for it.

    Args:
        inputs: width of a node's input.
        latent: width of an edge and of what is gathered.
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
        """Return what each node gathers, and losses of its own if any.

        Args:
            node: latent of each particle, by default beside the sum of the updates of
                the edges that it receives, shape [particle, inputs].
            edge_index: senders and receivers, shape [2, edge].
            edge: update of each edge, shape [edge, latent].
            generator: source of random numbers; None asks for the same draw every time.

        Returns:
            What is gathered, shape [particle, latent]; losses by name.
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
        """Return what each node gathers."""
        return self.conv(node, edge_index, edge), {}


def summed(edge_index: Tensor, edge: Tensor, nodes: int) -> Tensor:
    """Return the sum of the edges that each node receives, shape [node, latent]."""
    return edge.new_zeros(nodes, edge.shape[1]).index_add_(0, edge_index[1], edge)
