"""Transfer and slopes in two and three dimensions, between walls and periodic."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.data.grid import (
    Grid,
    Placement,
    curl,
    differentiable_nodes,
    divergence,
    fields,
    slope_along,
    transfer,
    vorticity,
)

Floats = NDArray[np.float64]

UNIT = (0.0, 1.0)
WALLED = Box.from_bounds([UNIT, UNIT])
CHANNEL = Box.from_bounds([UNIT, UNIT], periodic=[True, False])
TORUS = Box.from_bounds([UNIT, UNIT], periodic=[True, True])
SOLID = Box.from_bounds([UNIT, UNIT, UNIT])
SOLID_CHANNEL = Box.from_bounds(
    [UNIT, UNIT, (0.25, 0.75)],
    periodic=[False, True, True],
)
SOLID_TORUS = Box.from_bounds(
    [(-0.5, 1.0), UNIT, (0.0, 0.5)],
    periodic=[True, True, True],
)
BOXES = (WALLED, CHANNEL, TORUS, SOLID, SOLID_CHANNEL, SOLID_TORUS)
PERIODIC_BOXES = (CHANNEL, TORUS, SOLID_CHANNEL, SOLID_TORUS)
EVERY_BOX = pytest.mark.parametrize("box", BOXES)
EVERY_PERIODIC_BOX = pytest.mark.parametrize("box", PERIODIC_BOXES)
EVERY_PLACEMENT = pytest.mark.parametrize("placement", list(Placement))


def node_places(grid: Grid) -> Floats:
    """Return the positions of all nodes [length], shape [*node, axis]."""
    axes = [grid.places(axis) for axis in range(grid.dimension)]
    coordinates = np.meshgrid(*axes, indexing="ij")
    return np.stack(coordinates, axis=-1)


def lattice(box: Box, per_length: int) -> Floats:
    """Return particles that fill a box evenly, shape [particle, axis]."""
    axes = []
    for low, length in zip(box.low, box.lengths, strict=True):
        count = round(float(length) * per_length)
        places = (np.arange(count) + 0.5) / per_length
        axes.append(low + places)
    coordinates = np.meshgrid(*axes, indexing="ij")
    points = np.stack(coordinates, axis=-1)
    return points.reshape(-1, box.dimension)


def random_points(rng: np.random.Generator, box: Box, *shape: int) -> Floats:
    """Return points of a box, shape [..., axis]."""
    share = rng.random((*shape, box.dimension))
    return np.asarray(box.low) + box.lengths * share


def inner(field: Floats, box: Box, rim: int) -> Floats:
    """Cut off the nodes within a rim along axes with walls."""
    cut = []
    for is_periodic in box.periodic:
        if is_periodic:
            cut.append(slice(None))
        else:
            cut.append(slice(rim, -rim))
    return field[tuple(cut)]


@EVERY_PLACEMENT
@EVERY_BOX
def test_a_constant_velocity_stays_constant_and_full(
    box: Box, placement: Placement
) -> None:
    grid = Grid(8, placement, box)
    x = lattice(box, 16)
    velocity = np.arange(1.0, 1.0 + box.dimension)
    full = grid.full_weight(len(x), box.volume)
    uniform = np.broadcast_to(velocity, x.shape)
    result = fields(x, uniform, grid, full=full)
    assert result.weight.shape == grid.shape
    density = inner(result.density, box, 2)
    assert_allclose(density, 1.0, rtol=1e-12)
    for axis, component in enumerate(velocity):
        component_of_nodes = result.velocity[..., axis]
        nodes = inner(component_of_nodes, box, 2)
        assert_allclose(nodes, component, rtol=1e-12)


@EVERY_PERIODIC_BOX
def test_weights_sum_to_the_particles_where_no_wall_cuts_the_stencil(box: Box) -> None:
    rng = np.random.default_rng(1)
    grid = Grid(8, Placement.CELL_CENTRES, box)
    margin = np.where(box.periodic, 0.0, 0.2)
    room = box.lengths - 2.0 * margin
    share = rng.random((200, box.dimension))
    x = box.low + margin + room * share
    u = rng.standard_normal(x.shape)
    sums = transfer(x, u, grid)
    weight = sums.weight.sum()
    assert weight == pytest.approx(200.0, rel=1e-12)
    momentum = sums.momentum.reshape(-1, box.dimension)
    total_momentum = momentum.sum(axis=0)
    assert_allclose(total_momentum, u.sum(axis=0), rtol=1e-10)


@EVERY_PLACEMENT
@EVERY_PERIODIC_BOX
def test_a_shift_by_a_cell_along_a_periodic_axis_rolls_the_fields(
    box: Box, placement: Placement
) -> None:
    rng = np.random.default_rng(2)
    grid = Grid(8, placement, box)
    x = random_points(rng, box, 150)
    u = rng.standard_normal(x.shape)
    before = transfer(x, u, grid)
    for axis, is_periodic in enumerate(box.periodic):
        if not is_periodic:
            continue
        shift = np.zeros(box.dimension)
        shift[axis] = grid.spacing
        after = transfer(x + shift, u, grid)
        rolled = np.roll(before.weight, 1, axis=axis)
        assert_allclose(after.weight, rolled, atol=1e-10)
        rolled = np.roll(before.momentum, 1, axis=axis)
        assert_allclose(after.momentum, rolled, atol=1e-10)


@pytest.mark.parametrize("box", [TORUS, SOLID, SOLID_CHANNEL])
def test_particles_that_are_nowhere_carry_no_weight(box: Box) -> None:
    grid = Grid(8, Placement.CELL_CENTRES, box)
    x = np.full((3, box.dimension), 0.5)
    x[1, 0] = np.nan
    x[2, -1] = np.inf
    u = np.ones_like(x)
    sums = transfer(x, u, grid)
    assert sums.weight.sum() == pytest.approx(1.0)


def test_the_curl_of_a_rigid_rotation_is_twice_its_rate() -> None:
    grid = Grid(9, Placement.NODES, SOLID)
    rate = np.array([0.2, -0.3, 0.5])
    arm = node_places(grid) - 0.5
    velocity = np.cross(rate, arm)
    omega = curl(velocity, grid.spacing)
    assert omega.shape == (*grid.shape, 3)
    inner_omega = inner(omega, SOLID, 1)
    expected = np.broadcast_to(2.0 * rate, inner_omega.shape)
    assert_allclose(inner_omega, expected, atol=1e-12)

    plane = Grid(9, Placement.NODES)
    arm = node_places(plane) - 0.5
    x, y = np.moveaxis(arm, -1, 0)
    velocity = np.stack([-0.5 * y, 0.5 * x], axis=-1)
    omega = curl(velocity, plane.spacing)
    inner_omega = inner(omega, WALLED, 1)
    assert_allclose(inner_omega, 1.0, atol=1e-12)


def test_the_generic_curl_agrees_with_that_between_walls_in_two_dimensions() -> None:
    rng = np.random.default_rng(3)
    velocity = rng.standard_normal((7, 9, 2))
    u = velocity[..., 0]
    v = velocity[..., 1]
    slope_of_v = slope_along(v, -2, 0.1)
    slope_of_u = slope_along(u, -1, 0.1)
    generic = slope_of_v - slope_of_u
    between_walls = vorticity(velocity, 0.1)
    assert_allclose(generic, between_walls, atol=1e-12)
    periodic = curl(velocity, 0.1, [True, False])
    assert_allclose(periodic[1:-1], between_walls[1:-1], atol=1e-12)


@EVERY_BOX
def test_the_divergence_of_the_position_is_the_dimension_between_walls(
    box: Box,
) -> None:
    grid = Grid(8, Placement.CELL_CENTRES, box)
    velocity = node_places(grid)
    periodic_axes = list(box.periodic)
    velocity[..., periodic_axes] = 0.3  # the position jumps at a period
    walled_axes = box.dimension - sum(box.periodic)
    rate = divergence(velocity, grid.spacing, box.periodic)
    inner_rate = inner(rate, box, 1)
    assert_allclose(inner_rate, walled_axes, atol=1e-12)


def test_slopes_of_a_wave_have_no_seam_along_a_periodic_axis() -> None:
    grid = Grid(16, Placement.CELL_CENTRES, SOLID_TORUS)
    x = node_places(grid)
    waves = 2.0 * np.pi / SOLID_TORUS.lengths
    # Central differences of sin(k x) are cos(k x) sin(k h) / h.
    for axis, wave in enumerate(waves):
        phase = wave * x[..., axis]
        slope = slope_along(
            np.sin(phase),
            axis - 3,
            grid.spacing,
            is_periodic=True,
        )
        factor = np.sin(wave * grid.spacing) / grid.spacing
        expected = factor * np.cos(phase)
        assert_allclose(slope, expected, atol=1e-12)


@EVERY_BOX
def test_a_node_is_differentiable_where_all_its_neighbours_count(box: Box) -> None:
    rng = np.random.default_rng(4)
    grid = Grid(6, Placement.CELL_CENTRES, box)
    counted = rng.random(grid.shape) < 0.8
    result = differentiable_nodes(counted, box.periodic)
    for node in np.ndindex(counted.shape):
        expected = True
        for axis, count in enumerate(counted.shape):
            for step in (-1, 1):
                place = node[axis] + step
                if box.periodic[axis]:
                    place %= count
                if not 0 <= place < count:
                    expected = False
                    continue
                neighbour = (*node[:axis], place, *node[axis + 1 :])
                expected = expected and bool(counted[neighbour])
        assert result[node] == expected


def test_fields_of_a_batch_are_those_of_its_frames() -> None:
    rng = np.random.default_rng(5)
    grid = Grid(6, Placement.CELL_CENTRES, SOLID_CHANNEL)
    x = random_points(rng, SOLID_CHANNEL, 2, 300)
    u = rng.standard_normal(x.shape)
    full = grid.full_weight(300, SOLID_CHANNEL.volume)
    batch = fields(x, u, grid, full=full)
    for frame in range(2):
        position = x[frame]
        velocity = u[frame]
        single = fields(position, velocity, grid, full=full)
        assert_array_equal(batch.vorticity[frame], single.vorticity)
        assert_array_equal(batch.divergence[frame], single.divergence)
