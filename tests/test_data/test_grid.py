"""Grid transfer against closed forms, a direct sum and its own invariants."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from lagbench.data import grid as gridding
from lagbench.data.grid import Fields, Grid, Placement

Floats = NDArray[np.float64]
Flow = Callable[[Floats, Floats], tuple[Floats, Floats]]
BOTH = pytest.mark.parametrize("placement", list(Placement))


def lattice(grid: Grid, per_cell: int = 2) -> Floats:
    """Return per_cell x per_cell particles in every cell of the unit box."""
    count = grid.cells * per_cell
    axis = (np.arange(count) + 0.5) / count
    points = square_points(axis)
    return points.reshape(-1, 2)


def square_points(axis: Floats) -> Floats:
    """Return all pairs of coordinates, shape [x, y, 2]."""
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([x, y], axis=-1)


def fields_of(x: NDArray[np.floating[Any]], u: Floats, grid: Grid) -> Fields:
    """Form the fields of particles that fill the unit box."""
    particle_count = x.shape[-2]
    full = grid.full_weight(particle_count, 1.0)
    return gridding.fields(x, u, grid, full=full)


def deep(field: Floats) -> Floats:
    """Cut off the nodes whose own or neighbours' stencils meet the rim."""
    return field[..., 3:-3, 3:-3]


