"""Encode, process, decode: the graph network that all six operators share."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lagbench.baselines.operators.operator import Losses, Operator, summed

from .layers import EdgeMLP, mlp

__all__ = ["EncodeProcessDecode", "ProcessorLayer"]


class ProcessorLayer(nn.Module):
    r"""One round of message passing; everything but the aggregation is fixed.

    .. math::

        m_{ij} &= \mathrm{MLP}(e_{ij}, x_i, x_j) \\
        e_{ij} &\leftarrow e_{ij} + m_{ij} \\
        s_i &= [x_i \Vert \textstyle\sum_j m_{ij}] \\
        a_i &= \mathrm{Operator}(s, m)_i \\
        x_i &\leftarrow x_i + \mathrm{LayerNorm}(\mathrm{MLP}([x_i \Vert a_i]))

    MLPs have two hidden layers. Where messages are not summed, :math:`s_i = x_i`.
    """

    def __init__(
        self, operator: type[Operator], *, latent: int, hidden: int, sum_messages: bool = True
    ) -> None:
        super().__init__()
        self.sum_messages = sum_messages
        self.message = EdgeMLP(latent, hidden)
        self.operator = operator((1 + sum_messages) * latent, latent, hidden)
        self.update = mlp([2 * latent, hidden, hidden, latent])

    def forward(
        self, node: Tensor, edge_index: Tensor, edge: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Tensor, Losses]:
        """Return updated nodes and edges and the operator's own losses.

        Args:
            node: node latents, shape [particle, latent].
            edge_index: senders and receivers, shape [2, edge].
            edge: edge latents, shape [edge, latent].
            generator: source of whatever the operator draws.
        """
        message = self.message(edge, node, edge_index)
        given = node
        if self.sum_messages and self.operator.reads_nodes:
            given = torch.cat([node, summed(edge_index, message, len(node))], dim=-1)
        gathered, losses = self.operator(given, edge_index, message, generator=generator)
        update = self.update(torch.cat([node, gathered], dim=-1))
        return node + update, edge + message, losses


class EncodeProcessDecode(nn.Module):
    """A graph network after Sanchez-Gonzalez et al. (2020), section 3.

    Two MLPs encode nodes and edges, processor layers of their own weights update both, an
    MLP decodes the nodes. With latent 128 and 10 layers it has about 1.6 M parameters.
    """

    def __init__(
        self,
        operator: type[Operator],
        *,
        node_features: int,
        edge_features: int,
        outputs: int = 2,
        latent: int = 128,
        layers: int = 10,
        hidden: int | None = None,
        sum_messages: bool = True,
    ) -> None:
        super().__init__()
        hidden = latent if hidden is None else hidden
        self.node_encoder = mlp([node_features, hidden, hidden, latent])
        self.edge_encoder = mlp([edge_features, hidden, hidden, latent])
        self.processor = nn.ModuleList(
            ProcessorLayer(operator, latent=latent, hidden=hidden, sum_messages=sum_messages)
            for _ in range(layers)
        )
        self.decoder = mlp([latent, hidden, hidden, outputs], norm=False)

    def compile_layers(self) -> None:
        """Compile the edges' encoder and the processor layers, for any number of edges.

        The layers are compiled once for all: their code is the same. All hidden layers are then kept.
        """
        for part in (self.edge_encoder, *self.processor):
            part.compile(dynamic=True)

    def forward(
        self, node: Tensor, edge_index: Tensor, edge: Tensor, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Losses]:
        """Return the prediction and the operators' own losses, layer means.

        Args:
            node: particle features, shape [particle, node_features].
            edge_index: senders and receivers, shape [2, edge].
            edge: edge features, shape [edge, edge_features].
            generator: source of whatever the operators draw in training.

        Returns:
            Prediction, shape [particle, outputs]; losses by name, empty for most operators.
        """
        given = node.dtype
        node, edge = self.node_encoder(node), self.edge_encoder(edge)
        losses: list[Losses] = []
        for layer in self.processor:
            node, edge, own = layer(node, edge_index, edge, generator)
            losses.append(own)
        means = {name: torch.stack([own[name] for own in losses]).mean() for name in losses[0]}
        # Three digits of bfloat16 are too few for what is added to velocities every frame.
        with torch.autocast(node.device.type, enabled=False):
            return self.decoder(node.to(given)), means
