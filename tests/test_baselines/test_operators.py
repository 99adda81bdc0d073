"""Each operator is the equation that it says, written out in NumPy node by node."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from simple_models import OPERATORS, Graph, graph

from lagbench.baselines.operators.gat import GAT, GATv2
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.operators.operator import Operator
from lagbench.baselines.operators.supergat import (
    START,
    SuperGAT,
    SuperGATDot,
    draw_unlinked_pairs,
)
from lagbench.baselines.operators.transformer import Transformer

Array = NDArray[np.float64]
Weights = dict[str, Array]
Neighbours = list[tuple[int, Array]]
"""Sender and edge of each neighbour of a node."""

LATENT = 6
HIDDEN = 5


def seeded(seed: int) -> torch.Generator:
    """Return a seeded source of randomness."""
    return torch.Generator().manual_seed(seed)


def small_graph() -> Graph:
    """Return 9 nodes, one of them alone, and 24 edges."""
    return graph(9, 24, node=2 * LATENT, edge=LATENT)


def build_random(
    operator: type[Operator],
    *,
    scale: float = 1.0,
) -> Operator:
    """Return an operator in float64 whose every weight, biases too, is random."""
    torch.manual_seed(1)
    layer = operator(2 * LATENT, LATENT, HIDDEN).double()
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter, std=scale)
    return layer


def compute_update(layer: Operator, inputs: Graph) -> Array:
    """Return what each node gathers."""
    node, edge_index, edge = inputs
    update, _ = layer(node.double(), edge_index, edge.double())
    return as_array(update)


def as_array(tensor: torch.Tensor) -> Array:
    """Return a tensor as an array, without its graph of gradients."""
    return tensor.detach().numpy()


def read_weights(layer: Operator) -> Weights:
    """Return the layer's weights by name."""
    weights = {}
    for name, value in layer.named_parameters():
        weights[name] = as_array(value)
    return weights


def softmax(logits: Sequence[float]) -> Array:
    """Return exponentials over their sum."""
    values = np.array(logits)
    powers = np.exp(values - values.max())
    return powers / powers.sum()


def sigmoid(x: Array | float) -> Array:
    """Return the logistic function."""
    values = np.asarray(x)
    return 1 / (1 + np.exp(-values))


def leaky(x: Array | float) -> Array:
    """Return LeakyReLU with PyG's slope."""
    values = np.asarray(x)
    return np.where(values > 0, values, 0.2 * values)


def neighbours(
    inputs: Graph,
    receiver: int,
    *,
    loop: bool,
) -> Neighbours:
    """Return senders and edges of a node.

    A loop's edge is the mean of the others, and 0 without any.
    """
    senders, receivers = inputs.edge_index.numpy()
    edges = inputs.edge.double().numpy()
    near = []
    for number in np.flatnonzero(receivers == receiver):
        sender = int(senders[number])
        near.append((sender, edges[number]))
    if loop:
        mean = np.zeros(edges.shape[1])
        if near:
            near_edges = [edge for _, edge in near]
            mean = np.mean(near_edges, axis=0)
        near.append((receiver, mean))
    return near


def weighted_sum(
    attention: Array,
    value: Array,
    near: Neighbours,
) -> Array:
    """Return the sum of the neighbours' values times their attention."""
    total = np.zeros(value.shape[1])
    for number, (sender, _) in enumerate(near):
        total += attention[number] * value[sender]
    return total


def gat(w: Weights, x: Array, i: int, near: Neighbours) -> Array:
    """Return Velickovic et al. (2018), Eqs. 3 and 4, with the edge as a third part."""
    z = x @ w["conv.lin.weight"].T
    source = w["conv.att_src"].ravel()
    target = w["conv.att_dst"].ravel()
    of_edge = w["conv.att_edge"].ravel()
    logits = []
    for j, e in near:
        edge = w["conv.lin_edge.weight"] @ e
        logit = z[j] @ source + z[i] @ target + edge @ of_edge
        logits.append(float(leaky(logit)))
    total = weighted_sum(softmax(logits), z, near)
    return total + w["conv.bias"]


