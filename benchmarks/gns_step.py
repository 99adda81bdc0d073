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


def plain_update(
    self: EdgeMLP, edge: Tensor, node: Tensor, edge_index: Tensor
) -> Tensor:
    """Return the edge update by the product of the whole concatenation."""
    sender, receiver = edge_index
    receiver_node = node[receiver]
    sender_node = node[sender]
    parts = [edge, receiver_node, sender_node]
    features = torch.cat(parts, dim=1)
    hidden = self.first(features)
    update: Tensor = self.rest(hidden)
    return update


def use_conventional(options: argparse.Namespace) -> None:
    """Put the chosen conventional parts in place of ours."""
    if options.edge_layer == "plain":
        EdgeMLP.forward = plain_update  # type: ignore[method-assign]
    if options.products == "torch":
        layers.linear = nn.functional.linear  # type: ignore[assignment]
    if options.hidden == "kept":
        layers.LARGEST_KEPT = math.inf


def make_graph(count: int, windows: int) -> Tensor:
    """Return a graph with about 8 neighbours per particle, shape [2, edge].

    In each window the particles lie in the first cells of a square lattice, one in each
    cell. No edge leads from one window to another.
    """
    side = math.ceil(math.sqrt(count))
    cell = torch.arange(side)
    lattice = torch.cartesian_prod(cell, cell)
    corner = lattice[:count]
    random = torch.Generator().manual_seed(0)
    offset = torch.rand(count * windows, 2, generator=random)
    position = corner.repeat(windows, 1) + offset
    window_of_particle = torch.arange(windows).repeat_interleave(count)
    edge_index: Tensor = radius_graph(position, RADIUS, window_of_particle)
    return edge_index


def make_model(options: argparse.Namespace) -> EncodeProcessDecode:
    """Return a graph network with the chosen operator."""
    (point,) = entry_points(group="lagbench.baselines", name=options.operator)
    torch.manual_seed(0)
    model = EncodeProcessDecode(
        point.load(),
        node_features=NODE_FEATURES,
        edge_features=EDGE_FEATURES,
        latent=options.latent,
        layers=options.layers,
    )
    if options.compiled:
        model.compile_layers()
    return model


def make_step(
    options: argparse.Namespace, model: EncodeProcessDecode, edge_index: Tensor
) -> Callable[[], None]:
    """Return a training step of a model on a graph."""
    rows = options.particles * options.windows
    edges = edge_index.shape[1]
    node = torch.randn(rows, NODE_FEATURES)
    edge = torch.randn(edges, EDGE_FEATURES)
    target = torch.randn(rows, 2)
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4)
    source = torch.Generator().manual_seed(0)

    uses_bfloat16 = options.precision == "bfloat16"

    def step() -> None:
        with torch.autocast("cpu", torch.bfloat16, enabled=uses_bfloat16):
            output, losses = model(node, edge_index, edge, source)
        error = nn.functional.mse_loss(output, target)
        loss = error + sum(losses.values())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


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
        "--precision",
        choices=("float32", "bfloat16"),
        default="float32",
    )
    parser.add_argument(
        "--edge-layer",
        choices=("split", "plain"),
        default="split",
    )
    parser.add_argument(
        "--products",
        choices=("onednn", "torch"),
        default="onednn",
    )
    parser.add_argument("--compiled", action="store_true")
    parser.add_argument(
        "--hidden",
        choices=("recomputed", "kept"),
        default="recomputed",
    )
    options = parser.parse_args()
    torch.set_num_threads(1)
    use_conventional(options)
    model = make_model(options)
    edge_index = make_graph(options.particles, options.windows)
    step = make_step(options, model, edge_index)
    step()
    seconds = []
    for _ in range(options.steps):
        start_time = time.process_time()
        step()
        seconds.append(time.process_time() - start_time)
    usage = resource.getrusage(resource.RUSAGE_SELF)
    parameter_count = 0
    for parameter in model.parameters():
        parameter_count += parameter.numel()
    result = {
        "processor_seconds": min(seconds),
        "peak_bytes": 1024 * usage.ru_maxrss,
        "edges": edge_index.shape[1],
        "parameters": parameter_count,
    }
    print(json.dumps(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
