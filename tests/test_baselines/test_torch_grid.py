"""Differentiable grids: fields, transfers between particles and nodes, gradients."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from torch import Tensor
from torch.testing import assert_close

from lagbench.baselines import torch_grid
from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.data import grid as reference
from lagbench.data.grid import Grid, Placement, transfer

GRIDS = [
    Grid(8),
    Grid(8, Placement.NODES),
    Grid(11),
]
FIELD_NAMES = ("weight", "velocity", "density", "vorticity", "divergence")


def draw_particles(
    *shape: int,
    seed: int = 0,
    low: float = 0.0,
    high: float = 1.0,
) -> tuple[Any, Any]:
    """Return positions and velocities of shape [..., 2] in float64."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(low, high, (*shape, 2))
    velocity = 0.01 * rng.normal(size=(*shape, 2))
    return position, velocity


def draw_tensors(count: int, **draw: Any) -> tuple[Tensor, Tensor]:
    """Return positions and velocities of shape [count, 2] as float64 tensors."""
    position, velocity = draw_particles(count, **draw)
    return to_tensor(position), to_tensor(velocity)


def to_tensor(array: NDArray[np.float64], dtype: torch.dtype = torch.float64) -> Tensor:
    """Return an array as a tensor of the type."""
    return torch.from_numpy(array).to(dtype)


def compute_fields(
    position: Tensor,
    velocity: Tensor,
    grid: Grid,
    *,
    full: float,
    counted: Any = None,
    **windows: Any,
) -> Any:
    """Return the fields of particles; `full` is the weight of a full cell."""
    sums = torch_grid.transfer(position, velocity, grid, **windows)
    return torch_grid.tensor_fields(sums, grid, full, counted)


def compare_fields(
    fields: torch_grid.Fields,
    expected: reference.Fields,
    tolerance: float,
) -> None:
    """Compare every field with the scorer's.

    Vorticity and divergence are 0 where those of the scorer are NaN.
    """
    np.testing.assert_array_equal(
        fields.differentiable.numpy(), expected.differentiable
    )
    for name in FIELD_NAMES:
        field = getattr(fields, name).numpy()
        truth = np.nan_to_num(getattr(expected, name))
        scale = np.abs(truth).max()
        assert_allclose(field, truth, rtol=0, atol=tolerance * scale)


@pytest.mark.parametrize("grid", GRIDS, ids=str)
@pytest.mark.parametrize(
    ("dtype", "tolerance"),
    [
        (torch.float64, 1e-13),
        (torch.float32, 1e-5),
    ],
)
def test_fields_are_those_of_the_scorer(
    grid: Grid,
    dtype: torch.dtype,
    tolerance: float,
) -> None:
    """Some of the particles lie at the walls and beyond them."""
    position, velocity = draw_particles(2, 3, 500, low=-0.02, high=1.02)
    position = position.astype(np.float32)
    velocity = velocity.astype(np.float32)
    full = grid.full_weight(500, 1.0)

    expected = reference.fields(position, velocity, grid, full=full)
    assert expected.differentiable.any()
    assert not expected.differentiable.all()

    fields = compute_fields(
        to_tensor(position, dtype),
        to_tensor(velocity, dtype),
        grid,
        full=full,
    )
    compare_fields(fields, expected, tolerance)


def test_windows_side_by_side_are_as_alone() -> None:
    """Each window has its own fields, whatever its number of particles.

    The second of the three windows is empty.
    """
    grid = Grid(6)
    full = 4.0
    position, velocity = draw_particles(350)
    position_tensor = to_tensor(position)
    velocity_tensor = to_tensor(velocity)
    counts = [150, 0, 200]
    repeats = torch.tensor(counts)
    sample = torch.arange(3).repeat_interleave(repeats)

    fields = compute_fields(
        position_tensor,
        velocity_tensor,
        grid,
        full=full,
        sample=sample,
        windows=3,
    )
    for window, end in enumerate(np.cumsum(counts)):
        members = slice(end - counts[window], end)
        alone = reference.fields(
            position[members],
            velocity[members],
            grid,
            full=full,
        )
        window_velocity = fields.velocity[window].numpy()
        window_weight = fields.weight[window].numpy()
        assert_allclose(window_velocity, alone.velocity, atol=1e-15)
        assert_allclose(window_weight, alone.weight, atol=1e-12)

    # The number of windows follows from the samples.
    sums = torch_grid.transfer(
        position_tensor,
        velocity_tensor,
        grid,
        sample=sample,
    )
    assert torch.equal(sums.weight, fields.weight)