def gatv2(w: Weights, x: Array, i: int, near: Neighbours) -> Array:
    """Return Brody et al. (2022), Eq. 7."""
    left = x @ w["conv.lin_l.weight"].T
    left = left + w["conv.lin_l.bias"]
    right = x @ w["conv.lin_r.weight"].T
    right = right + w["conv.lin_r.bias"]
    attention = w["conv.att"].ravel()
    logits = []
    for j, e in near:
        edge = w["conv.lin_edge.weight"] @ e
        activated = leaky(left[j] + right[i] + edge)
        logits.append(float(activated @ attention))
    total = weighted_sum(softmax(logits), left, near)
    return total + w["conv.bias"]


SCALE = START * np.sqrt(LATENT)
"""SuperGAT divides its inputs and multiplies its values by this."""


def supergat_mx(w: Weights, x: Array, i: int, near: Neighbours) -> Array:
    """Return Eqs. 5.26 and 5.27 of the thesis, MX, of scaled inputs.

    Edges have no part in it.
    """
    z = x / SCALE @ w["conv.lin.weight"].T
    left = w["conv.att_l"].ravel()
    right = w["conv.att_r"].ravel()
    logits = []
    for j, _ in near:
        gate = sigmoid(z[i] @ z[j])
        logit = z[j] @ left + z[i] @ right
        logits.append(float(leaky(logit * gate)))
    total = weighted_sum(softmax(logits), z, near)
    return SCALE * (total + w["conv.bias"])


def supergat_sd(w: Weights, x: Array, i: int, near: Neighbours) -> Array:
    """Return Eqs. 5.26 and 5.27 of the thesis, SD, of scaled inputs."""
    z = x / SCALE @ w["conv.lin.weight"].T
    logits = []
    for j, _ in near:
        product = z[i] @ z[j]
        logit = leaky(product / np.sqrt(LATENT))
        logits.append(float(logit))
    total = weighted_sum(softmax(logits), z, near)
    return SCALE * (total + w["conv.bias"])


def transformer(w: Weights, x: Array, i: int, near: Neighbours) -> Array:
    """Return Shi et al. (2021), Eqs. 3 and 4, with a linear skip connection."""

    def project(name: str) -> Array:
        weight = w[f"conv.lin_{name}.weight"]
        bias = w[f"conv.lin_{name}.bias"]
        rows: Array = x @ weight.T + bias
        return rows

    total = project("skip")[i]
    if not near:
        return total
    key = project("key")
    query = project("query")
    value = project("value")
    edge_weight = w["conv.lin_edge.weight"]
    logits = []
    values = []
    for j, e in near:
        edge = edge_weight @ e
        product = query[i] @ (key[j] + edge)
        logits.append(product / np.sqrt(LATENT))
        values.append(value[j] + edge)
    for share, near_value in zip(softmax(logits), values, strict=True):
        total = total + share * near_value
    return total


def gns(w: Weights, x: Array, i: int, near: Neighbours) -> Array:
    """Return the sum of Sanchez-Gonzalez et al. (2020)."""
    total = np.zeros(LATENT)
    for _, edge in near:
        total += edge
    return total


Equation = Callable[[Weights, Array, int, Neighbours], Array]


