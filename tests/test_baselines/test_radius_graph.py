"""The radius graph against brute force, by NumPy and by the operations of a GPU."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from lagbench.baselines.graph import edge_numbers, radius_graph
from lagbench.errors import UsageError

Floats = NDArray[np.float32]
Search = Callable[..., Tensor]


def search_by_torch(
    position: Tensor,
    radius: float,
    sample: Tensor | None,
    *,
    self_edges: bool,
) -> Tensor:
    """Search by the operations that a GPU runs."""
    if sample is None:
        sample = torch.zeros(len(position), dtype=torch.int64)
    exact = position.double()
    numbers = edge_numbers(torch, exact, sample, radius, self_edges)
    numbers = numbers.sort().values
    sender = numbers & 0xFFFFFFFF
    receiver = numbers >> 32
    return torch.stack([sender, receiver])


BOTH = pytest.mark.parametrize(
    "search",
    [radius_graph, search_by_torch],
    ids=["numpy", "torch"],
)


def brute_force(
    x: Floats,
    radius: float,
    sample: Any = None,
    self_edges: bool = False,
) -> NDArray[np.int64]:
    """Compare every pair; return [sender, receiver] by receiver, then by sender."""
    with np.errstate(invalid="ignore", over="ignore"):
        exact = x.astype(np.float64)
        difference = exact[:, None] - exact
        dx = difference[..., 0]
        dy = difference[..., 1]
        is_near = dx * dx + dy * dy <= radius * radius
    if sample is not None:
        is_near &= sample[:, None] == sample
    if not self_edges:
        np.fill_diagonal(is_near, val=False)
    receiver, sender = np.nonzero(is_near)
    return np.stack([sender, receiver])


def compare_with_brute_force(
    search: Search,
    x: Floats,
    radius: float,
    sample: Any = None,
    self_edges: bool = False,
) -> int:
    """Compare all edges in their order, and return the number of edges."""
    sample_tensor = None
    if sample is not None:
        sample_tensor = torch.from_numpy(sample)
    position = torch.from_numpy(x)
    edges = search(
        position,
        radius,
        sample_tensor,
        self_edges=self_edges,
    )
    assert edges.dtype == torch.int64
    expected = brute_force(x, radius, sample, self_edges)
    np.testing.assert_array_equal(edges.numpy(), expected)
    return edges.shape[1]


def uniform(count: int, seed: int) -> Floats:
    """Return random particles in the unit square."""
    rng = np.random.default_rng(seed)
    return rng.random((count, 2), dtype=np.float32)


def lattice(side: int, spacing: float) -> Floats:
    """Return side x side particles, shape [particle, 2]."""
    axis = np.arange(side) * spacing
    columns, rows = np.meshgrid(axis, axis, indexing="ij")
    points = np.stack([columns, rows], axis=-1)
    return points.reshape(-1, 2).astype(np.float32)


@BOTH
@pytest.mark.parametrize("radius", [0.004, 0.03, 0.2, 2.0])
@pytest.mark.parametrize("self_edges", [False, True])
def test_random_particles(
    search: Search,
    radius: float,
    self_edges: bool,
) -> None:
    """Uniform particles, from hardly any edge to all pairs."""
    x = uniform(400, seed=1)
    edge_count = compare_with_brute_force(search, x, radius, self_edges=self_edges)
    assert edge_count > 400 * self_edges


@BOTH
def test_clustered_particles(search: Search) -> None:
    """Dense clumps, particles in the very same place, and lone particles far off."""
    rng = np.random.default_rng(2)
    centres = rng.random((6, 1, 2))
    spread = rng.normal(size=(6, 60, 2))
    clumps = centres + 0.01 * spread
    clumps = clumps.reshape(-1, 2)
    far_off = rng.uniform(-50.0, 50.0, (30, 2))
    all_points = np.concatenate([clumps, clumps[:20], far_off])
    x = all_points.astype(np.float32)
    assert compare_with_brute_force(search, x, 0.015) > 6 * 60


@BOTH
def test_pairs_exactly_at_the_radius_are_edges(search: Search) -> None:
    """On a lattice of 1/8 with radius 1/8 the four direct neighbours count."""
    x = lattice(9, 0.125)
    below = np.nextafter(0.125, 0.0)
    # 9 x 9 particles: 2 * 9 * 8 = 144 pairs, both ways
    assert compare_with_brute_force(search, x, 0.125) == 288
    assert compare_with_brute_force(search, x, below) == 0


@BOTH
def test_diagonal_pairs_exactly_at_the_radius_are_edges(search: Search) -> None:
    """Offsets (3, 4) and (0, 5) of a lattice of 1/64 are both at distance 5/64."""
    nodes = np.array(
        [
            [0, 0],
            [3, 4],
            [4, -3],
            [0, 5],
            [-5, 0],
            [4, 4],
        ]
    )
    x = (nodes / 64).astype(np.float32)
    edges = brute_force(x, 5 / 64)
    is_at_origin = (edges == 0).any(axis=0)
    assert is_at_origin.sum() == 2 * 4
    compare_with_brute_force(search, x, 5 / 64)


@BOTH
@pytest.mark.parametrize("spacing", [0.1, 0.015, 1 / 3])
def test_radius_that_float32_cannot_hold(search: Search, spacing: float) -> None:
    """Rounding decides which neighbours are within the radius, as in brute force."""
    x = lattice(12, spacing)
    edge_count = compare_with_brute_force(search, x, spacing)
    assert 0 < edge_count < 2 * 2 * 12 * 11  # some of the 264 pairs fall outside


@BOTH
@pytest.mark.parametrize("radius", [0.1, 0.7, 5.0])
def test_windows_are_never_connected(search: Search, radius: float) -> None:
    """The same particles in three windows have thrice the edges of one.

    A fourth window is empty.
    """
    x = uniform(80, seed=3)
    alone = compare_with_brute_force(search, x, radius)
    three_windows = np.tile(x, (3, 1))
    sample = np.repeat([0, 1, 3], 80)
    together = compare_with_brute_force(search, three_windows, radius, sample)
    assert together == 3 * alone


@BOTH
def test_few_particles(search: Search) -> None:
    """No particle has no edges, one particle only the edge to itself."""
    none = np.zeros((0, 2), np.float32)
    one = np.ones((1, 2), np.float32)
    of_none = compare_with_brute_force(search, none, 0.1, self_edges=True)
    of_one = compare_with_brute_force(search, one, 0.1)
    with_itself = compare_with_brute_force(search, one, 0.1, self_edges=True)
    assert of_none == 0
    assert of_one == 0
    assert with_itself == 1


@BOTH
def test_diverged_particles_have_no_wrong_edge(search: Search) -> None:
    """They are no number or immensely far; all other particles keep their edges."""
    x = uniform(60, seed=4)
    x[5] = np.nan
    x[6] = np.inf
    x[7, 0] = -np.inf
    x[8] = 1e30
    x[9] = 1e30
    x[10] = [-3e38, 2.0]
    x[11] = [5e4, 5e4]
    x[12] = [5e4, 5e4 + 0.0625]
    edge_count = compare_with_brute_force(search, x, 0.1, self_edges=True)
    assert edge_count > 60
    all_lost = np.full((3, 2), np.nan, np.float32)
    assert compare_with_brute_force(search, all_lost, 0.1) == 0


@BOTH
@given(
    cells=arrays(
        np.int8,
        st.tuples(st.integers(0, 25), st.just(2)),
        elements=st.integers(-6, 6),
    ),
    steps=st.integers(1, 7),
)
@settings(max_examples=60, deadline=None)
def test_any_lattice_points(
    search: Search,
    cells: NDArray[np.int8],
    steps: int,
) -> None:
    """Points of a lattice, many together, and radii that are multiples of its step."""
    x = (cells / 16).astype(np.float32)
    compare_with_brute_force(search, x, steps / 16)


def test_scipy_agrees() -> None:
    """SciPy's tree finds the same pairs among 5000 particles."""
    x = uniform(5000, seed=5)
    tree = cKDTree(x.astype(np.float64))
    pairs = tree.query_pairs(0.015, output_type="ndarray")
    position = torch.from_numpy(x)
    edges = radius_graph(position, 0.015).numpy()
    assert edges.shape[1] == 2 * len(pairs)
    sender, receiver = edges
    once = edges[:, sender < receiver].T
    edge_set = np.unique(once, axis=0)
    pair_set = np.unique(pairs, axis=0)
    np.testing.assert_array_equal(edge_set, pair_set)


