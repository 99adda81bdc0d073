"""Each operator is the equation that it says, written out in NumPy node by node."""

from __future__ import annotations

import copy
import random
from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from simple_models import OPERATORS, Graph, graph
from torch_geometric.nn import PointNetConv

from lagbench.baselines.operators.gat import GAT, GATv2
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.operators.operator import Operator
from lagbench.baselines.operators.pointnet import PointNet
from lagbench.baselines.operators.supergat import (
    START,
    SuperGAT,
    SuperGATDot,
    draw_unlinked_pairs,
)
from lagbench.baselines.operators.transformer import Transformer

Array = NDArray[np.float64]
LATENT = 6
HIDDEN = 5


def small(seed: int = 0) -> Graph:
    """Return 9 nodes, one of them alone, and 24 edges."""
    return graph(9, 24, node=2 * LATENT, edge=LATENT, seed=seed)


def built(operator: type[Operator], *, scale: float = 1.0) -> Operator:
    """Return an operator in float64 whose every weight, biases too, is random."""
    torch.manual_seed(1)
    layer = operator(2 * LATENT, LATENT, HIDDEN).double()
    for parameter in layer.parameters():
        torch.nn.init.normal_(parameter, std=scale)
    return layer


def updated(layer: Operator, inputs: Graph) -> Array:
    """Return what each node gathers."""
    node, edge_index, edge = inputs
    return layer(node.double(), edge_index, edge.double())[0].detach().numpy()


def weights(layer: Operator) -> dict[str, Array]:
    """Return the layer's weights by name."""
    return {name: value.detach().numpy() for name, value in layer.named_parameters()}


def softmax(logits: list[float]) -> Array:
    """Return exponentials over their sum."""
    powers = np.exp(np.array(logits) - max(logits))
    return powers / powers.sum()


def leaky(x: Array | float) -> Array:
    """Return LeakyReLU with PyG's slope."""
    return np.where(np.asarray(x) > 0, x, 0.2 * np.asarray(x))


def neighbours(inputs: Graph, receiver: int, *, loop: bool) -> list[tuple[int, Array]]:
    """Return senders and edges of a node; a loop's edge is the mean of the others, 0
    without any.
    """
    senders, receivers = inputs.edge_index.numpy()
    edges = inputs.edge.double().numpy()
    found = [(int(senders[k]), edges[k]) for k in np.flatnonzero(receivers == receiver)]
    mean = (
        np.mean([edge for _, edge in found], axis=0)
        if found
        else np.zeros(edges.shape[1])
    )
    return [*found, (receiver, mean)] if loop else found


def gat(w: dict[str, Array], x: Array, i: int, near: list[tuple[int, Array]]) -> Array:
    """Return Velickovic et al. (2018), Eqs. 3 and 4, with the edge as a third part."""
    z = x @ w["conv.lin.weight"].T
    source, target, edge = (
        w[f"conv.att_{name}"].ravel() for name in ("src", "dst", "edge")
    )
    of_edge = w["conv.lin_edge.weight"]
    a = softmax(
        [
            float(leaky(z[j] @ source + z[i] @ target + (of_edge @ e) @ edge))
            for j, e in near
        ]
    )
    return (
        np.sum([a_j * z[j] for a_j, (j, _) in zip(a, near, strict=True)], axis=0)
        + w["conv.bias"]
    )


def gatv2(
    w: dict[str, Array], x: Array, i: int, near: list[tuple[int, Array]]
) -> Array:
    """Return Brody et al. (2022), Eq. 7."""
    left = x @ w["conv.lin_l.weight"].T + w["conv.lin_l.bias"]
    right = x @ w["conv.lin_r.weight"].T + w["conv.lin_r.bias"]
    of_edge = w["conv.lin_edge.weight"]
    a = softmax(
        [
            float(leaky(left[j] + right[i] + of_edge @ e) @ w["conv.att"].ravel())
            for j, e in near
        ]
    )
    return (
        np.sum([a_j * left[j] for a_j, (j, _) in zip(a, near, strict=True)], axis=0)
        + w["conv.bias"]
    )


SCALE = START * np.sqrt(LATENT)
"""What SuperGAT's inputs are divided by and its values multiplied by."""


def supergat_mx(
    w: dict[str, Array], x: Array, i: int, near: list[tuple[int, Array]]
) -> Array:
    """Return Eqs. 5.26 and 5.27 of the thesis, MX, of scaled inputs; edges have no part
    in it.
    """
    z = x / SCALE @ w["conv.lin.weight"].T
    left = w["conv.att_l"].ravel()
    right = w["conv.att_r"].ravel()
    gate = [1 / (1 + np.exp(-z[i] @ z[j])) for j, _ in near]
    e = [
        float(leaky((z[j] @ left + z[i] @ right) * g))
        for g, (j, _) in zip(gate, near, strict=True)
    ]
    heard = np.sum(
        [a * z[j] for a, (j, _) in zip(softmax(e), near, strict=True)], axis=0
    )
    return SCALE * (heard + w["conv.bias"])


