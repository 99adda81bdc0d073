"""The differentiable grids: fields are the scorer's, particles go to nodes and back,
gradients are right.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from lagbench.baselines import torch_grid
from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.data import grid as reference
from lagbench.data.grid import Grid, Placement, transfer
from lagbench.errors import UsageError

GRIDS = [Grid(8), Grid(8, Placement.NODES), Grid(11)]


def particles(
    *shape: int, seed: int = 0, low: float = 0.0, high: float = 1.0
) -> tuple[Any, Any]:
    """Return positions and velocities of shape [..., 2] in float64."""
    rng = np.random.default_rng(seed)
    return rng.uniform(low, high, (*shape, 2)), 0.01 * rng.normal(size=(*shape, 2))


def torches(
    *arrays: NDArray[np.float64], dtype: torch.dtype = torch.float64
) -> list[Tensor]:
    """Return arrays as tensors."""
    return [torch.from_numpy(array).to(dtype) for array in arrays]


def fields(
    x: Tensor, u: Tensor, grid: Grid, *, full: float, counted: Any = None, **where: Any
) -> Any:
    """Return the fields of particles."""
    return torch_grid.tensor_fields(
        torch_grid.transfer(x, u, grid, **where), grid, full, counted
    )


def compare(
    found: torch_grid.Fields, expected: reference.Fields, tolerance: float
) -> None:
    """Compare every field; vorticity and divergence are 0 where the scorer's are
    NaN.
    """
    np.testing.assert_array_equal(found.differentiable.numpy(), expected.differentiable)
    for name in ("weight", "velocity", "density", "vorticity", "divergence"):
        truth = np.nan_to_num(getattr(expected, name))
        scale = np.abs(truth).max()
        np.testing.assert_allclose(
            getattr(found, name).numpy(), truth, rtol=0, atol=tolerance * scale
        )


@pytest.mark.parametrize("grid", GRIDS, ids=str)
@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-13), (torch.float32, 1e-5)]
)
def test_fields_are_those_of_the_scorer(
    grid: Grid, dtype: torch.dtype, tolerance: float
) -> None:
    """Frames with particles up to the walls and beyond them give the scorer's
    fields.
    """
    x, u = particles(2, 3, 500, low=-0.02, high=1.02)
    x = x.astype(np.float32)
    u = u.astype(np.float32)
    full = grid.full_weight(500, 1.0)
    expected = reference.fields(x, u, grid, full=full)
    assert expected.differentiable.any()
    assert not expected.differentiable.all()
    found = fields(*torches(x, u, dtype=dtype), grid, full=full)
    compare(found, expected, tolerance)


def test_windows_side_by_side_are_as_alone() -> None:
    """Windows of unequal particle numbers in one row, the second of them empty, give
    each its own fields.
    """
    grid = Grid(6)
    full = 4.0
    x, u = particles(350)
    counts = [150, 0, 200]
    sample = torch.arange(3).repeat_interleave(torch.tensor(counts))
    found = fields(*torches(x, u), grid, full=full, sample=sample, windows=3)
    for window, end in enumerate(np.cumsum(counts)):
        own = slice(end - counts[window], end)
        alone = reference.fields(x[own], u[own], grid, full=full)
        np.testing.assert_allclose(
            found.velocity[window].numpy(), alone.velocity, atol=1e-15
        )
        np.testing.assert_allclose(
            found.weight[window].numpy(), alone.weight, atol=1e-12
        )
    counted = torch_grid.transfer(*torches(x, u), grid, sample=sample)
    assert torch.equal(counted.weight, found.weight)


def test_counted_nodes_may_be_those_of_the_truth() -> None:
    """A prediction that leaves the truth's nodes empty has velocity 0 there."""
    grid = Grid(6)
    full = grid.full_weight(400, 1.0)
    x, u = particles(400)
    truth = reference.fields(x, u, grid, full=full)
    expected = reference.fields(x / 2, u, grid, full=full, counted=truth.counted)
    found = fields(
        *torches(x / 2, u), grid, full=full, counted=torch.from_numpy(truth.counted)
    )
    compare(found, expected, 1e-12)


@pytest.mark.parametrize("name", ["density", "velocity", "vorticity", "divergence"])
@pytest.mark.parametrize("cells", [4, 5])
def test_gradients(name: str, cells: int) -> None:
    """Gradients to positions and velocities are those of finite differences."""
    grid = Grid(cells)
    x, u = torches(*particles(40, seed=3, low=-0.05, high=0.9))
    u = 100 * u
    full = grid.full_weight(40, 0.9)
    counted = fields(x, u, grid, full=full).counted
    assert counted.any()

    def field(position: Tensor, velocity: Tensor) -> Tensor:
        found = fields(position, velocity, grid, full=full, counted=counted)
        return torch.as_tensor(getattr(found, name))

    assert torch.autograd.gradcheck(field, (x.requires_grad_(), u.requires_grad_()))


