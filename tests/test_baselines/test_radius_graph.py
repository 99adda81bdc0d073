"""The radius graph is that of brute force, on CPU and by the torch operations that a
GPU runs.
"""

from __future__ import annotations

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


def by_torch(
    position: Tensor, radius: float, sample: Tensor | None, *, self_edges: bool
) -> Tensor:
    """Search by the operations that a GPU runs."""
    window = torch.zeros(len(position), dtype=torch.int64) if sample is None else sample
    edges = (
        edge_numbers(torch, position.double(), window, radius, self_edges).sort().values
    )
    return torch.stack([edges & 0xFFFFFFFF, edges >> 32])


BOTH = pytest.mark.parametrize(
    "search", [radius_graph, by_torch], ids=["numpy", "torch"]
)


def brute_force(
    x: Floats, radius: float, sample: Any = None, self_edges: bool = False
) -> NDArray[np.int64]:
    """Compare every pair; [sender, receiver], sorted by receiver, then sender."""
    with np.errstate(invalid="ignore", over="ignore"):
        d = x[:, None].astype(np.float64) - x.astype(np.float64)
        near = d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] <= radius * radius
    if sample is not None:
        near &= sample[:, None] == sample
    if not self_edges:
        np.fill_diagonal(near, val=False)
    return np.stack(np.nonzero(near))[::-1]


def check(
    search: Search,
    x: Floats,
    radius: float,
    sample: Any = None,
    self_edges: bool = False,
) -> int:
    """Compare a search with brute force, order included; return the number of edges."""
    windows = None if sample is None else torch.from_numpy(sample)
    found = search(torch.from_numpy(x), radius, windows, self_edges=self_edges)
    assert found.dtype == torch.int64
    np.testing.assert_array_equal(
        found.numpy(), brute_force(x, radius, sample, self_edges)
    )
    return found.shape[1]


def lattice(side: int, spacing: float) -> Floats:
    """Return side x side particles, shape [particle, 2]."""
    axis = np.arange(side) * spacing
    return (
        np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
        .reshape(-1, 2)
        .astype(np.float32)
    )


@BOTH
@pytest.mark.parametrize("radius", [0.004, 0.03, 0.2, 2.0])
@pytest.mark.parametrize("self_edges", [False, True])
def test_random_particles(search: Search, radius: float, self_edges: bool) -> None:
    """Uniform particles, from hardly any edge to all pairs."""
    x = np.random.default_rng(1).random((400, 2), dtype=np.float32)
    assert check(search, x, radius, self_edges=self_edges) > 400 * self_edges


@BOTH
def test_clustered_particles(search: Search) -> None:
    """Dense clumps, some particles in the very same place, and lone particles far
    off.
    """
    rng = np.random.default_rng(2)
    centres = rng.random((6, 1, 2))
    clumps = (centres + 0.01 * rng.normal(size=(6, 60, 2))).reshape(-1, 2)
    x = np.concatenate([clumps, clumps[:20], rng.uniform(-50.0, 50.0, (30, 2))]).astype(
        np.float32
    )
    assert check(search, x, 0.015) > 6 * 60


@BOTH
def test_pairs_exactly_at_the_radius(search: Search) -> None:
    """On a lattice of 1/8 and radius 1/8 the four direct neighbours count, at
    equality.
    """
    # 9 x 9 particles: 2 * 9 * 8 = 144 pairs, both ways
    assert check(search, lattice(9, 0.125), 0.125) == 288
    assert check(search, lattice(9, 0.125), np.nextafter(0.125, 0.0)) == 0
    # offsets (3, 4) and (0, 5) of a lattice of 1/64 are both at distance 5/64
    x = (np.array([[0, 0], [3, 4], [4, -3], [0, 5], [-5, 0], [4, 4]]) / 64).astype(
        np.float32
    )
    to_origin = brute_force(x, 5 / 64)
    assert ((to_origin == 0).any(axis=0)).sum() == 2 * 4
    check(search, x, 5 / 64)


@BOTH
@pytest.mark.parametrize("spacing", [0.1, 0.015, 1 / 3])
def test_radius_that_float32_cannot_hold(search: Search, spacing: float) -> None:
    """Where rounding decides which neighbours are within the radius, it decides as in
    brute force.
    """
    x = lattice(12, spacing)
    edges = check(search, x, spacing)
    assert 0 < edges < 2 * 2 * 12 * 11  # some of the 264 pairs fall outside


@BOTH
@pytest.mark.parametrize("radius", [0.1, 0.7, 5.0])
def test_windows_are_never_connected(search: Search, radius: float) -> None:
    """The same particles in three windows, one of them empty, have thrice the edges of
    one.
    """
    x = np.random.default_rng(3).random((80, 2), dtype=np.float32)
    alone = check(search, x, radius)
    sample = np.repeat([0, 1, 3], 80)
    assert check(search, np.tile(x, (3, 1)), radius, sample) == 3 * alone


