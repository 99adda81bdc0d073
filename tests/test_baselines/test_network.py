"""The graph network: what all operators share, and that it is what it says."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from simple_models import OPERATORS, graph
from torch import Tensor, nn

from lagbench.baselines import network as layers
from lagbench.baselines.network import (
    EdgeMLP,
    EncodeProcessDecode,
    LayerNorm,
    Linear,
    ProcessorLayer,
    linear,
)
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.operators.operator import Losses, Operator
from lagbench.baselines.operators.supergat import SuperGAT
from lagbench.errors import UsageError

EVERY = pytest.mark.parametrize("operator", OPERATORS)


def network(operator: type[Operator], **options: Any) -> EncodeProcessDecode:
    """Return a small network with weights of seed 0."""
    torch.manual_seed(0)
    sizes = {
        "node_features": 7,
        "edge_features": 3,
        "latent": 16,
        "layers": 3,
    } | options
    return EncodeProcessDecode(operator, **sizes)


def plain(split: EdgeMLP, edge: Tensor, node: Tensor, edge_index: Tensor) -> Tensor:
    """Return the MLP of the concatenation [edge, receiver, sender]."""
    sender, receiver = edge_index
    whole = torch.cat([edge, node[receiver], node[sender]], dim=1)
    update: Tensor = split.rest(
        nn.functional.linear(whole, split.first.weight, split.first.bias)
    )
    return update


def test_split_first_layer() -> None:
    """Per-node products give the MLP of the concatenation to 6e-7 in float32."""
    torch.manual_seed(0)
    layer, (node, edge_index, edge) = (
        EdgeMLP(128, 128),
        graph(200, 1600, node=128, edge=128),
    )
    split = layer(edge, node, edge_index)
    expected = plain(layer.double(), edge.double(), node.double(), edge_index)
    assert ((split - expected).abs().max() / expected.abs().max()).item() < 6e-7


@pytest.mark.parametrize("mixed", [False, True])
def test_recomputed_hidden_layers(monkeypatch: pytest.MonkeyPatch, mixed: bool) -> None:
    """Hidden layers that are computed again give the values and gradients of those that
    are kept.
    """
    torch.manual_seed(0)
    layer = EdgeMLP(16, 12)
    inputs = graph(300, 20_000, node=16, edge=16)
    results = []
    for limit in (1e12, 0.0):
        monkeypatch.setattr(layers, "LARGEST_KEPT", limit)
        node, edge = (
            part.clone().requires_grad_() for part in (inputs.node, inputs.edge)
        )
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            update = layer(edge, node, inputs.edge_index)
        wanted = [node, edge, *layer.parameters()]
        results.append([update, *torch.autograd.grad(update.square().sum(), wanted)])
    for kept, again in zip(*results, strict=True):
        assert ((kept - again).abs().max() / kept.abs().max()).item() < (
            2e-2 if mixed else 1e-5
        )


@pytest.mark.parametrize("limit", [1e12, 0.0])
def test_gradients_of_the_edge_update(
    monkeypatch: pytest.MonkeyPatch, limit: float
) -> None:
    """Gradients are finite differences' in float64, hidden layers kept or not."""
    monkeypatch.setattr(layers, "LARGEST_KEPT", limit)
    torch.manual_seed(0)
    layer = EdgeMLP(4, 3).double()
    inputs = graph(5, 9, node=4, edge=4)
    node = inputs.node.double().requires_grad_()
    edge = inputs.edge.double().requires_grad_()
    tensors = (edge, node, *layer.parameters())
    torch.autograd.gradcheck(lambda e, n, *_: layer(e, n, inputs.edge_index), tensors)


@pytest.mark.parametrize("rows", [0, 1, 257])
def test_linear(rows: int) -> None:
    """The product by oneDNN and its gradients are NumPy's, for views of wider matrices
    too.
    """
    torch.manual_seed(0)
    wide = torch.randn(rows, 40)
    weight = torch.randn(24, 90)
    bias = torch.randn(24)
    x = wide[:, :30].detach()
    part = weight[:, 30:60].detach()
    for tensor in (x, part, bias):
        tensor.requires_grad_()
    y = linear(x, part, bias)
    sign = torch.randn(rows, 24)
    (y * sign).sum().backward()
    a, w, s = (tensor.detach().double().numpy() for tensor in (x, part, sign))
    np.testing.assert_allclose(
        y.detach(), a @ w.T + bias.detach().numpy(), rtol=1e-4, atol=1e-4
    )
    for tensor, expected in ((x, s @ w), (part, s.T @ a), (bias, s.sum(axis=0))):
        np.testing.assert_allclose(tensor.grad, expected, rtol=1e-4, atol=1e-4)


