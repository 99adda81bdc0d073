"""Seconds for the radius graph of 8192 particles, beside what others offer for it.

    OMP_NUM_THREADS=1 pytest benchmarks/test_radius_graph.py -s

All search the same particles (a disordered lattice in the cavity, radius 0.015, about
seven neighbours each) and must find as many edges. PyTorch computes all distances at
once; SciPy's cKDTree and scikit-learn, where it is installed, get float64.
``LAGBENCH_BENCH_DEVICE=cuda`` times the search on an NVIDIA GPU too.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable

import numpy as np
import pytest
import torch
from pytest_benchmark.fixture import BenchmarkFixture
from scipy.spatial import cKDTree
from timing import best_processor_seconds, best_seconds
from torch import Tensor

from lagbench.baselines.graph import radius_graph

TARGET = 3e-3
"""Target on one core of an EPYC server [s]; printed only."""

LEAST_GAIN = 10.0
"""Least processor time of all distances over ours."""

PARTICLES = 8192
RADIUS = 0.015


@pytest.fixture(scope="module")
def position() -> Tensor:
    """Particles of the cavity [length], shape [particle, 2]."""
    rng = np.random.Generator(np.random.PCG64(0))
    even_side = math.sqrt(PARTICLES)
    side = math.ceil(even_side)
    axis = np.arange(side) + 0.5
    grid_lines = np.meshgrid(axis, axis)
    lattice = np.stack(grid_lines, axis=-1)
    lattice = lattice.reshape(-1, 2)
    jitter = rng.normal(0.0, 0.3, (PARTICLES, 2))
    # in spacings, then in the box
    coordinates = lattice[:PARTICLES] + jitter
    position = 0.0625 + 0.875 * coordinates / side
    return torch.from_numpy(position.astype(np.float32))


def brute_force(position: Tensor) -> Tensor:
    """Return the pairs within the radius, from all distances in float64 in PyTorch."""
    exact = position.double()
    distance = torch.cdist(exact, exact, compute_mode="donot_use_mm_for_euclid_dist")
    is_near = distance <= RADIUS
    is_near.fill_diagonal_(False)
    return is_near.nonzero().T


def tree(position: Tensor) -> Tensor:
    """Query SciPy's tree for pairs and write each in both directions, unsorted."""
    exact = position.numpy().astype(np.float64)
    search_tree = cKDTree(exact, compact_nodes=False, balanced_tree=False)
    pairs = search_tree.query_pairs(RADIUS, output_type="ndarray")
    reversed_pairs = pairs[:, ::-1]
    edges = np.concatenate([pairs, reversed_pairs])
    return torch.from_numpy(edges.T)


def scikit_learn(position: Tensor) -> Tensor:
    """Query scikit-learn's neighbours graph."""
    neighbours = pytest.importorskip("sklearn.neighbors")
    x = position.numpy().astype(np.float64)
    graph = neighbours.radius_neighbors_graph(
        x,
        RADIUS,
        algorithm="kd_tree",
        include_self=False,
    )
    edges = np.stack(graph.nonzero())
    return torch.from_numpy(edges)


def test_radius_graph(benchmark: BenchmarkFixture, position: Tensor) -> None:
    """At most a tenth of the processor time of all distances.

    Milliseconds depend on the machine: they are printed beside the target.
    """

    def search() -> Tensor:
        edges: Tensor = radius_graph(position, RADIUS)
        return edges

    seconds = best_seconds(benchmark, search, rounds=50, warmup_rounds=3)
    _, edge_count = search().shape
    print(
        f"\nours: {seconds * 1e3:.2f} ms, {edge_count} edges "
        f"(target {TARGET * 1e3:.0f} ms)"
    )
    ours = best_processor_seconds(search, rounds=20)
    all_distances = best_processor_seconds(lambda: brute_force(position), rounds=2)
    benchmark.extra_info["times_faster"] = all_distances / ours
    print(f"all distances take {all_distances / ours:.0f} times the processor time")
    assert ours <= all_distances / LEAST_GAIN


@pytest.mark.parametrize(
    ("search", "rounds"),
    [
        (tree, 20),
        (scikit_learn, 5),
        (brute_force, 3),
    ],
)
def test_others(
    benchmark: BenchmarkFixture,
    position: Tensor,
    search: Callable[[Tensor], Tensor],
    rounds: int,
) -> None:
    """The others find as many edges."""
    seconds = best_seconds(
        benchmark,
        lambda: search(position),
        rounds=rounds,
        warmup_rounds=1,
    )
    print(f"\n{search.__name__}: {seconds * 1e3:.2f} ms")
    edges = search(position)
    our_edges = radius_graph(position, RADIUS)
    assert edges.shape == our_edges.shape


@pytest.mark.skipif(
    "LAGBENCH_BENCH_DEVICE" not in os.environ, reason="LAGBENCH_BENCH_DEVICE is not set"
)
def test_on_device(benchmark: BenchmarkFixture, position: Tensor) -> None:
    """On a GPU torch finds the same edges as NumPy on the CPU."""
    device = os.environ["LAGBENCH_BENCH_DEVICE"]
    moved = position.to(device)

    def search() -> Tensor:
        edges: Tensor = radius_graph(moved, RADIUS)
        if device.startswith("cuda"):
            torch.cuda.synchronize(device)
        return edges

    seconds = best_seconds(benchmark, search, rounds=50, warmup_rounds=5)
    print(f"\nours on {device}: {seconds * 1e3:.2f} ms")
    edges = search().cpu()
    assert torch.equal(edges, radius_graph(position, RADIUS))
