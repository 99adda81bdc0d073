"""The radius graph against brute force."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from lagbench.baselines.graph import radius_graph

Floats = NDArray[np.float32]


def brute_force(
    x: Floats,
    radius: float,
    sample: Any = None,
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
    np.fill_diagonal(is_near, val=False)
    receiver, sender = np.nonzero(is_near)
    return np.stack([sender, receiver])


def compare_with_brute_force(
    x: Floats,
    radius: float,
    sample: Any = None,
) -> int:
    """Compare all edges in their order, and return the number of edges."""
    sample_tensor = None
    if sample is not None:
        sample_tensor = torch.from_numpy(sample)
    position = torch.from_numpy(x)
    edges = radius_graph(
        position,
        radius,
        sample_tensor,
    )
    assert edges.dtype == torch.int64
    expected = brute_force(x, radius, sample)
    np.testing.assert_array_equal(edges.numpy(), expected)
    return edges.shape[1]


def uniform(count: int, seed: int) -> Floats:
    """Return random particles in the unit square."""
    rng = np.random.default_rng(seed)
    return rng.random((count, 2), dtype=np.float32)


@pytest.mark.parametrize("radius", [0.1, 0.7, 5.0])
def test_windows_are_never_connected(radius: float) -> None:
    """The same particles in three windows have thrice the edges of one.

    A fourth window is empty.
    """
    x = uniform(80, seed=3)
    alone = compare_with_brute_force(x, radius)
    three_windows = np.tile(x, (3, 1))
    sample = np.repeat([0, 1, 3], 80)
    together = compare_with_brute_force(three_windows, radius, sample)
    assert together == 3 * alone


def test_diverged_particles_have_no_wrong_edge() -> None:
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
    edge_count = compare_with_brute_force(x, 0.1)
    assert edge_count > 60
    all_lost = np.full((3, 2), np.nan, np.float32)
    assert compare_with_brute_force(all_lost, 0.1) == 0


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
    cells: NDArray[np.int8],
    steps: int,
) -> None:
    """Points of a lattice, many together, and radii that are multiples of its step."""
    x = (cells / 16).astype(np.float32)
    compare_with_brute_force(x, steps / 16)
