"""Multi-layer perceptrons of the graph networks, for nodes and for edges."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from .dense import LayerNorm, Linear, linear
from .recomputed import Recomputed, edge_map

__all__ = ["EdgeMLP", "mlp"]

LARGEST_KEPT = 24e6
"""Edge tensors above this size on a CPU are recomputed, not kept [byte]."""


def mlp(widths: list[int], *, norm: bool = True) -> nn.Sequential:
    """Return linear layers with ReLU between them, LayerNorm after the last.

    Args:
        widths: width of the input, of each hidden layer, of the output.
        norm: whether the output passes a LayerNorm; a decoder's does not.
    """
    layers: list[nn.Module] = []
    for width, following in pairwise(widths):
        layers += [Linear(width, following), nn.ReLU(inplace=True)]
    layers[-1:] = [LayerNorm(widths[-1])] if norm else []
    return nn.Sequential(*layers)


class EdgeMLP(nn.Module):
    r"""An MLP of an edge and its two ends, with a first layer per node.

    .. math:: m_{ij} = f(W_e e_{ij} + (W_r x_i + b) + W_s x_j)

    The first layer of an MLP on the concatenation :math:`[e_{ij}, x_i, x_j]` is linear in
    each part, so the products with nodes are taken once per node, not once per edge.

    Where one edge tensor on a CPU has more than 24 MB (a full scenario in float32), hidden
    layers are computed again in the backward pass, edges by pieces that fit the cache: a
    little time for half of the memory. Above 32 MB, glibc would also hand every tensor back to
    the system and pay for its pages again.

    Args:
        latent: width of nodes, edges and output.
        hidden: width of the two hidden layers.
    """

    def __init__(self, latent: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Linear(3 * latent, hidden)
        self.rest = nn.Sequential(nn.ReLU(inplace=True), *mlp([hidden, hidden, latent]))

    def forward(self, edge: Tensor, node: Tensor, edge_index: Tensor) -> Tensor:
        """Return the update of each edge, shape [edge, latent].

        Args:
            edge: edge latents, shape [edge, latent].
            node: node latents, shape [particle, latent].
            edge_index: senders and receivers, shape [2, edge].
        """
        of_edge, of_receiver, of_sender = self.first.weight.tensor_split(3, dim=1)
        ends = linear(node, of_sender), linear(node, of_receiver, self.first.bias)
        if edge.device.type == "cpu" and self._bytes(edge) > LARGEST_KEPT:
            tensors = edge_index, edge, *ends, of_edge, *self.rest.parameters()
            update: Tensor = Recomputed.apply(self.rest, *tensors)  # type: ignore[no-untyped-call]
            return update
        return edge_map(self.rest, edge_index, edge, *ends, of_edge)

    def _bytes(self, edge: Tensor) -> int:
        device = edge.device.type
        mixed = torch.is_autocast_enabled(device)
        dtype = torch.get_autocast_dtype(device) if mixed else edge.dtype
        return len(edge) * self.first.out_features * dtype.itemsize