def test_weight_and_momentum_are_conserved() -> None:
    """Away from the walls the weights of a particle sum to 1, wherever it is: the
    gradient is 0.
    """
    x, u = torches(*particles(30, low=0.3, high=0.7))
    sums = torch_grid.transfer(x.requires_grad_(), u.requires_grad_(), Grid(8))
    torch.testing.assert_close(
        sums.weight.sum(), torch.tensor(30.0, dtype=torch.float64)
    )
    total = sums.weight.sum() + sums.momentum.sum()
    at_x, at_u = torch.autograd.grad(total, (x, u))
    torch.testing.assert_close(at_u, torch.ones_like(at_u))
    assert float(at_x.abs().max()) < 1e-12


def test_lost_particles_have_no_weight_and_no_gradient() -> None:
    """Positions outside the box or without a number change nothing, and all gradients
    stay numbers.
    """
    x, u = torches(*particles(50))
    x[:3] = torch.tensor([[1.5, 0.5], [float("nan"), 0.5], [0.5, -float("inf")]])
    u[1] = float("nan")
    grid = Grid(6)
    kept = fields(x[3:], u[3:], grid, full=2.0)
    found = fields(x.requires_grad_(), u.requires_grad_(), grid, full=2.0)
    torch.testing.assert_close(found.velocity, kept.velocity)
    (found.vorticity.square().sum() + found.density.square().sum()).backward()
    for gradient in (x.grad, u.grad):
        assert bool(gradient.isfinite().all())
        assert not bool(gradient[:3].any())
        assert bool(gradient[3:].any())


@pytest.mark.parametrize(
    ("x", "u", "sample"),
    [
        (torch.zeros(5, 2), torch.zeros(4, 2), None),
        (torch.zeros(5, 3), torch.zeros(5, 3), None),
        (torch.zeros(2), torch.zeros(2), None),
        (torch.zeros(5, 2), torch.zeros(5, 2), torch.zeros(4, dtype=torch.int64)),
        (torch.zeros(1, 5, 2), torch.zeros(1, 5, 2), torch.zeros(5, dtype=torch.int64)),
    ],
)
def test_shapes_that_do_not_fit_are_refused(
    x: Tensor, u: Tensor, sample: Tensor | None
) -> None:
    """Positions, velocities and windows of unequal lengths are errors that give the
    shapes.
    """
    with pytest.raises(UsageError, match="do not fit"):
        torch_grid.transfer(x, u, Grid(4), sample=sample)


BOX = ((0.0625, 0.9375), (0.0625, 0.9375))


def cloud(
    particles: int, seed: int = 0, low: float = 0.0625, high: float = 0.9375
) -> torch.Tensor:
    """Return random places in a square box, some of them on its walls and corners."""
    x = torch.from_numpy(
        np.random.default_rng(seed)
        .uniform(low, high, (particles, 2))
        .astype(np.float32)
    )
    x[0] = low
    x[1] = high
    x[2, 0] = high
    x[3, 1] = low
    return x


@pytest.mark.parametrize("cells", [4, 7, 18, 22])
@pytest.mark.parametrize("bounds", [BOX, ((0.1, 0.9), (0.2, 0.5))])
def test_weights_are_a_partition_of_unity(
    cells: int, bounds: tuple[tuple[float, float], tuple[float, float]]
) -> None:
    """Nine weights >= 0 sum to 1 anywhere in the box, its walls and corners too, at
    nodes that exist.
    """
    grid = ParticleGrid(bounds, cells, multiple=4)
    low, high = torch.tensor(bounds).T
    place = low + cloud(500, low=0.0, high=1.0) * (high - low)
    stencil = grid.stencil(place.clamp(low, high), torch.zeros(500, dtype=torch.int64))
    assert float(stencil.weight.min()) >= 0.0
    torch.testing.assert_close(stencil.weight.sum(dim=1), torch.ones(500))
    assert (
        0
        <= int(stencil.node.min())
        <= int(stencil.node.max())
        < grid.shape[0] * grid.shape[1]
    )
    sums = grid.spread(stencil, torch.ones(500, 1), 1)
    assert float(sums.sum()) == pytest.approx(500, rel=1e-5)
    # quadratic B-splines reproduce 2 + 3 x - 5 y
    field, (x, y) = (
        2.0 + 3.0 * grid.axis_x[:, None] - 5.0 * grid.axis_y,
        place.clamp(low, high).T,
    )
    found = grid.gather(stencil, field[None, None])[:, 0]
    torch.testing.assert_close(found, 2.0 + 3.0 * x - 5.0 * y, rtol=0, atol=1e-5)


def test_spread_is_the_scorers_transfer() -> None:
    """On the unit box the inner nodes are those of lagbench.data.grid, and so are
    weight and momentum.
    """
    place = cloud(400, low=0.1, high=0.9)
    velocity = torch.randn(400, 2, generator=torch.Generator().manual_seed(0))
    grid = ParticleGrid(((0.0, 1.0), (0.0, 1.0)), 16)
    stencil = grid.stencil(place, torch.zeros(400, dtype=torch.int64))
    found = grid.spread(stencil, torch.cat([torch.ones(400, 1), velocity], dim=1), 1)[
        0, :, 1:-1, 1:-1
    ]
    expected = transfer(place.numpy(), velocity.numpy(), Grid(16))
    np.testing.assert_allclose(found[0], expected.weight, atol=2e-5)
    np.testing.assert_allclose(found[1:].permute(1, 2, 0), expected.momentum, atol=2e-5)