def test_positions_may_have_gradients_and_any_precision() -> None:
    """The search takes positions as they are stored."""
    generator = torch.Generator().manual_seed(0)
    x = torch.rand(50, 2, dtype=torch.float64, generator=generator)
    edges = radius_graph(x, 0.2)
    with_gradient = x.clone().requires_grad_()
    assert torch.equal(radius_graph(with_gradient, 0.2), edges)
    coarse = x.bfloat16()
    coarse_edges = radius_graph(coarse, 0.2)
    rounded_edges = radius_graph(coarse.float(), 0.2)
    assert torch.equal(coarse_edges, rounded_edges)


FLAT = torch.zeros(4, 2)
SOLID = torch.zeros(4, 3)
THREE_WINDOWS = torch.tensor([0, 0, 0])
OUT_OF_ORDER = torch.tensor([0, 1, 0])


@pytest.mark.parametrize(
    ("position", "radius", "sample", "words"),
    [
        (SOLID, 0.1, None, "wrong shape"),
        (FLAT, 0.0, None, "no length"),
        (FLAT, math.nan, None, "no length"),
        (FLAT, 0.1, THREE_WINDOWS, "do not fit"),
        (FLAT[:3], 0.1, OUT_OF_ORDER, "do not fit"),
    ],
)
def test_what_does_not_fit_is_refused(
    position: Tensor,
    radius: float,
    sample: Tensor | None,
    words: str,
) -> None:
    """Wrong shapes, a radius that is none and windows out of order are errors."""
    with pytest.raises(UsageError, match=words):
        radius_graph(position, radius, sample)


