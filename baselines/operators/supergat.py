"""SuperGAT: attention that also learns which particles are neighbours."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor
from torch_geometric.nn import SuperGATConv

from .operator import Losses, Operator

START = 4.0
"""Links and attention see inputs over this times the root of the latent width, values
are multiplied by it.

Logits of links then start near 1, not near 1000, where the sigmoid is flat, the link
loss drowns the others and one neighbour has all the attention.
"""


# Compilers know neither generators nor results of unknown size.
@torch.compiler.disable  # type: ignore[untyped-decorator]
def unlinked_pairs(
    edge_index: Tensor, nodes: int, count: int, generator: torch.Generator | None = None
) -> Tensor:
    """Draw pairs of nodes and return those that are no edge and no loop, shape [2,
    pair], at most `count`.

    None as generator draws the same pairs every time.
    """
    if generator is None:
        source = torch.Generator().manual_seed(0)
    else:
        source = generator
    pairs = torch.randint(nodes, (2, count), generator=source, device=source.device).to(
        edge_index.device
    )
    sender, receiver = pairs
    linked = torch.isin(
        receiver * nodes + sender, edge_index[1] * nodes + edge_index[0]
    )
    return pairs[:, ~linked & (sender != receiver)]


class SuperGAT(Operator):
    r"""Self-supervised graph attention of Kim and Oh (2021): PyG's SuperGATConv, MX,
    with its link loss.

    .. math::

        a_i &= k \sum_{j \in N(i) \cup \{i\}} \alpha_{ij} \Theta z_j, \quad z = s / k \\
        \alpha_{ij} &= \mathrm{softmax}_j\,\mathrm{LeakyReLU}(
            b^T [\Theta z_i \Vert \Theta z_j] \cdot \sigma((\Theta z_i)^T \Theta z_j))

    Source: Eqs. 5.26 to 5.28. The cross entropy of Eq. 5.28 over edges, loops and drawn
    unlinked pairs is a term of the loss, weight 1; with the option ``link_weight`` 0 it
    is not learnt from. k is 1 in the thesis; here it makes the start sound
    (:data:`START`).
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
        """Return what each node gathers, and the link loss in training."""
        node = node / self.scale
        if not self.training:
            return self.scale * self.conv(node, edge_index), {}
        count = int(self.negatives * edge_index.shape[1])
        # Given pairs: PyG would draw its own from Python's global source.
        pairs = unlinked_pairs(edge_index, len(node), count, generator)
        gathered = self.scale * self.conv(node, edge_index, pairs)
        loss = self.conv.get_attention_loss()
        # They would hold the whole graph of gradients.
        self.conv.att_x = self.conv.att_y = None
        return gathered, {"link": loss}


class SuperGATDot(SuperGAT):
    r"""SuperGAT whose attention is the scaled dot product, SD.

    .. math:: \alpha_{ij} = \mathrm{softmax}_j\,\mathrm{LeakyReLU}((\Theta z_i)^T \Theta
    z_j / \sqrt{d})
    """

    method = "GNS + SuperGATConv (SD)"
    attention = "SD"