def rotation(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the velocity of a solid-body rotation with Omega = 0.3."""
    arm_x = x - 0.5
    arm_y = y - 0.5
    return -0.3 * arm_y, 0.3 * arm_x


def shear(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the velocity u = S y with S = 0.7."""
    return 0.7 * y, np.zeros_like(x)


def expansion(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the velocity u = r."""
    return x, y


@BOTH
@pytest.mark.parametrize(
    ("flow", "vorticity", "divergence"),
    [
        (rotation, 0.6, 0.0),
        (shear, -0.7, 0.0),
        (expansion, 0.0, 2.0),
    ],
)
def test_linear_flows_have_their_rates(
    placement: Placement,
    flow: Flow,
    vorticity: float,
    divergence: float,
) -> None:
    """Both are exact to rounding on a lattice; the signs are not swapped."""
    grid = Grid(20, placement)
    position = lattice(grid)
    x, y = position.T
    velocity = np.stack(flow(x, y), axis=-1)
    fields = fields_of(position, velocity, grid)
    inner_vorticity = deep(fields.vorticity)
    assert_allclose(inner_vorticity, vorticity, atol=1e-12)
    inner_divergence = deep(fields.divergence)
    assert_allclose(inner_divergence, divergence, atol=1e-12)


@BOTH
def test_rigid_translation_is_exact_for_any_particles(placement: Placement) -> None:
    """Every node with particles carries the common velocity; the field is constant."""
    rng = np.random.default_rng(1)
    position = rng.random((900, 2))
    common = [0.3, -0.2]
    velocity = np.broadcast_to(common, position.shape)
    fields = fields_of(position, velocity, Grid(12, placement))
    least_weight = gridding.EMPTY_SHARE * fields.full
    is_filled = fields.weight >= least_weight
    count = is_filled.sum()
    assert count > 100
    expected = np.tile(common, (count, 1))
    actual = fields.velocity[is_filled]
    assert_allclose(actual, expected, rtol=1e-14)


def taylor_green(position: Floats) -> tuple[Floats, Floats]:
    """Return velocity and vorticity of psi = sin(2 pi x) sin(2 pi y) / (2 pi)."""
    k = 2.0 * np.pi
    phase = k * np.moveaxis(position, -1, 0)
    sin_x, sin_y = np.sin(phase)
    cos_x, cos_y = np.cos(phase)
    u = sin_x * cos_y
    v = -cos_x * sin_y
    velocity = np.stack([u, v], axis=-1)
    vorticity = 2.0 * k * sin_x * sin_y
    return velocity, vorticity


def taylor_green_fields(position: Floats, grid: Grid) -> Fields:
    """Return the fields of particles that move with the vortex."""
    velocity, _ = taylor_green(position)
    return fields_of(position, velocity, grid)


@BOTH
def test_taylor_green_converges_with_second_order(placement: Placement) -> None:
    """Halving h divides the vorticity error by four."""
    errors = []
    for cells in (20, 40, 80):
        grid = Grid(cells, placement)
        fields = taylor_green_fields(lattice(grid), grid)
        nodes = square_points(grid.axis)
        _, exact = taylor_green(nodes)
        error = deep(fields.vorticity - exact)
        errors.append(np.abs(error).max())
    ratios = np.divide(errors[:-1], errors[1:])
    orders = np.log2(ratios)
    deviation = np.abs(orders - 2.0)
    assert np.all(deviation < 0.1), (errors, orders)


def test_taylor_green_of_scattered_particles_converges_with_their_number() -> None:
    """The error of random particles falls like one over the root of their number."""
    rng = np.random.default_rng(2)
    grid = Grid(20)
    even = lattice(grid, 8)
    reference = taylor_green_fields(even, grid)
    errors = []
    for count in (10_000, 160_000):
        position = rng.random((count, 2))
        fields = taylor_green_fields(position, grid)
        error = deep(fields.vorticity - reference.vorticity)
        mean_square = np.mean(error**2)
        errors.append(np.sqrt(mean_square))
    ratio = errors[0] / errors[1]
    assert 3.0 < ratio < 5.0  # sqrt(16) = 4


SEEDS = st.integers(0, 2**32 - 1)


@BOTH
@given(seed=SEEDS, cells=st.integers(2, 9))
@settings(max_examples=30, deadline=None)
def test_weights_are_a_partition_of_unity(
    placement: Placement, seed: int, cells: int
) -> None:
    """Particles deep in the box give all their weight and momentum to the grid."""
    rng = np.random.default_rng(seed)
    grid = Grid(cells + 6, placement)
    margin = 2.0 / grid.cells
    width = 1.0 - 2.0 * margin
    x = margin + width * rng.random((50, 2))
    u = rng.normal(size=x.shape)
    sums = gridding.transfer(x, u, grid)
    assert sums.weight.min() >= 0.0
    total = sums.weight.sum()
    assert total == pytest.approx(50.0, rel=1e-13)
    momentum = sums.momentum.sum(axis=(0, 1))
    expected = u.sum(axis=0)
    assert_allclose(momentum, expected, atol=1e-12)


def spline(s: Floats) -> Floats:
    """Return the quadratic B-spline, piecewise by distance."""
    distance = np.abs(s)
    inner = 0.75 - distance**2
    outer = 0.5 * (1.5 - distance) ** 2
    outside = np.where(distance <= 1.5, outer, 0.0)
    return np.where(distance <= 0.5, inner, outside)


@BOTH
@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_transfer_equals_the_sum_over_all_pairs(
    placement: Placement, seed: int
) -> None:
    """The scattered sums equal sum_p w(x_i - x_p), at the walls as well."""
    rng = np.random.default_rng(seed)
    grid = Grid(7, placement)
    inside = rng.random((40, 2))
    on_walls = [
        (0.0, 0.0),
        (1.0, 1.0),
        (0.0, 1.0),
        (0.5, 1.0),
    ]
    x = np.concatenate([inside, on_walls])
    u = rng.normal(size=x.shape)
    # [node, particle, axis]
    distance = grid.axis[:, None, None] - x
    along = spline(distance / grid.spacing)
    along_x = along[..., 0]
    along_y = along[..., 1]
    weight = np.einsum("ip,kp->ikp", along_x, along_y)
    sums = gridding.transfer(x, u, grid)
    total_weight = weight.sum(axis=-1)
    assert_allclose(sums.weight, total_weight, atol=1e-13)
    momentum = weight @ u
    assert_allclose(sums.momentum, momentum, atol=1e-12)


def test_a_batch_has_the_bits_of_its_frames() -> None:
    """Scenario and frame axes equal single frames to the bit.

    The order of particles changes nothing but rounding.
    """
    rng = np.random.default_rng(4)
    grid = Grid(9, Placement.NODES)
    shape = (2, 3, 200, 2)  # [scenario, frame, particle, axis]
    x = rng.random(shape).astype(np.float32)
    u = rng.normal(size=shape)
    batch = fields_of(x, u, grid)
    assert batch.vorticity.shape == (2, 3, 10, 10)
    order = rng.permutation(200)
    for frame in np.ndindex(2, 3):
        position = x[frame]
        velocity = u[frame]
        single = fields_of(position, velocity, grid)
        for name in (
            "weight",
            "velocity",
            "vorticity",
            "divergence",
        ):
            batch_field = getattr(batch, name)
            expected = getattr(single, name)
            assert_array_equal(batch_field[frame], expected)
        permuted = fields_of(position[order], velocity[order], grid)
        assert_allclose(permuted.velocity, single.velocity, atol=1e-12)
        assert_allclose(permuted.vorticity, single.vorticity, atol=1e-10)
        assert_array_equal(permuted.counted, single.counted)


def test_wall_nodes_count_and_corner_nodes_do_not() -> None:
    """Walls through nodes have half a full weight, corners a quarter."""
    grid = Grid(40)
    lo = 2.5 / 40  # cavity full: node 2 lies on the wall
    length = 0.875
    x = lo + length * lattice(Grid(35))
    at_rest = np.zeros_like(x)
    full = grid.full_weight(len(x), length**2)
    fields = gridding.fields(x, at_rest, grid, full=full)
    assert full == pytest.approx(4.0)  # 4900 particles / 35^2 cells
    density = fields.density
    assert density[20, 20] == pytest.approx(1.0)
    assert density[2, 20] == pytest.approx(0.5)
    assert density[2, 2] == pytest.approx(0.25)
    expected = np.zeros((40, 40), bool)
    expected[2:-2, 2:-2] = True
    for column in (2, -3):
        for row in (2, -3):
            expected[column, row] = False
    assert_array_equal(fields.counted, expected)


def test_nodes_that_a_prediction_leaves_empty_have_velocity_zero() -> None:
    """Below a thousandth of a full weight the velocity is 0."""
    weight = np.array([[0.0, 3.9e-3, 4.1e-3]])
    momentum = np.array(
        [
            [0.0, 0.0],
            [1.0, 1.0],
            [8.2e-3, 0.0],
        ]
    )
    sums = gridding.Transfer(weight, momentum[None])
    velocity = gridding.node_velocity(sums, 4.0)
    expected = [
        [0.0, 0.0],
        [0.0, 0.0],
        [2.0, 0.0],
    ]
    assert_allclose(velocity[0], expected)


def test_the_mask_of_the_truth_decides_for_a_prediction() -> None:
    """A prediction with the truth's mask is defined where the truth counts."""
    grid = Grid(12)
    x = lattice(grid)
    truth = fields_of(x, x, grid)
    prediction = gridding.fields(
        0.5 * x,
        x,
        grid,
        full=truth.full,
        counted=truth.counted,
    )
    missing = np.isnan(prediction.vorticity)
    assert_array_equal(missing, np.isnan(truth.vorticity))
    assert np.isfinite(prediction.vorticity).any()


@pytest.mark.parametrize(
    "value",
    [
        -1e-9,
        1.0 + 1e-9,
        np.nan,
        np.inf,
        -np.inf,
        1e300,
    ],
)
def test_particles_outside_the_box_carry_no_weight(value: float) -> None:
    """Particles beyond the unit box, or nowhere, change nothing and raise nothing."""
    rng = np.random.default_rng(5)
    grid = Grid(8)
    x = rng.random((60, 2))
    u = rng.normal(size=(60, 2))
    outside = [
        (value, 0.5),
        (0.5, value),
    ]
    all_positions = np.concatenate([x, outside])
    fast = np.full((2, 2), 9.0)
    all_velocities = np.concatenate([u, fast])
    sums = gridding.transfer(all_positions, all_velocities, grid)
    expected = gridding.transfer(x, u, grid)
    assert_array_equal(sums.weight, expected.weight)
    assert_array_equal(sums.momentum, expected.momentum)