def heap_of_twelve() -> Floats:
    """Return 120 particles, twelve of them in one place and one of them nowhere."""
    rng = np.random.default_rng(1)
    x = rng.random((120, 2), np.float32)
    x[40:52] = x[40]
    x[100] = np.nan
    return x


@pytest.mark.parametrize("most", [1, 3, 7, 60])
def test_each_receiver_keeps_its_shortest_edges(most: int) -> None:
    """With a limit that all edges meet it is the graph of brute force."""
    x = heap_of_twelve()
    sample = np.repeat([0, 1], 60)
    radius = 0.25
    senders, receivers = brute_force(x, radius, sample)
    exact = x.astype(float)
    difference = exact[senders] - exact[receivers]
    lengths = np.sum(difference**2, axis=1)
    length_of_pair = {}
    for number, length in enumerate(lengths):
        pair = (senders[number], receivers[number])
        length_of_pair[pair] = length

    edges = radius_graph(
        torch.from_numpy(x),
        radius,
        torch.from_numpy(sample),
        most=most,
    ).numpy()
    edge_count = edges.shape[1]
    distinct = np.unique(edges, axis=1)
    assert distinct.shape[1] == edge_count
    # The order is by receiver, then by sender.
    order = np.lexsort(edges)
    np.testing.assert_array_equal(order, np.arange(edge_count))
    for receiver in range(len(x)):
        edge_senders = edges[0, edges[1] == receiver]
        edge_lengths = []
        for sender in edge_senders:
            edge_lengths.append(length_of_pair[sender, receiver])
        edge_lengths.sort()
        all_lengths = sorted(lengths[receivers == receiver])
        assert edge_lengths == all_lengths[:most]


@pytest.mark.parametrize("most", [1, 3, 7, 60])
def test_each_particle_keeps_its_self_edge(most: int) -> None:
    """The particle that is nowhere has none."""
    position = torch.from_numpy(heap_of_twelve())
    edges = radius_graph(position, 0.25, self_edges=True, most=most)
    sender, receiver = edges.numpy()
    self_edges = sender[sender == receiver]
    assert set(self_edges) == set(range(120)) - {100}


def test_a_heap_takes_bounded_memory() -> None:
    """Ten thousand particles in one place have as many edges as the limit allows.

    Without a limit they would have a hundred million.
    """
    heap = torch.full((10_000, 2), 0.5)
    edges = radius_graph(heap, 0.01, most=4)
    assert edges.shape == (2, 40_000)
    edges_per_receiver = edges[1].bincount()
    expected = torch.full((10_000,), 4)
    assert torch.equal(edges_per_receiver, expected)