@BOTH
def test_few_and_diverged_particles(search: Search) -> None:
    """Nothing has no edges, one particle only the edge to itself.

    Particles that are no number or immensely far have no wrong edge; all others keep
    theirs.
    """
    nothing = np.zeros((0, 2), np.float32)
    assert check(search, nothing, 0.1, self_edges=True) == 0
    assert check(search, np.ones((1, 2), np.float32), 0.1) == 0
    assert check(search, np.ones((1, 2), np.float32), 0.1, self_edges=True) == 1

    x = np.random.default_rng(4).random((60, 2), dtype=np.float32)
    x[5] = np.nan
    x[6] = np.inf
    x[7, 0] = -np.inf
    x[8] = 1e30
    x[9] = 1e30
    x[10] = [-3e38, 2.0]
    x[11] = [5e4, 5e4]
    x[12] = [5e4, 5e4 + 0.0625]
    assert check(search, x, 0.1, self_edges=True) > 60
    assert check(search, np.full((3, 2), np.nan, np.float32), 0.1) == 0


@BOTH
@given(
    cells=arrays(
        np.int8, st.tuples(st.integers(0, 25), st.just(2)), elements=st.integers(-6, 6)
    ),
    steps=st.integers(1, 7),
)
@settings(max_examples=60, deadline=None)
def test_any_lattice_points(
    search: Search, cells: NDArray[np.int8], steps: int
) -> None:
    """Points of a lattice, many together, and radii that are multiples of its step."""
    check(search, (cells / 16).astype(np.float32), steps / 16)


def test_scipy_agrees() -> None:
    """SciPy's tree finds the same pairs among 5000 particles."""
    x = np.random.default_rng(5).random((5000, 2), dtype=np.float32)
    pairs = cKDTree(x.astype(np.float64)).query_pairs(0.015, output_type="ndarray")
    edges = radius_graph(torch.from_numpy(x), 0.015).numpy()
    once = edges[:, edges[0] < edges[1]].T
    np.testing.assert_array_equal(np.unique(once, axis=0), np.unique(pairs, axis=0))
    assert edges.shape[1] == 2 * len(pairs)


def test_it_has_no_gradient_and_any_precision() -> None:
    """Positions that require gradients, in float64 or bfloat16, are searched as they
    are stored.
    """
    x = torch.rand(
        50, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    assert torch.equal(
        radius_graph(x.clone().requires_grad_(), 0.2), radius_graph(x, 0.2)
    )
    coarse = x.bfloat16()
    assert torch.equal(radius_graph(coarse, 0.2), radius_graph(coarse.float(), 0.2))


@pytest.mark.parametrize(
    ("position", "radius", "sample", "words"),
    [
        (torch.zeros(4, 3), 0.1, None, "wrong shape"),
        (torch.zeros(4, 2), 0.0, None, "no length"),
        (torch.zeros(4, 2), float("nan"), None, "no length"),
        (torch.zeros(4, 2), 0.1, torch.zeros(3, dtype=torch.int64), "do not fit"),
        (torch.zeros(3, 2), 0.1, torch.tensor([0, 1, 0]), "do not fit"),
    ],
)
def test_what_does_not_fit_is_refused(
    position: Tensor, radius: float, sample: Tensor | None, words: str
) -> None:
    """Wrong shapes, a radius that is none and windows out of order are errors."""
    with pytest.raises(UsageError, match=words):
        radius_graph(position, radius, sample)


@pytest.mark.parametrize("most", [1, 3, 7, 60])
def test_the_nearest_neighbours_are_heard(most: int) -> None:
    """Of the edges of brute force each receiver keeps the shortest; where all are kept,
    it is the same graph.

    Twins at one place, windows, particles that are nowhere and loops as without a
    limit.
    """
    rng = np.random.default_rng(1)
    x = rng.random((120, 2), np.float32)
    x[40:52] = x[40]
    x[100] = np.nan  # a heap of twelve
    sample = np.repeat([0, 1], 60)
    radius = 0.25
    senders, receivers = brute_force(x, radius, sample)
    length = np.sum(
        (x[senders].astype(float) - x[receivers].astype(float)) ** 2, axis=1
    )
    found = radius_graph(
        torch.from_numpy(x), radius, torch.from_numpy(sample), most=most
    ).numpy()
    pairs = {(s, r): d for s, r, d in zip(senders, receivers, length, strict=True)}
    assert len(set(map(tuple, found.T))) == found.shape[1]
    assert np.array_equal(
        np.lexsort(found), np.arange(found.shape[1])
    )  # by receiver, then sender
    for receiver in range(len(x)):
        heard = sorted(pairs[s, receiver] for s in found[0, found[1] == receiver])
        assert heard == sorted(length[receivers == receiver])[:most]
    looped = radius_graph(
        torch.from_numpy(x), radius, self_edges=True, most=most
    ).numpy()
    assert set(looped[0, looped[0] == looped[1]]) == set(range(120)) - {100}


def test_a_heap_takes_bounded_memory() -> None:
    """Ten thousand particles at one place have the edges that are asked for, not a
    hundred million.
    """
    found = radius_graph(torch.full((10_000, 2), 0.5), 0.01, most=4)
    assert found.shape == (2, 40_000)
    assert torch.equal(found[1].bincount(), torch.full((10_000,), 4))
