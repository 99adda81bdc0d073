"""GNS: an MLP of a node and the sum of its messages."""

from __future__ import annotations

import torch
from torch import Tensor

from lagbench.baselines.layers import mlp

from .operator import Losses, Operator

__all__ = ["GNS"]


class GNS(Operator):
    r"""The interaction network of Sanchez-Gonzalez et al. (2020).

    .. math:: x_i' = \mathrm{MLP}([x_i \Vert \textstyle\sum_j m_{ij}])
    """

    method = "GNS"

    def __init__(self, latent: int, hidden: int) -> None:
        super().__init__(latent, hidden)
        self.update = mlp([2 * latent, hidden, hidden, latent], norm=False)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the update of each node."""
        return self.update(node), {}
