"""SuperGAT: attention that also learns which particles are neighbours."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor
from torch_geometric.nn import SuperGATConv

from .operator import Losses, Operator

__all__ = ["SuperGAT", "SuperGATDot", "SuperGATLink", "unlinked_pairs"]


START = 4.0
"""Where links are learnt, Theta starts smaller than Glorot's by this times the root of its width.

Logits of links then start near 1, not near 2000, where the sigmoid is flat and the link loss
drowns the others; the scale of values is the LayerNorm's, which follows.
"""


def unlinked_pairs(
    edge_index: Tensor, nodes: int, count: int, generator: torch.Generator | None = None
) -> Tensor:
    """Draw pairs of nodes without an edge, at most `count`.

    Args:
        edge_index: senders and receivers, shape [2, edge].
        nodes: nodes of the graph.
        count: pairs to draw; those that are an edge or a loop are dropped.
        generator: source; None draws the same pairs every time.

    Returns:
        Senders and receivers, shape [2, pair].
    """
    source = torch.Generator().manual_seed(0) if generator is None else generator
    pairs = torch.randint(nodes, (2, count), generator=source, device=source.device)
    pairs = pairs.to(edge_index.device)
    sender, receiver = pairs
    linked = torch.isin(receiver * nodes + sender, edge_index[1] * nodes + edge_index[0])
    return pairs[:, ~linked & (sender != receiver)]


class SuperGAT(Operator):
    r"""Self-supervised graph attention of Kim and Oh (2021): PyG's SuperGATConv, MX.

    .. math::

        x_i' &= \sum_{j \in N(i) \cup \{i\}} \alpha_{ij} \Theta x_j \\
        \alpha_{ij} &= \mathrm{softmax}_j\,\mathrm{LeakyReLU}(
            a^T [\Theta x_i \Vert \Theta x_j] \cdot \sigma((\Theta x_i)^T \Theta x_j))

    Source: Eqs. 5.26 and 5.27. Its link prediction (Eq. 5.28) is not trained: Eq. 5.35 has no
    such term. :class:`SuperGATLink` trains it.
    """

    method = "GNS + SuperGATConv"
    attention: ClassVar[str] = "MX"
    negatives: ClassVar[float] = 0.5
    """Unlinked pairs drawn for each edge."""

    def __init__(self, latent: int, hidden: int) -> None:
        super().__init__(latent, hidden)
        self.conv = SuperGATConv(2 * latent, latent, attention_type=self.attention)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the update of each node, and the link loss while it is trained."""
        if not (self.training and "link" in self.weights):
            self.conv.training = False  # PyG would draw pairs from Python's global source.
            return self.conv(node, edge_index), {}
        self.conv.training = True
        count = int(self.negatives * edge_index.shape[1])
        pairs = unlinked_pairs(edge_index, len(node), count, generator)
        update = self.conv(node, edge_index, pairs)
        loss = self.conv.get_attention_loss()
        self.conv.att_x = self.conv.att_y = None  # They would hold the whole graph of gradients.
        return update, {"link": loss}


class SuperGATDot(SuperGAT):
    r"""SuperGAT whose attention is the scaled dot product, SD.

    .. math:: \alpha_{ij} = \mathrm{softmax}_j\,\mathrm{LeakyReLU}((\Theta x_i)^T \Theta x_j / \sqrt{d})
    """

    method = "GNS + SuperGATConv (SD)"
    attention = "SD"


class SuperGATLink(SuperGAT):
    """SuperGAT with its link prediction in the loss, weight 1, and a smaller start.

    With ``link_weight`` 0 only the start differs from :class:`SuperGAT`.
    """

    method = "GNS + SuperGATConv + link loss"
    weights: ClassVar[dict[str, float]] = {"link": 1.0}

    def __init__(self, latent: int, hidden: int) -> None:
        super().__init__(latent, hidden)
        with torch.no_grad():
            self.conv.lin.weight /= START * latent**0.5