@pytest.mark.parametrize(
    ("operator", "equation", "loop"),
    [
        (GNS, gns, False),
        (GAT, gat, True),
        (GATv2, gatv2, True),
        (SuperGAT, supergat_mx, True),
        (SuperGATDot, supergat_sd, True),
        (Transformer, transformer, False),
    ],
)
def test_an_operator_is_its_published_equation(
    operator: type[Operator],
    equation: Equation,
    loop: bool,
) -> None:
    """The equation sums over neighbours one by one."""
    inputs = small_graph()
    layer = build_random(operator, scale=0.4)
    x = inputs.node.double().numpy()
    weights = read_weights(layer)
    expected = []
    for receiver in range(len(x)):
        near = neighbours(inputs, receiver, loop=loop)
        row = equation(weights, x, receiver, near)
        expected.append(row)
    update = compute_update(layer, inputs)
    assert_allclose(update, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("operator", OPERATORS)
def test_the_order_of_nodes_and_edges_means_nothing(operator: type[Operator]) -> None:
    """Nodes in another order get the same updates in that order."""
    inputs = small_graph()
    layer = build_random(operator).eval()
    node_count = len(inputs.node)
    edge_count = len(inputs.edge)
    node_order = torch.randperm(node_count, generator=seeded(3))
    edge_order = torch.randperm(edge_count, generator=seeded(4))
    new_number = torch.argsort(node_order)
    shuffled = Graph(
        inputs.node[node_order],
        new_number[inputs.edge_index][:, edge_order],
        inputs.edge[edge_order],
    )
    update = compute_update(layer, shuffled)
    expected = compute_update(layer, inputs)[node_order]
    assert_allclose(update, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("operator", OPERATORS)
def test_without_edges_updates_and_gradients_are_finite(
    operator: type[Operator],
) -> None:
    layer = build_random(operator)
    node = torch.randn(3, 2 * LATENT).double()
    edge_index = torch.empty(2, 0, dtype=torch.int64)
    edge = torch.empty(0, LATENT).double()
    edge.requires_grad_()  # a plain sum has no weights
    update, losses = layer(node, edge_index, edge)
    assert update.isfinite().all()
    total = update.sum() + sum(losses.values())
    total.backward()
    for parameter in layer.parameters():
        if parameter.grad is not None:
            assert parameter.grad.isfinite().all()


Pairs = set[tuple[int, int]]


def set_of_pairs(pairs: torch.Tensor) -> Pairs:
    """Return the columns of a tensor of shape [2, pair] as a set."""
    senders, receivers = pairs.tolist()
    return set(zip(senders, receivers, strict=True))


def test_unlinked_pairs_are_neither_edges_nor_loops() -> None:
    """Every other pair comes up, and the same seed gives the same pairs."""
    edge_index = small_graph().edge_index
    pairs = draw_unlinked_pairs(edge_index, 9, 20_000, seeded(5))
    every_pair = set(itertools.permutations(range(9), 2))
    # 72 - 24 = 48 pairs in 20,000 draws of 81
    assert set_of_pairs(pairs) == every_pair - set_of_pairs(edge_index)
    again = draw_unlinked_pairs(edge_index, 9, 20_000, seeded(5))
    assert torch.equal(pairs, again)


def test_the_link_loss_is_equation_5_28() -> None:
    """It is the cross entropy of edges, loops and unlinked pairs."""
    inputs = small_graph()
    layer = build_random(SuperGAT, scale=0.4)
    node = inputs.node.double()
    _, losses = layer(
        node,
        inputs.edge_index,
        inputs.edge,
        generator=seeded(2),
    )

    weight = read_weights(layer)["conv.lin.weight"]
    z = node.numpy() / SCALE @ weight.T

    def link_probability(pairs: NDArray[np.int64]) -> Array:
        sender, receiver = pairs
        products = z[sender] * z[receiver]
        return sigmoid(products.sum(axis=1))

    edge_index = inputs.edge_index
    loops = np.tile(np.arange(9), (2, 1))
    linked = np.concatenate([edge_index.numpy(), loops], axis=1)
    drawn = draw_unlinked_pairs(edge_index, 9, 12, seeded(2))
    unlinked = drawn.numpy()
    of_linked = np.log(link_probability(linked))
    of_unlinked = np.log(1 - link_probability(unlinked))
    log_likelihood = np.concatenate([of_linked, of_unlinked])
    expected = -np.mean(log_likelihood)
    loss = losses["link"].item()
    assert loss == pytest.approx(expected, rel=1e-9)
