"""Training steps of a graph network on random particles, one core: time and memory.

    python benchmarks/gns_step.py --operator gns --precision bfloat16
    python benchmarks/gns_step.py --particles 2048 --windows 2 --latent 64 --layers 5

prints one JSON object: processor seconds of the fastest step (network, mean square
error, backward pass, Adam; without neighbour search, features and grid losses), its
peak memory [byte], edges and parameters. ``--edge-layer plain`` multiplies the
concatenation of an edge and its ends, as public codes do, ``--products torch`` uses
torch's linear layer, ``--hidden kept`` never computes a hidden layer twice.
``--compiled`` compiles the processor layers (``training.compile``).
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import time
from collections.abc import Callable
from importlib.metadata import entry_points

import torch
from torch import Tensor, nn

from lagbench.baselines import network as layers
from lagbench.baselines.graph import radius_graph
from lagbench.baselines.network import EdgeMLP, EncodeProcessDecode

NODE_FEATURES = 30
EDGE_FEATURES = 3
RADIUS = 1.72
"""Connectivity radius in cells of the lattice."""


def plain(self: EdgeMLP, edge: Tensor, node: Tensor, edge_index: Tensor) -> Tensor:
    """Return the edge update by the product of the whole concatenation."""
    sender, receiver = edge_index
    whole = torch.cat([edge, node[receiver], node[sender]], dim=1)
    update: Tensor = self.rest(self.first(whole))
    return update


def conventional(given: argparse.Namespace) -> None:
    """Put the conventional parts that were asked for in place of ours."""
    if given.edge_layer == "plain":
        EdgeMLP.forward = plain
    if given.products == "torch":
        layers._fast = lambda x, weight: False
    if given.hidden == "kept":
        layers.LARGEST_KEPT = math.inf


def particles(count: int, windows: int) -> Tensor:
    """Return a graph with about 8 neighbours: a box full of particles, one in each cell
    of a lattice.
    """
    side = math.ceil(math.sqrt(count))
    lattice = torch.cartesian_prod(torch.arange(side), torch.arange(side))[:count]
    source = torch.Generator().manual_seed(0)
    position = lattice.repeat(windows, 1) + torch.rand(
        count * windows, 2, generator=source
    )
    sample = torch.arange(windows).repeat_interleave(count)
    edge_index: Tensor = radius_graph(position, RADIUS, sample)
    return edge_index


def one_step(given: argparse.Namespace) -> tuple[Callable[[], None], dict[str, int]]:
    """Return a training step, and edges and parameters that it works on."""
    (point,) = entry_points(group="lagbench.baselines", name=given.operator)
    torch.manual_seed(0)
    model = EncodeProcessDecode(
        point.load(),
        node_features=NODE_FEATURES,
        edge_features=EDGE_FEATURES,
        latent=given.latent,
        layers=given.layers,
    )
    if given.compiled:
        model.compile_layers()
    edge_index = particles(given.particles, given.windows)
    rows = given.particles * given.windows
    edges = edge_index.shape[1]
    node = torch.randn(rows, NODE_FEATURES)
    edge = torch.randn(edges, EDGE_FEATURES)
    target = torch.randn(rows, 2)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4)
    source = torch.Generator().manual_seed(0)

    def step() -> None:
        with torch.autocast(
            "cpu", torch.bfloat16, enabled=given.precision == "bfloat16"
        ):
            output, losses = model(node, edge_index, edge, source)
        loss = nn.functional.mse_loss(output, target) + sum(losses.values())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step, {
        "edges": edges,
        "parameters": sum(p.numel() for p in model.parameters()),
    }


def main() -> int:
    """Time the steps and print what they took."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--operator", default="gns")
    parser.add_argument("--particles", type=int, default=8192)
    parser.add_argument("--windows", type=int, default=1)
    parser.add_argument("--latent", type=int, default=128)
    parser.add_argument("--layers", type=int, default=10)
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument(
        "--precision", choices=("float32", "bfloat16"), default="float32"
    )
    parser.add_argument("--edge-layer", choices=("split", "plain"), default="split")
    parser.add_argument("--products", choices=("onednn", "torch"), default="onednn")
    parser.add_argument("--compiled", action="store_true")
    parser.add_argument(
        "--hidden", choices=("recomputed", "kept"), default="recomputed"
    )
    given = parser.parse_args()
    torch.set_num_threads(1)
    conventional(given)
    step, found = one_step(given)
    step()
    seconds = []
    for _ in range(given.steps):
        start = time.process_time()
        step()
        seconds.append(time.process_time() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(json.dumps({"processor_seconds": min(seconds), "peak_bytes": peak} | found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
