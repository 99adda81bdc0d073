"""Grid transfer against closed forms, a direct sum and its own invariants."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lagbench.data import grid as gridding
from lagbench.data.grid import Fields, Grid, Placement
from lagbench.errors import UsageError

Floats = NDArray[np.float64]
BOTH = pytest.mark.parametrize("placement", list(Placement))


def lattice(grid: Grid, per_cell: int = 2) -> Floats:
    """Fill the unit box with per_cell x per_cell particles in every cell, symmetric
    about its centre.
    """
    axis = (np.arange(grid.cells * per_cell) + 0.5) / (grid.cells * per_cell)
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)


def fields_of(x: NDArray[np.floating[Any]], u: Floats, grid: Grid) -> Fields:
    """Form the fields of particles that fill the unit box."""
    return gridding.fields(x, u, grid, full=grid.full_weight(x.shape[-2], 1.0))


def deep(field: Floats) -> Floats:
    """Cut off the nodes whose stencils or neighbours' stencils meet the rim of the
    material.
    """
    return field[..., 3:-3, 3:-3]


FLOWS: dict[str, tuple[Callable[[Floats, Floats], tuple[Any, Any]], float, float]] = {
    "solid-body rotation, 2 Omega": (
        lambda x, y: (-0.3 * (y - 0.5), 0.3 * (x - 0.5)),
        0.6,
        0.0,
    ),
    "shear u = S y": (lambda x, y: (0.7 * y, 0.0 * y), -0.7, 0.0),
    "expansion u = r": (lambda x, y: (x, y), 0.0, 2.0),
}


@BOTH
@pytest.mark.parametrize("name", FLOWS)
def test_linear_flows_have_their_rates(placement: Placement, name: str) -> None:
    """Vorticity and divergence are exact to rounding on a lattice; the signs of the
    terms are not swapped.
    """
    flow, vorticity, divergence = FLOWS[name]
    grid = Grid(20, placement)
    x = lattice(grid)
    f = fields_of(x, np.stack(flow(*x.T), axis=-1), grid)
    np.testing.assert_allclose(deep(f.vorticity), vorticity, atol=1e-12)
    np.testing.assert_allclose(deep(f.divergence), divergence, atol=1e-12)


@BOTH
def test_rigid_translation_is_exact_for_any_particles(placement: Placement) -> None:
    """Every node with particles carries the common velocity; the field is constant."""
    rng = np.random.default_rng(1)
    x = rng.random((900, 2))
    f = fields_of(x, np.broadcast_to([0.3, -0.2], x.shape), Grid(12, placement))
    filled = f.weight >= gridding.EMPTY_SHARE * f.full
    assert filled.sum() > 100
    np.testing.assert_allclose(
        f.velocity[filled], np.tile([0.3, -0.2], (filled.sum(), 1)), rtol=1e-14
    )


def taylor_green(x: Floats) -> tuple[Floats, Floats]:
    """Return velocity and vorticity of the Taylor-Green vortex psi = sin(2 pi x) sin(2
    pi y) / (2 pi).
    """
    k = 2.0 * np.pi
    s = np.sin(k * x)
    c = np.cos(k * x)
    u = np.stack([s[..., 0] * c[..., 1], -c[..., 0] * s[..., 1]], axis=-1)
    return u, 2.0 * k * s[..., 0] * s[..., 1]


@BOTH
def test_taylor_green_converges_with_second_order(placement: Placement) -> None:
    """Halving h divides the vorticity error by four."""
    errors = []
    for cells in (20, 40, 80):
        grid = Grid(cells, placement)
        x = lattice(grid)
        nodes = np.stack(np.meshgrid(grid.axis, grid.axis, indexing="ij"), axis=-1)
        f = fields_of(x, taylor_green(x)[0], grid)
        errors.append(np.abs(deep(f.vorticity - taylor_green(nodes)[1])).max())
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(np.abs(orders - 2.0) < 0.1), (errors, orders)


def test_taylor_green_of_scattered_particles_converges_with_their_number() -> None:
    """On a fixed grid the error of random particles falls like one over the root of
    their number.
    """
    rng = np.random.default_rng(2)
    grid = Grid(20)
    reference = fields_of(lattice(grid, 8), taylor_green(lattice(grid, 8))[0], grid)
    errors = []
    for count in (10_000, 160_000):
        x = rng.random((count, 2))
        f = fields_of(x, taylor_green(x)[0], grid)
        errors.append(np.sqrt(np.mean(deep(f.vorticity - reference.vorticity) ** 2)))
    assert 3.0 < errors[0] / errors[1] < 5.0  # sqrt(16) = 4


@BOTH
@given(seed=st.integers(0, 2**32 - 1), cells=st.integers(2, 9))
@settings(max_examples=30, deadline=None)
def test_weights_are_a_partition_of_unity(
    placement: Placement, seed: int, cells: int
) -> None:
    """Particles deep in the box give all their weight and momentum to the grid, sums
    equal counts.
    """
    rng = np.random.default_rng(seed)
    grid = Grid(cells + 6, placement)
    x = 2.0 / grid.cells + (1.0 - 4.0 / grid.cells) * rng.random((50, 2))
    u = rng.normal(size=x.shape)
    sums = gridding.transfer(x, u, grid)
    assert sums.weight.min() >= 0.0
    np.testing.assert_allclose(sums.weight.sum(), 50.0, rtol=1e-13)
    np.testing.assert_allclose(
        sums.momentum.sum(axis=(0, 1)), u.sum(axis=0), atol=1e-12
    )


def spline(s: Floats) -> Floats:
    """Evaluate the quadratic B-spline as its defining convolution integrates:
    piecewise, by distance.
    """
    a = np.abs(s)
    return np.where(
        a <= 0.5, 0.75 - a**2, np.where(a <= 1.5, 0.5 * (1.5 - a) ** 2, 0.0)
    )


@BOTH
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_transfer_equals_the_sum_over_all_pairs(
    placement: Placement, seed: int
) -> None:
    """The scattered sums equal sum_p w(x_i - x_p) over every node and particle, at the
    walls as well.
    """
    rng = np.random.default_rng(seed)
    grid = Grid(7, placement)
    x = np.concatenate(
        [rng.random((40, 2)), [[0.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.5, 1.0]]]
    )
    u = rng.normal(size=x.shape)
    # [node, particle, axis]
    along = spline((grid.axis[:, None, None] - x) / grid.spacing)
    weight = np.einsum("ip,kp->ikp", along[..., 0], along[..., 1])
    sums = gridding.transfer(x, u, grid)
    np.testing.assert_allclose(sums.weight, weight.sum(axis=-1), atol=1e-13)
    np.testing.assert_allclose(sums.momentum, weight @ u, atol=1e-12)


def test_a_batch_has_the_bits_of_its_frames() -> None:
    """Leading axes change nothing: scenario and frame axes equal single frames to the
    bit.

    The order of particles changes nothing but rounding.
    """
    rng = np.random.default_rng(4)
    grid = Grid(9, Placement.NODES)
    x = rng.random((2, 3, 200, 2)).astype(np.float32)
    u = rng.normal(size=(2, 3, 200, 2))
    batch = fields_of(x, u, grid)
    assert batch.vorticity.shape == (2, 3, 10, 10)
    order = rng.permutation(200)
    for frame in np.ndindex(2, 3):
        single = fields_of(x[frame], u[frame], grid)
        for name in ("weight", "velocity", "vorticity", "divergence"):
            np.testing.assert_array_equal(
                getattr(batch, name)[frame], getattr(single, name)
            )
        permuted = fields_of(x[frame][order], u[frame][order], grid)
        np.testing.assert_allclose(permuted.velocity, single.velocity, atol=1e-12)
        np.testing.assert_allclose(permuted.vorticity, single.vorticity, atol=1e-10)
        np.testing.assert_array_equal(permuted.counted, single.counted)


def test_wall_nodes_count_and_corner_nodes_do_not() -> None:
    """In a box full of material walls through nodes have half a full weight, corners a
    quarter.
    """
    grid = Grid(40)
    lo = 2.5 / 40  # cavity full: node 2 lies on the wall
    x = lo + 0.875 * lattice(Grid(35))
    full = grid.full_weight(len(x), 0.875**2)
    f = gridding.fields(x, np.zeros_like(x), grid, full=full)
    assert full == pytest.approx(4.0)  # 4900 particles / 35^2 cells
    assert f.density[20, 20] == pytest.approx(1.0)
    assert f.density[2, 20] == pytest.approx(0.5)
    assert f.density[2, 2] == pytest.approx(0.25)
    expected = np.zeros((40, 40), bool)
    expected[2:-2, 2:-2] = True
    expected[[2, 2, -3, -3], [2, -3, 2, -3]] = False
    np.testing.assert_array_equal(f.counted, expected)


def test_vorticity_stands_where_four_neighbours_count() -> None:
    """A node next to one that does not count, or on the rim of the grid, has no
    vorticity.
    """
    counted = np.ones((6, 6), bool)
    counted[2, 3] = False
    expected = np.zeros((6, 6), bool)
    expected[1:-1, 1:-1] = True
    expected[[1, 3, 2, 2], [3, 3, 2, 4]] = False
    np.testing.assert_array_equal(gridding.differentiable_nodes(counted), expected)


def test_nodes_that_a_prediction_leaves_empty_have_velocity_zero() -> None:
    """Below a thousandth of a full weight the velocity is 0, above it is the
    particles'.
    """
    momentum = np.array([[[0.0, 0.0], [1.0, 1.0], [8.2e-3, 0.0]]])
    sums = gridding.Transfer(np.array([[0.0, 3.9e-3, 4.1e-3]]), momentum)
    np.testing.assert_allclose(
        gridding.node_velocity(sums, 4.0), [[[0.0, 0.0], [0.0, 0.0], [2.0, 0.0]]]
    )


def test_the_mask_of_the_truth_decides_for_a_prediction() -> None:
    """A prediction scored with the truth's mask is defined exactly where the truth
    counts.
    """
    grid = Grid(12)
    x = lattice(grid)
    truth = fields_of(x, x, grid)
    prediction = gridding.fields(
        0.5 * x, x, grid, full=truth.full, counted=truth.counted
    )
    np.testing.assert_array_equal(
        np.isnan(prediction.vorticity), np.isnan(truth.vorticity)
    )
    assert np.isfinite(prediction.vorticity).any()


@pytest.mark.parametrize("value", [-1e-9, 1.0 + 1e-9, np.nan, np.inf, -np.inf, 1e300])
def test_particles_outside_the_box_carry_no_weight(value: float) -> None:
    """Particles beyond the unit box, or nowhere, change nothing and raise nothing."""
    rng = np.random.default_rng(5)
    grid = Grid(8)
    x = rng.random((60, 2))
    u = rng.normal(size=(60, 2))
    stray = np.concatenate([x, [[value, 0.5], [0.5, value]]])
    sums = gridding.transfer(stray, np.concatenate([u, [[9.0, 9.0]] * 2]), grid)
    np.testing.assert_array_equal(sums.weight, gridding.transfer(x, u, grid).weight)
    np.testing.assert_array_equal(sums.momentum, gridding.transfer(x, u, grid).momentum)


@pytest.mark.parametrize(("x", "u"), [((5, 2), (4, 2)), ((5, 3), (5, 3)), ((2,), (2,))])
def test_wrong_shapes_are_named(x: tuple[int, ...], u: tuple[int, ...]) -> None:
    """Arrays that do not fit are refused with both shapes; so is one cell, which has no
    neighbours.
    """
    with pytest.raises(UsageError) as caught:
        gridding.transfer(np.zeros(x), np.zeros(u), Grid(4))
    assert str(x) in str(caught.value)
    with pytest.raises(UsageError):
        Grid(1)
    assert not gridding.transfer(
        np.empty((0, 2)), np.empty((0, 2)), Grid(4)
    ).weight.any()
