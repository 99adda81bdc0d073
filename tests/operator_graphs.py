"""Small graphs for the tests of the graph network."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from lagbench.baselines.operators.gat import GAT, GATv2
from lagbench.baselines.operators.gns import GNS
from lagbench.baselines.operators.operator import Operator
from lagbench.baselines.operators.pointnet import PointNet
from lagbench.baselines.operators.supergat import SuperGAT, SuperGATDot
from lagbench.baselines.operators.transformer import Transformer

__all__ = ["OPERATORS", "Graph", "graph"]

OPERATORS: tuple[type[Operator], ...] = (
    GNS,
    SuperGAT,
    SuperGATDot,
    GAT,
    GATv2,
    PointNet,
    Transformer,
)


class Graph(NamedTuple):
    """Node inputs, senders and receivers, edge inputs."""

    node: Tensor
    edge_index: Tensor
    edge: Tensor


def graph(nodes: int, edges: int, *, node: int, edge: int, seed: int = 0) -> Graph:
    """Return a random graph without loops or repeated edges; the last node has no edge at all."""
    source = torch.Generator().manual_seed(seed)
    linked = nodes - 1
    pairs = torch.cartesian_prod(torch.arange(linked), torch.arange(linked))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    chosen = pairs[torch.randperm(len(pairs), generator=source)[:edges]].t()
    by_receiver = torch.argsort(chosen[1] * nodes + chosen[0])
    return Graph(
        torch.randn(nodes, node, generator=source),
        chosen[:, by_receiver],
        torch.randn(edges, edge, generator=source),
    )