def test_linear_elsewhere() -> None:
    """What oneDNN does not take (float64, bfloat16, other shapes) goes to torch: the
    same numbers.
    """
    layer = Linear(5, 4)
    x = torch.randn(2, 3, 5)
    expected = nn.functional.linear(x, layer.weight, layer.bias)
    assert torch.equal(layer(x), expected)
    assert layer.double()(x.double()).dtype == torch.float64
    with torch.autocast("cpu", torch.bfloat16):
        assert layer.float()(x[0]).dtype == torch.bfloat16


def test_layer_norm_learns_in_bfloat16() -> None:
    """In bfloat16 all gradients are those of float64 to two digits: sums over 5,000
    rows do not stall.
    """
    torch.manual_seed(0)
    x = torch.randn(5000, 16) * 3 + 1
    slope = torch.randn(5000, 16) * 0.1 + 1
    rounded = x.bfloat16().requires_grad_()
    with torch.autocast("cpu", torch.bfloat16):
        layer = LayerNorm(16)
        layer(rounded).backward(slope.bfloat16())
    precise = nn.LayerNorm(16).double()
    exact = x.double().requires_grad_()
    precise(exact).backward(slope.double())
    pairs = [
        (rounded, exact),
        *zip(layer.parameters(), precise.parameters(), strict=True),
    ]
    for ours, theirs in pairs:
        assert float((ours.grad - theirs.grad).norm() / theirs.grad.norm()) < 0.03