def supergat_sd(
    w: dict[str, Array], x: Array, i: int, near: list[tuple[int, Array]]
) -> Array:
    """Return Eqs. 5.26 and 5.27 of the thesis, SD, of scaled inputs."""
    z = x / SCALE @ w["conv.lin.weight"].T
    a = softmax([float(leaky(z[i] @ z[j] / np.sqrt(LATENT))) for j, _ in near])
    heard = np.sum([a_j * z[j] for a_j, (j, _) in zip(a, near, strict=True)], axis=0)
    return SCALE * (heard + w["conv.bias"])


def transformer(
    w: dict[str, Array], x: Array, i: int, near: list[tuple[int, Array]]
) -> Array:
    """Return Shi et al. (2021), Eqs. 3 and 4, with a linear skip connection."""
    key, query, value, skip = (
        x @ w[f"conv.lin_{name}.weight"].T + w[f"conv.lin_{name}.bias"]
        for name in ("key", "query", "value", "skip")
    )
    told = [(j, w["conv.lin_edge.weight"] @ e) for j, e in near]
    a = (
        softmax([query[i] @ (key[j] + e) / np.sqrt(LATENT) for j, e in told])
        if near
        else []
    )
    return skip[i] + np.sum(
        [a_j * (value[j] + e) for a_j, (j, e) in zip(a, told, strict=True)], axis=0
    )


def gns(w: dict[str, Array], x: Array, i: int, near: list[tuple[int, Array]]) -> Array:
    """Return the sum of Sanchez-Gonzalez et al. (2020)."""
    return np.sum([np.zeros(LATENT), *(e for _, e in near)], axis=0)


Equation = Callable[[dict[str, Array], Array, int, list[tuple[int, Array]]], Array]
EQUATIONS: list[tuple[type[Operator], Equation, bool]] = [
    (GNS, gns, False),
    (GAT, gat, True),
    (GATv2, gatv2, True),
    (SuperGAT, supergat_mx, True),
    (SuperGATDot, supergat_sd, True),
    (Transformer, transformer, False),
]


@pytest.mark.parametrize(("operator", "equation", "loop"), EQUATIONS)
def test_equation(operator: type[Operator], equation: Equation, loop: bool) -> None:
    """What a node gathers is the published equation, summed over neighbours one by
    one.
    """
    inputs = small()
    layer = built(operator, scale=0.4)
    x = inputs.node.double().numpy()
    w = weights(layer)
    expected = [
        equation(w, x, i, neighbours(inputs, i, loop=loop)) for i in range(len(x))
    ]
    np.testing.assert_allclose(updated(layer, inputs), expected, rtol=1e-9, atol=1e-9)


def test_pointnet_is_that_of_pyg() -> None:
    """With relative positions as edges, PointNet is PyG's PointNetConv."""
    inputs = small()
    layer = built(PointNet)
    assert isinstance(layer, PointNet)
    position = torch.randn(len(inputs.node), LATENT, dtype=torch.float64)
    sender, receiver = inputs.edge_index
    local = torch.nn.Sequential(
        torch.nn.Linear(3 * LATENT, HIDDEN).double(), *copy.deepcopy(layer.local)
    )
    with torch.no_grad():
        local[0].weight[:] = torch.cat(
            [layer.of_node.weight, layer.of_edge.weight], dim=1
        )
        local[0].bias[:] = layer.of_node.bias
    with torch.random.fork_rng():
        theirs = PointNetConv()  # Its constructor would reset the weights.
    theirs.local_nn = local
    x = inputs.node.double()
    ours = layer(x, inputs.edge_index, position[sender] - position[receiver])[0]
    torch.testing.assert_close(
        ours, theirs(x, position, inputs.edge_index), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("operator", OPERATORS)
def test_order_and_lack_of_edges(operator: type[Operator]) -> None:
    """Particles in another order get the same updates in that order; the order of edges
    is nothing.

    Without any edge updates and gradients are finite.
    """
    inputs = small()
    layer = built(operator).eval()
    order = torch.randperm(len(inputs.node), generator=torch.Generator().manual_seed(3))
    edges = torch.randperm(len(inputs.edge), generator=torch.Generator().manual_seed(4))
    place = torch.argsort(order)
    mixed = Graph(
        inputs.node[order], place[inputs.edge_index][:, edges], inputs.edge[edges]
    )
    np.testing.assert_allclose(
        updated(layer, mixed), updated(layer, inputs)[order], rtol=1e-9, atol=1e-9
    )

    layer = built(operator)
    alone = Graph(
        torch.randn(3, 2 * LATENT),
        torch.empty(2, 0, dtype=torch.int64),
        torch.empty(0, LATENT),
    )
    alone.edge.requires_grad_()  # a plain sum has no weights
    update, losses = layer(alone.node.double(), alone.edge_index, alone.edge.double())
    total = update.sum() + sum(losses.values())
    assert update.isfinite().all()
    total.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in layer.parameters())