def test_gather_is_the_adjoint_of_spread() -> None:
    """<spread(v), g> = <v, gather(g)>, in two layers."""
    generator = torch.Generator().manual_seed(0)
    grid = ParticleGrid(BOX, 9, multiple=4)
    place = cloud(200)
    layer = torch.randint(2, (200,), generator=generator)
    value = torch.randn(200, 3, generator=generator)
    field = torch.randn(2, 3, *grid.shape, generator=generator)
    stencil = grid.stencil(place, layer)
    left = (grid.spread(stencil, value, 2).double() * field).sum()
    right = (value.double() * grid.gather(stencil, field)).sum()
    assert float(left) == pytest.approx(float(right), rel=1e-5)
    # particles of one layer give what they give alone
    first = layer == 0
    alone = grid.spread(grid.stencil(place[first], layer[first]), value[first], 1)
    torch.testing.assert_close(grid.spread(stencil, value, 2)[:1], alone)


def test_stresses_push_as_the_slopes_of_the_splines_say() -> None:
    """Forces by torch's own gradients of the weights; their sum and their moment vanish
    at the nodes.
    """
    grid = ParticleGrid(BOX, 9, multiple=4)
    place = cloud(200)
    layer = torch.arange(200) % 2
    rng = torch.Generator().manual_seed(0)
    stress = torch.randn(200, 3, 3, generator=rng)
    stencil = grid.stencil(place, layer)
    mass = grid.spread(stencil, torch.ones_like(place[:, :1]), 2)
    found = grid.accelerate(stencil, place, stress, mass)
    moved = place.clone().requires_grad_()
    weight = grid.stencil(moved, layer).weight
    each = [
        torch.autograd.grad(weight[:, node].sum(), moved, retain_graph=True)[0]
        for node in range(9)
    ]
    slopes = torch.stack(each, dim=1)
    matrix = stress[..., [0, 1, 1, 2]].unflatten(2, (2, 2))
    pulled = -grid.spacing * torch.einsum("pfcd,pnd->pnfc", matrix, slopes)
    columns, rows = grid.shape
    force = torch.zeros(2 * columns * rows, 3, 2).index_add(
        0, stencil.node, pulled.flatten(0, 1)
    )
    ours = (found * mass).permute(0, 2, 3, 1).reshape(-1, 3, 2)
    torch.testing.assert_close(ours, force, rtol=0, atol=2e-5)
    x, y = torch.cartesian_prod(grid.axis_x, grid.axis_y).repeat(2, 1).T[..., None]
    moment = (x * ours[..., 1] - y * ours[..., 0]).sum(0)
    torch.testing.assert_close(ours.sum(dim=0), torch.zeros(3, 2), rtol=0, atol=1e-4)
    torch.testing.assert_close(moment, torch.zeros(3), rtol=0, atol=1e-4)


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("signs", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_the_image_of_a_transfer_is_the_transfer_of_the_image(
    signs: tuple[int, int], swap: bool
) -> None:
    """All eight images of the square: mirrored and turned particles give mirrored and
    turned sums.
    """
    grid = ParticleGrid(BOX, 11, multiple=4)
    place = cloud(300)
    zero = torch.zeros(300, dtype=torch.int64)
    turned = (place - 0.5) * torch.tensor(signs) + 0.5
    both = (place, turned.flip(1) if swap else turned)
    here, found = (
        grid.spread(grid.stencil(x, zero), torch.ones(300, 1), 1)[0, 0] for x in both
    )
    expected = here.flip([axis for axis, sign in enumerate(signs) if sign < 0])
    torch.testing.assert_close(
        found, expected.T if swap else expected, rtol=0, atol=1e-4
    )


def test_walls_lie_between_two_rows_of_nodes() -> None:
    """The nodes beside a wall are half a cell from it, on both sides.

    A rollout that diverges gives NaN, which the rollout freezes, and no error of an
    index.
    """
    grid = ParticleGrid(BOX, 7)
    distance = grid.wall_distance(1.0)
    for wall, beside in enumerate(grid.beside_walls()):
        assert int(beside.sum()) == 2 * grid.shape[wall // 2]
        near = distance[wall][beside.bool()].abs()
        torch.testing.assert_close(near, torch.full_like(near, grid.spacing / 2))
    place = torch.tensor([[torch.nan, 0.5], [0.5, 0.5]])
    stencil = grid.stencil(place, torch.zeros(2, dtype=torch.int64))
    found = grid.gather(stencil, torch.ones(1, 1, *grid.shape))
    assert found[0].isnan().all()
    assert found[1].isfinite().all()