def test_counted_nodes_may_be_those_of_the_truth() -> None:
    """A prediction that leaves the truth's nodes empty has velocity 0 there."""
    grid = Grid(6)
    full = grid.full_weight(400, 1.0)
    position, velocity = draw_particles(400)
    shrunk = position / 2

    truth = reference.fields(position, velocity, grid, full=full)
    counted = truth.counted
    expected = reference.fields(
        shrunk,
        velocity,
        grid,
        full=full,
        counted=counted,
    )
    fields = compute_fields(
        to_tensor(shrunk),
        to_tensor(velocity),
        grid,
        full=full,
        counted=torch.from_numpy(counted),
    )
    compare_fields(fields, expected, 1e-12)


GRADIENT_FIELDS = ["density", "velocity", "vorticity", "divergence"]


@pytest.mark.parametrize("name", GRADIENT_FIELDS)
@pytest.mark.parametrize("cells", [4, 5])
def test_gradients_are_those_of_finite_differences(name: str, cells: int) -> None:
    """Positions and velocities both have gradients."""
    grid = Grid(cells)
    position, velocity = draw_tensors(40, seed=3, low=-0.05, high=0.9)
    velocity = 100 * velocity
    full = grid.full_weight(40, 0.9)
    start = compute_fields(position, velocity, grid, full=full)
    counted = start.counted
    assert counted.any()

    def field(position: Tensor, velocity: Tensor) -> Tensor:
        fields = compute_fields(
            position,
            velocity,
            grid,
            full=full,
            counted=counted,
        )
        return torch.as_tensor(getattr(fields, name))

    position.requires_grad_()
    velocity.requires_grad_()
    assert torch.autograd.gradcheck(field, (position, velocity))


def test_weight_and_momentum_are_conserved() -> None:
    """Away from the walls the weights of a particle sum to 1, wherever it is.

    So the gradient of the sum to its position is 0.
    """
    position, velocity = draw_tensors(30, low=0.3, high=0.7)
    position.requires_grad_()
    velocity.requires_grad_()

    sums = torch_grid.transfer(position, velocity, Grid(8))
    mass = sums.weight.sum()
    particle_count = torch.tensor(30.0).double()
    assert_close(mass, particle_count)

    total = mass + sums.momentum.sum()
    position_gradient, velocity_gradient = torch.autograd.grad(
        total, (position, velocity)
    )
    assert_close(velocity_gradient, torch.ones_like(velocity))
    greatest_slope = position_gradient.abs().max()
    assert float(greatest_slope) < 1e-12


def test_lost_particles_have_no_weight_and_no_gradient() -> None:
    """Particles outside the box or without a number change no field.

    All gradients stay numbers.
    """
    position, velocity = draw_tensors(50)
    position[0] = torch.tensor([1.5, 0.5])
    position[1] = torch.tensor([torch.nan, 0.5])
    position[2] = torch.tensor([0.5, -torch.inf])
    velocity[1] = float("nan")
    grid = Grid(6)

    other_position = position[3:].clone()
    other_velocity = velocity[3:].clone()
    expected = compute_fields(other_position, other_velocity, grid, full=2.0)
    position.requires_grad_()
    velocity.requires_grad_()
    fields = compute_fields(position, velocity, grid, full=2.0)
    assert_close(fields.velocity, expected.velocity)

    square_vorticity = fields.vorticity.square()
    square_density = fields.density.square()
    loss = square_vorticity.sum() + square_density.sum()
    loss.backward()
    for gradient in (position.grad, velocity.grad):
        assert bool(gradient.isfinite().all())
        assert not bool(gradient[:3].any())
        assert bool(gradient[3:].any())


Bounds = tuple[tuple[float, float], tuple[float, float]]
BOX = ((0.0625, 0.9375), (0.0625, 0.9375))
OBLONG_BOX = ((0.1, 0.9), (0.2, 0.5))


