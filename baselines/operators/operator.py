"""The contract of an operator: the node update of one processor layer."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import torch
from torch import Tensor, nn

__all__ = ["Losses", "Operator"]

Losses = Mapping[str, Tensor]
"""Losses of an operator's own by name, each a scalar."""


class Operator(nn.Module):
    """A node update; LayerNorm and residual follow it in the network.

    Class attributes:
        method: what the board calls a graph network with this operator.
        weights: weight of each of its own losses in training.

    Args:
        latent: width of a node and of an edge.
        hidden: width of hidden layers, if it has any.
    """

    method: ClassVar[str]
    weights: ClassVar[Mapping[str, float]] = {}

    def __init__(self, latent: int, hidden: int) -> None:
        super().__init__()
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
        """Return the update of each node, and losses of its own if any.

        Args:
            node: latent of each particle beside the sum of the updates of the edges that it
                receives, shape [particle, 2 latent].
            edge_index: senders and receivers, shape [2, edge].
            edge: update of each edge, shape [edge, latent].
            generator: source of random numbers; None asks for the same draw every time.

        Returns:
            Update, shape [particle, latent]; losses by name.
        """
