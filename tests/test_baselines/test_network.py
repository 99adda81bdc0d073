"""The graph network: what all operators share."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from simple_models import graph
from torch import Tensor, nn
from torch.testing import assert_close
from turns import of_this_turn

from lagbench.baselines.network import (
    EdgeMLP,
    EncodeProcessDecode,
    ProcessorLayer,
)
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.operators.operator import Losses, Operator
from lagbench.baselines.operators.supergat import SuperGAT


def network(
    operator: type[Operator],
    **options: Any,
) -> EncodeProcessDecode:
    """Return a small network with weights of seed 0."""
    torch.manual_seed(0)
    sizes = {
        "node_features": 7,
        "edge_features": 3,
        "latent": 16,
        "layers": 3,
    } | options
    return EncodeProcessDecode(operator, **sizes)


def apply_to_concatenation(
    layer: EdgeMLP,
    edge: Tensor,
    node: Tensor,
    edge_index: Tensor,
) -> Tensor:
    """Return the MLP of the concatenation [edge, receiver, sender]."""
    sender, receiver = edge_index
    parts = [edge, node[receiver], node[sender]]
    whole = torch.cat(parts, dim=1)
    first = layer.first
    hidden = nn.functional.linear(whole, first.weight, first.bias)
    update: Tensor = layer.rest(hidden)
    return update


def test_a_layer_is_the_interaction_network_node_by_node() -> None:
    torch.manual_seed(0)
    layer = ProcessorLayer(GNS, latent=8, hidden=6).double()
    inputs = graph(6, 12, node=8, edge=8)
    node = inputs.node.double()
    edge = inputs.edge.double()
    edge_index = inputs.edge_index
    _, receiver = edge_index
    new_node, new_edge, _ = layer(node, edge_index, edge)

    message = apply_to_concatenation(layer.message, edge, node, edge_index)
    expected_edge = edge + message
    assert_close(new_edge, expected_edge, rtol=1e-10, atol=1e-10)
    for i in range(6):
        total = message[receiver == i].sum(dim=0)
        own_and_total = torch.cat([node[i], total])
        expected_node = node[i] + layer.update(own_and_total)
        assert_close(new_node[i], expected_node, rtol=1e-10, atol=1e-10)


class Total(Operator):
    """A third party's operator: the sum of a node's input and its neighbours'."""

    method = "GNS + sum"
    weights = {"size": 0.5}  # noqa: RUF012

    def __init__(
        self,
        inputs: int,
        latent: int,
        hidden: int,
    ) -> None:
        super().__init__(inputs, latent, hidden)
        self.linear = nn.Linear(inputs, latent)

    def forward(
        self,
        node: Tensor,
        edge_index: Tensor,
        edge: Tensor,
        *,
        generator: torch.Generator | None = None,
    ) -> tuple[Tensor, Losses]:
        """Return what each node gathers and a loss of its own."""
        sender, receiver = edge_index
        total = node.index_add(0, receiver, node[sender])
        size = total.square().mean()
        return self.linear(total), {"size": size}


def test_the_loss_of_an_operator_is_the_mean_over_layers() -> None:
    model = network(Total)
    sizes: list[Tensor] = []

    def record_loss(
        _: nn.Module,
        __: object,
        output: tuple[Any, ...],
    ) -> None:
        sizes.append(output[2]["size"])

    for layer in model.processor:
        layer.register_forward_hook(record_loss)
    inputs = graph(12, 40, node=7, edge=3)
    prediction, losses = model(*inputs)
    assert prediction.shape == (12, 2)
    mean = torch.stack(sizes).mean()
    loss = losses["size"].item()
    assert loss == pytest.approx(mean.item())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The .grad attribute")  # torch, while it traces
@pytest.mark.parametrize("operator", of_this_turn([GNS, SuperGAT], turns=3))
def test_compiled_layers_give_the_same_gradients(operator: type[Operator]) -> None:
    """They give the same values too, for any number of edges."""
    plain = network(operator)
    compiled = network(operator)
    compiled.compile_layers()

    def compute_output_and_gradients(model: Any, edges: int) -> list[Tensor]:
        inputs = graph(60, edges, node=7, edge=3)
        output, losses = model(*inputs, torch.Generator().manual_seed(0))
        total = output.square().sum() + sum(losses.values())
        return [output, *torch.autograd.grad(total, list(model.parameters()))]

    for edges in (500, 731):
        expected = compute_output_and_gradients(plain, edges)
        values = compute_output_and_gradients(compiled, edges)
        assert_close(values, expected, rtol=1e-4, atol=1e-5)