def draw_cloud(
    particles: int,
    seed: int = 0,
    low: float = 0.0625,
    high: float = 0.9375,
) -> Tensor:
    """Return random places in a square box, some of them on its walls and corners."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(low, high, (particles, 2))
    cloud = torch.from_numpy(places).float()
    cloud[0] = low
    cloud[1] = high
    cloud[2, 0] = high
    cloud[3, 1] = low
    return cloud


def one_window(particles: int) -> Tensor:
    """Return the sample numbers of particles of one window."""
    return torch.zeros(particles, dtype=torch.int64)


def spread_mass_of(grid: ParticleGrid, position: Tensor) -> Tensor:
    """Return the mass at the nodes of particles that weigh 1 each."""
    count = len(position)
    stencil = grid.stencil(position, one_window(count))
    mass = torch.ones(count, 1)
    sums = grid.spread(stencil, mass, 1)
    return sums[0, 0]


@pytest.mark.parametrize("cells", [4, 7, 18, 22])
@pytest.mark.parametrize("bounds", [BOX, OBLONG_BOX])
def test_weights_are_a_partition_of_unity(cells: int, bounds: Bounds) -> None:
    """Nine weights sum to 1 anywhere in the box, its walls and corners too."""
    grid = ParticleGrid(bounds, cells, multiple=4)
    low, high = torch.tensor(bounds).T
    unit_cloud = draw_cloud(500, low=0.0, high=1.0)
    place = low + unit_cloud * (high - low)
    place = place.clamp(low, high)
    stencil = grid.stencil(place, one_window(500))

    columns, rows = grid.shape
    total_weight = stencil.weight.sum(dim=1)
    assert float(stencil.weight.min()) >= 0.0
    assert_close(total_weight, torch.ones(500))
    assert int(stencil.node.min()) >= 0
    assert int(stencil.node.max()) < columns * rows
    mass = spread_mass_of(grid, place)
    assert float(mass.sum()) == pytest.approx(500, rel=1e-5)

    # Quadratic B-splines reproduce the plane 2 + 3 x - 5 y.
    x, y = place.T
    node_x = grid.axis_x[:, None]
    node_y = grid.axis_y
    plane = 2.0 + 3.0 * node_x - 5.0 * node_y
    gathered = grid.gather(stencil, plane[None, None])[:, 0]
    expected = 2.0 + 3.0 * x - 5.0 * y
    assert_close(gathered, expected, rtol=0, atol=1e-5)


def test_spread_is_the_scorers_transfer() -> None:
    """On the unit box the inner nodes are those of the scorer's grid."""
    place = draw_cloud(400, low=0.1, high=0.9)
    generator = torch.Generator().manual_seed(0)
    velocity = torch.randn(400, 2, generator=generator)
    unit_square = ((0.0, 1.0), (0.0, 1.0))
    grid = ParticleGrid(unit_square, 16)

    stencil = grid.stencil(place, one_window(400))
    mass = torch.ones(400, 1)
    mass_and_momentum = torch.cat([mass, velocity], dim=1)
    sums = grid.spread(stencil, mass_and_momentum, 1)
    inner = sums[0, :, 1:-1, 1:-1]
    weight = inner[0]
    momentum = inner[1:].permute(1, 2, 0)

    expected = transfer(place.numpy(), velocity.numpy(), Grid(16))
    assert_allclose(weight, expected.weight, atol=2e-5)
    assert_allclose(momentum, expected.momentum, atol=2e-5)


def test_gather_is_the_adjoint_of_spread() -> None:
    """<spread(v), g> = <v, gather(g)>, in two layers."""
    generator = torch.Generator().manual_seed(0)
    grid = ParticleGrid(BOX, 9, multiple=4)
    place = draw_cloud(200)
    layer = torch.randint(2, (200,), generator=generator)
    value = torch.randn(200, 3, generator=generator)
    field = torch.randn(2, 3, *grid.shape, generator=generator)

    stencil = grid.stencil(place, layer)
    spread = grid.spread(stencil, value, 2)
    gathered = grid.gather(stencil, field)
    on_nodes = (spread.double() * field).sum()
    on_particles = (value.double() * gathered).sum()
    expected = float(on_particles)
    assert float(on_nodes) == pytest.approx(expected, rel=1e-5)

    # The particles of one layer give what they give alone.
    first = layer == 0
    first_stencil = grid.stencil(place[first], layer[first])
    alone = grid.spread(first_stencil, value[first], 1)
    assert_close(spread[:1], alone)


def test_walls_lie_between_two_rows_of_nodes() -> None:
    """The nodes beside a wall are half a cell from it, on both sides."""
    grid = ParticleGrid(BOX, 7)
    distance = grid.wall_distance(1.0)
    for wall, beside in enumerate(grid.beside_walls()):
        nodes_along = grid.shape[wall // 2]
        assert int(beside.sum()) == 2 * nodes_along
        nearest = distance[wall][beside.bool()].abs()
        half_cell = torch.full_like(nearest, grid.spacing / 2)
        assert_close(nearest, half_cell)