def test_layer_by_hand() -> None:
    """A layer is the interaction network of its docstring, written out node by node."""
    torch.manual_seed(0)
    layer = ProcessorLayer(GNS, latent=8, hidden=6).double()
    inputs = graph(6, 12, node=8, edge=8)
    node = inputs.node.double()
    edge = inputs.edge.double()
    nodes, edges, _ = layer(node, inputs.edge_index, edge)
    message = plain(layer.message, edge, node, inputs.edge_index)
    for i in range(6):
        total = sum(
            (message[k] for k in range(12) if inputs.edge_index[1, k] == i),
            torch.zeros(8),
        )
        expected = node[i] + layer.update(torch.cat([node[i], total]))
        torch.testing.assert_close(nodes[i], expected, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(edges, edge + message, rtol=1e-10, atol=1e-10)


@EVERY
def test_edge_latents_update(operator: type[Operator]) -> None:
    """Every layer adds something else to the edges; ten layers are not a factor of
    1024.
    """
    model = network(operator, layers=10)
    inputs = graph(30, 150, node=7, edge=3)
    seen: list[Tensor] = []
    for layer in model.processor:
        layer.register_forward_hook(lambda _, given, __: seen.append(given[2].detach()))
    model(*inputs)
    changes = [after - before for before, after in itertools.pairwise(seen)]
    for before, change in zip(seen, changes, strict=False):
        cosine = nn.functional.cosine_similarity(before, change, dim=1)
        assert float(change.abs().mean()) > 0.1
        assert float(cosine.max()) < 0.999  # doubling would give 1
    assert float(seen[-1].norm() / seen[0].norm()) < 20.0


def test_parameters() -> None:
    """With latent 128 and 10 layers, GNS has 1.6 M parameters."""
    count = sum(
        p.numel()
        for p in network(GNS, node_features=30, latent=128, layers=10).parameters()
    )
    square = 128 * 128 + 128
    norm = 2 * 128
    encoders = (31 * 128 + 2 * square + norm) + (4 * 128 + 2 * square + norm)
    layer = (385 * 128 + 2 * square + norm) + (257 * 128 + 2 * square + norm)
    assert count == encoders + 10 * layer + 2 * square + 129 * 2 == 1_591_682


def shapes_beside_operators(model: torch.nn.Module) -> dict[str, torch.Size]:
    """Return the shapes of all weights that do not belong to an operator."""
    shapes = {}
    for name, parameter in model.named_parameters():
        if ".operator." not in name:
            shapes[name] = parameter.shape
    return shapes


@EVERY
def test_only_the_operator_differs_and_no_weight_is_idle(
    operator: type[Operator],
) -> None:
    """Names and shapes beside it are those of GNS; gradients reach all parameters, as
    DDP wants it.

    A key's bias shifts all logits alike and has none to speak of.
    """
    model = network(operator)
    inputs = graph(30, 150, node=7, edge=3)
    assert shapes_beside_operators(model) == shapes_beside_operators(network(GNS))
    prediction, losses = model(*inputs)
    (prediction.square().sum() + sum(losses.values())).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert name.endswith("lin_key.bias") or bool(parameter.grad.any()), name


@EVERY
def test_windows_side_by_side(operator: type[Operator]) -> None:
    """Two graphs in one call have the predictions of two calls."""
    model = network(operator).eval()
    first = graph(12, 40, node=7, edge=3, seed=1)
    second = graph(9, 24, node=7, edge=3, seed=2)
    node = torch.cat([first.node, second.node])
    edge = torch.cat([first.edge, second.edge])
    edge_index = torch.cat([first.edge_index, second.edge_index + 12], dim=1)
    together, _ = model(node, edge_index, edge)
    first_prediction, _ = model(*first)
    second_prediction, _ = model(*second)
    expected = torch.cat([first_prediction, second_prediction])
    torch.testing.assert_close(together, expected, rtol=1e-5, atol=1e-5)


@EVERY
def test_mixed_precision(operator: type[Operator]) -> None:
    """Under bfloat16 the prediction is near the exact one, and every weight learns."""
    model = network(operator, latent=32)
    inputs = graph(60, 400, node=7, edge=3)
    exact, _ = model(*inputs)
    with torch.autocast("cpu", torch.bfloat16):
        prediction, losses = model(*inputs)
    assert prediction.dtype == torch.float32
    error = (prediction - exact).norm() / exact.norm()
    assert error.item() < 0.05
    loss = prediction.square().sum() + sum(losses.values())
    loss.backward()
    for parameter in model.parameters():
        assert parameter.grad is not None
        assert parameter.grad.isfinite().all()


class Total(Operator):
    """A third party's operator: the sum of a node's input and its neighbours'."""

    method = "GNS + sum"
    weights = {"size": 0.5}  # noqa: RUF012

    def __init__(self, inputs: int, latent: int, hidden: int) -> None:
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
        heard = node.index_add(0, edge_index[1], node[edge_index[0]])
        return self.linear(heard), {"size": heard.square().mean()}


@pytest.mark.parametrize(
    "answer",
    [
        lambda heard: heard,
        lambda heard: (heard, None),
        lambda heard: (heard[:1], {}),
        lambda heard: (torch.cat([heard, heard], dim=1), {}),
        lambda heard: (heard, {"size": 1.0}),
        lambda heard: (heard, {"size": heard}),
    ],
)
def test_an_operator_that_returns_something_else(
    answer: Callable[[Tensor], Any],
) -> None:
    """No pair, another number of rows or columns, no losses of one number: its class is
    named.
    """

    class Odd(Total):
        def forward(self, *given: Tensor, **options: Any) -> Any:
            return answer(super().forward(*given, **options)[0])

    with pytest.raises(UsageError) as caught:
        network(Odd)(*graph(12, 40, node=7, edge=3))
    assert "Odd" in str(caught.value.where)


def test_operator_of_others() -> None:
    """An operator in one class works; its loss comes out as the mean over layers."""
    model = network(Total)
    inputs = graph(12, 40, node=7, edge=3)
    sizes: list[Tensor] = []
    for layer in model.processor:
        layer.register_forward_hook(lambda _, __, out: sizes.append(out[2]["size"]))
    prediction, losses = model(*inputs)
    assert prediction.shape == (12, 2)
    assert losses["size"].item() == pytest.approx(torch.stack(sizes).mean().item())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The .grad attribute")  # torch, while it traces
@pytest.mark.parametrize("operator", [GNS, SuperGAT])
def test_compiled_layers(operator: type[Operator]) -> None:
    """Compiled layers give the values and gradients of the plain ones, for any number
    of edges.
    """
    plain_one = network(operator)
    compiled = network(operator)
    compiled.compile_layers()
    for edges in (500, 731):
        results = []
        for model in (plain_one, compiled):
            output, losses = model(
                *graph(60, edges, node=7, edge=3), torch.Generator().manual_seed(0)
            )
            total = output.square().sum() + sum(losses.values())
            results.append(
                [output, *torch.autograd.grad(total, list(model.parameters()))]
            )
        torch.testing.assert_close(results[1], results[0], rtol=1e-4, atol=1e-5)