def test_unlinked_pairs() -> None:
    """Pairs are neither edges nor loops, every other pair comes up, and the same seed
    gives the same.
    """
    inputs = small()
    pairs = draw_unlinked_pairs(
        inputs.edge_index, 9, 20_000, torch.Generator().manual_seed(5)
    )
    drawn = set(map(tuple, pairs.t().tolist()))
    linked = set(map(tuple, inputs.edge_index.t().tolist()))
    every = {(j, i) for j in range(9) for i in range(9) if i != j}
    assert drawn == every - linked  # 72 - 24 = 48 pairs in 20,000 draws of 81
    again = draw_unlinked_pairs(
        inputs.edge_index, 9, 20_000, torch.Generator().manual_seed(5)
    )
    assert torch.equal(pairs, again)


def test_link_loss() -> None:
    """The link loss is the cross entropy of edges, loops and unlinked pairs (Eq. 5.28),
    by hand.
    """
    inputs = small()
    layer = built(SuperGAT, scale=0.4)
    _, losses = layer(
        inputs.node.double(),
        inputs.edge_index,
        inputs.edge,
        generator=torch.Generator().manual_seed(2),
    )
    pairs = draw_unlinked_pairs(
        inputs.edge_index, 9, 12, torch.Generator().manual_seed(2)
    ).numpy()
    z = inputs.node.double().numpy() / SCALE @ weights(layer)["conv.lin.weight"].T
    links = np.concatenate(
        [inputs.edge_index.numpy(), np.tile(np.arange(9), (2, 1))], axis=1
    )
    likely = 1 / (1 + np.exp(-np.sum(z[links[0]] * z[links[1]], axis=1)))
    unlikely = 1 / (1 + np.exp(-np.sum(z[pairs[0]] * z[pairs[1]], axis=1)))
    expected = -np.mean(np.concatenate([np.log(likely), np.log(1 - unlikely)]))
    assert losses["link"].item() == pytest.approx(expected, rel=1e-9)
    assert not layer.eval()(inputs.node.double(), inputs.edge_index, inputs.edge)[1]


def test_link_loss_starts_low_and_decreases() -> None:
    """At the widths of a recipe it starts near 1, not 1000; SuperGAT learns who are
    neighbours.
    """
    torch.manual_seed(0)
    wide = graph(300, 2400, node=256, edge=128)
    wide.node[:, 128:] *= 8.0  # sums of about 8 normalised messages
    assert 0.3 < SuperGAT(256, 128, 128)(*wide)[1]["link"].item() < 3.0
    torch.manual_seed(0)
    inputs = graph(40, 200, node=32, edge=16)
    layer = SuperGAT(32, 16, 16)
    inputs.node.mul_(8.0)  # sums of about 8 normalised messages
    source = torch.Generator().manual_seed(0)
    optimizer = torch.optim.Adam(layer.parameters(), lr=1e-2)
    course = []
    for _ in range(60):
        loss = layer(*inputs, generator=source)[1]["link"]
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        course.append(loss.item())
    assert np.mean(course[-5:]) < 0.75 * np.mean(course[:5])


def test_draws_leave_global_sources_alone() -> None:
    """Training SuperGAT draws from the given generator only, the same for the same
    seed.

    The layer can be copied afterwards: no graph of gradients hangs on it.
    """
    (node, edge_index, edge), layer = small(), built(SuperGAT, scale=0.4)

    def states() -> tuple[object, ...]:
        return (
            random.getstate(),
            torch.get_rng_state().tolist(),
            np.random.get_state()[1].tolist(),  # noqa: NPY002
        )

    before = states()
    losses = [
        layer(
            node.double(),
            edge_index,
            edge,
            generator=torch.Generator().manual_seed(seed),
        )[1]["link"].item()
        for seed in (0, 0, 1)
    ]
    assert states() == before
    assert losses[0] == losses[1] != losses[2]
    copied = copy.deepcopy(layer)
    assert all(
        torch.equal(a, b)
        for a, b in zip(layer.parameters(), copied.parameters(), strict=True)
    )
