"""Encode, process, decode: the graph network that all operators share."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from lagbench.baselines.operators.operator import Losses, Operator, sum_edges


class ProcessorLayer(nn.Module):
    r"""One round of message passing; everything but the aggregation is fixed.

    .. math::

        m_{ij} &= \mathrm{LayerNorm}(\mathrm{MLP}(e_{ij}, x_i, x_j)) \\
        e_{ij} &\leftarrow e_{ij} + m_{ij} \\
        s_i &= [x_i \Vert \textstyle\sum_j m_{ij}] \\
        a_i &= \mathrm{Operator}(s, m)_i \\
        x_i &\leftarrow x_i + \mathrm{LayerNorm}(\mathrm{MLP}([x_i \Vert a_i]))

    MLPs have two hidden layers.
    """

    def __init__(self, operator: type[Operator], *, latent: int, hidden: int) -> None:
        super().__init__()
        self.message = EdgeMLP(latent, hidden)
        self.operator = operator(2 * latent, latent, hidden)
        self.update = mlp([2 * latent, hidden, hidden, latent])

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Tensor, Losses]:
        """Return updated nodes and edges and the operator's own losses."""
        message = self.message(edge, node, edge_index)
        operator_input = node
        if self.operator.reads_nodes:
            message_sum = sum_edges(edge_index, message, len(node))
            operator_input = torch.cat([node, message_sum], dim=-1)

        aggregate, losses = self.operator(
            operator_input, edge_index, message, generator=generator
        )
        update_input = torch.cat([node, aggregate], dim=-1)
        next_node = node + self.update(update_input)
        next_edge = edge + message
        return next_node, next_edge, losses


class LayeredNetwork(nn.Module):
    """A network of layers that a training may compile."""

    layers: nn.ModuleList

    def compile_layers(self) -> None:
        """Compile the layers, for any number of edges."""
        for layer in self.layers:
            layer.compile(dynamic=True)


class EncodeProcessDecode(LayeredNetwork):
    """A graph network after Sanchez-Gonzalez et al. (2020), section 3.

    Two MLPs encode nodes and edges, processor layers with weights of their own update
    both, an MLP decodes the nodes. With latent 128 and 10 layers it has about 1.6 M
    parameters.
    """

    def __init__(
        self,
        operator: type[Operator],
        *,
        node_features: int,
        edge_features: int,
        latent: int = 128,
        layers: int = 10,
        outputs: int = 2,
    ) -> None:
        super().__init__()
        self.node_encoder = mlp([node_features, latent, latent, latent])
        self.edge_encoder = mlp([edge_features, latent, latent, latent])
        self.processor = nn.ModuleList()
        for _ in range(layers):
            layer = ProcessorLayer(operator, latent=latent, hidden=latent)
            self.processor.append(layer)
        self.decoder = mlp([latent, latent, latent, outputs], norm=False)

    def compile_layers(self) -> None:
        """Compile the edges' encoder and the processor layers, for any number of edges.

        The layers have the same code, so one compilation serves all. All hidden layers
        then stay in memory until the backward pass.
        """
        for part in (self.edge_encoder, *self.processor):
            part.compile(dynamic=True)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return the prediction and the operators' own losses.

        The prediction has the shape [particle, output]. Losses are means over the
        layers.
        """
        node = self.node_encoder(node)
        edge = self.edge_encoder(edge)
        layer_losses: list[Losses] = []
        for layer in self.processor:
            node, edge, losses = layer(node, edge_index, edge, generator)
            layer_losses.append(losses)

        mean_losses = {}
        for name in layer_losses[0]:
            values = [losses[name] for losses in layer_losses]
            of_layers = torch.stack(values)
            mean_losses[name] = of_layers.mean()

        return self.decoder(node), mean_losses


def mlp(widths: list[int], *, norm: bool = True) -> nn.Sequential:
    """Return linear layers with ReLU between them, with ``norm`` a LayerNorm last."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers.append(nn.Linear(inputs, outputs))
        layers.append(nn.ReLU(inplace=True))
    layers.pop()  # no ReLU after the last
    if norm:
        layers.append(nn.LayerNorm(widths[-1]))
    return nn.Sequential(*layers)


class EdgeMLP(nn.Module):
    r"""An MLP of an edge and its two ends, with a first layer per node.

    .. math:: m_{ij} = f(W_e e_{ij} + (W_r x_i + b) + W_s x_j)

    The first layer of an MLP on the concatenation :math:`[e_{ij}, x_i, x_j]` is linear
    in each part, so the products with nodes are taken once per node, not once per edge.
    """

    def __init__(self, latent: int, hidden: int) -> None:
        super().__init__()
        self.first = nn.Linear(3 * latent, hidden)
        later_layers = mlp([hidden, hidden, latent])
        self.rest = nn.Sequential(nn.ReLU(inplace=True), *later_layers)

    def forward(self, edge: Tensor, node: Tensor, edge_index: Tensor) -> Tensor:
        """Return the update of each edge, shape [edge, latent]."""
        parts = self.first.weight.tensor_split(3, dim=1)
        edge_weight, receiver_weight, sender_weight = parts
        sender = linear(node, sender_weight)
        receiver = linear(node, receiver_weight, self.first.bias)
        senders, receivers = edge_index
        hidden = receiver.index_select(0, receivers)
        # In place: an edge tensor of a full scenario has 32 MB.
        hidden += sender.index_select(0, senders)
        hidden += linear(edge, edge_weight)
        update: Tensor = self.rest(hidden)
        return update
