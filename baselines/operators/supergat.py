"""SuperGAT: attention that also learns which particles are neighbours."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor
from torch_geometric.nn import SuperGATConv

from .operator import Losses, Operator

START = 4.0
"""Scale of the inputs, as a multiple of the root of the latent width.

Links and attention see inputs over this scale, and the aggregate is multiplied by it.
Logits of links then start near 1. Unscaled they start near 1000, where the sigmoid is
flat, the link loss drowns the others and one neighbour has all the attention.
"""


# Compilers know neither generators nor results of unknown size.
@torch.compiler.disable  # type: ignore[untyped-decorator]
def draw_unlinked_pairs(
    edge_index: Tensor, nodes: int, count: int, generator: torch.Generator | None = None
) -> Tensor:
    """Draw pairs of nodes and return those that are neither edges nor loops.

    The shape is [2, pair], with at most `count` pairs. Without a generator the same
    pairs are drawn every time.
    """
    if generator is None:
        generator = torch.Generator().manual_seed(0)
    drawn = torch.randint(
        nodes, (2, count), generator=generator, device=generator.device
    )
    pairs = drawn.to(edge_index.device)
    sender, receiver = pairs
    edge_sender, edge_receiver = edge_index
    pair_number = receiver * nodes + sender
    edge_number = edge_receiver * nodes + edge_sender
    is_edge = torch.isin(pair_number, edge_number)
    is_loop = sender == receiver
    return pairs[:, ~is_edge & ~is_loop]


class SuperGAT(Operator):
    r"""Self-supervised graph attention of Kim and Oh (2021): PyG's SuperGATConv, MX,
    with its link loss.

    .. math::

        a_i &= k \sum_{j \in N(i) \cup \{i\}} \alpha_{ij} \Theta z_j, \quad z = s / k \\
        \alpha_{ij} &= \mathrm{softmax}_j\,\mathrm{LeakyReLU}(
            b^T [\Theta z_i \Vert \Theta z_j] \cdot \sigma((\Theta z_i)^T \Theta z_j))

    Source: Eqs. 5.26 to 5.28. The cross entropy of Eq. 5.28 over edges, loops and drawn
    unlinked pairs is a term of the loss, weight 1; with the option ``link_weight`` 0 it
    is not learnt from. In the thesis k is 1; here it is the scale of :data:`START`.
    """

    method = "GNS + SuperGATConv"
    weights: ClassVar[dict[str, float]] = {"link": 1.0}
    attention: ClassVar[str] = "MX"
    negatives: ClassVar[float] = 0.5
    """Unlinked pairs drawn for each edge."""

    def __init__(self, inputs: int, latent: int, hidden: int) -> None:
        super().__init__(inputs, latent, hidden)
        self.scale = START * latent**0.5
        self.conv = SuperGATConv(inputs, latent, attention_type=self.attention)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the aggregate of each node, and the link loss in training.

        SuperGAT has no use for the updates of the edges, ``edge``.
        """
        scaled_node = node / self.scale
        if not self.training:
            return self.scale * self.conv(scaled_node, edge_index), {}

        pair_count = int(self.negatives * edge_index.shape[1])
        # PyG would draw pairs of its own from Python's global source.
        pairs = draw_unlinked_pairs(edge_index, len(node), pair_count, generator)
        aggregate = self.scale * self.conv(scaled_node, edge_index, pairs)
        link_loss = self.conv.get_attention_loss()
        # PyG keeps both for that loss: they would hold the whole graph of gradients.
        self.conv.att_x = None
        self.conv.att_y = None
        return aggregate, {"link": link_loss}


class SuperGATDot(SuperGAT):
    r"""SuperGAT whose attention is the scaled dot product, SD.

    .. math:: \alpha_{ij} = \mathrm{softmax}_j\,\mathrm{LeakyReLU}((\Theta z_i)^T \Theta
    z_j / \sqrt{d})
    """

    method = "GNS + SuperGATConv (SD)"
    attention = "SD"
