"""Particles to nodes and back, against closed forms and the scorer's transfer."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lagbench.baselines.torch_grid import ParticleGrid
from lagbench.data.grid import Grid, transfer

BOX = ((0.0625, 0.9375), (0.0625, 0.9375))


def cloud(particles: int, seed: int = 0, low: float = 0.0625, high: float = 0.9375) -> torch.Tensor:
    """Return random places in a square box, some of them on its walls and corners."""
    x = torch.from_numpy(np.random.default_rng(seed).uniform(low, high, (particles, 2)).astype(np.float32))
    x[0], x[1], x[2, 0], x[3, 1] = low, high, high, low
    return x


@pytest.mark.parametrize("cells", [4, 7, 18, 22])
@pytest.mark.parametrize("bounds", [BOX, ((0.1, 0.9), (0.2, 0.5))])
def test_weights_are_a_partition_of_unity(
    cells: int, bounds: tuple[tuple[float, float], tuple[float, float]]
) -> None:
    """Nine weights >= 0 sum to 1 anywhere in the box, its walls and corners too, at nodes that exist."""
    grid = ParticleGrid(bounds, cells, multiple=4)
    low, high = torch.tensor(bounds).T
    place = low + cloud(500, low=0.0, high=1.0) * (high - low)
    stencil = grid.stencil(place.clamp(low, high), torch.zeros(500, dtype=torch.int64))
    assert float(stencil.weight.min()) >= 0.0
    torch.testing.assert_close(stencil.weight.sum(dim=1), torch.ones(500))
    assert 0 <= int(stencil.node.min()) <= int(stencil.node.max()) < grid.shape[0] * grid.shape[1]
    sums = grid.spread(stencil, torch.ones(500, 1), 1)
    assert float(sums.sum()) == pytest.approx(500, rel=1e-5)


def test_linear_fields_are_gathered_exactly() -> None:
    """Quadratic B-splines reproduce 2 + 3 x - 5 y."""
    grid, place = ParticleGrid(BOX, 10), cloud(300)
    field = 2.0 + 3.0 * grid.axis_x[:, None] - 5.0 * grid.axis_y
    found = grid.gather(grid.stencil(place, torch.zeros(300, dtype=torch.int64)), field[None, None])
    torch.testing.assert_close(found[:, 0], 2.0 + 3.0 * place[:, 0] - 5.0 * place[:, 1], rtol=0, atol=1e-5)


def test_spread_is_the_scorers_transfer() -> None:
    """On the unit box the inner nodes are those of lagbench.data.grid, and so are weight and momentum."""
    place = cloud(400, low=0.1, high=0.9)
    velocity = torch.randn(400, 2, generator=torch.Generator().manual_seed(0))
    grid = ParticleGrid(((0.0, 1.0), (0.0, 1.0)), 16)
    stencil = grid.stencil(place, torch.zeros(400, dtype=torch.int64))
    found = grid.spread(stencil, torch.cat([torch.ones(400, 1), velocity], dim=1), 1)[0, :, 1:-1, 1:-1]
    expected = transfer(place.numpy(), velocity.numpy(), Grid(16))
    np.testing.assert_allclose(found[0], expected.weight, atol=2e-5)
    np.testing.assert_allclose(found[1:].permute(1, 2, 0), expected.momentum, atol=2e-5)


def test_gather_is_the_adjoint_of_spread() -> None:
    """<spread(v), g> = <v, gather(g)>, in two layers."""
    generator = torch.Generator().manual_seed(0)
    grid, place = ParticleGrid(BOX, 9, multiple=4), cloud(200)
    layer = torch.randint(2, (200,), generator=generator)
    value = torch.randn(200, 3, generator=generator)
    field = torch.randn(2, 3, *grid.shape, generator=generator)
    stencil = grid.stencil(place, layer)
    left = (grid.spread(stencil, value, 2).double() * field).sum()
    right = (value.double() * grid.gather(stencil, field)).sum()
    assert float(left) == pytest.approx(float(right), rel=1e-5)


def test_layers_do_not_mix() -> None:
    """Particles of one layer give what they give alone."""
    grid, place = ParticleGrid(BOX, 9), cloud(100)
    layer = torch.arange(100) % 2
    both = grid.spread(grid.stencil(place, layer), place, 2)
    alone = grid.spread(grid.stencil(place[::2], layer[::2]), place[::2], 1)
    torch.testing.assert_close(both[:1], alone)


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("signs", [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_the_image_of_a_transfer_is_the_transfer_of_the_image(signs: tuple[int, int], swap: bool) -> None:
    """All eight images of the square: mirrored and turned particles give mirrored and turned sums."""
    grid, place = ParticleGrid(BOX, 11, multiple=4), cloud(300)
    zero = torch.zeros(300, dtype=torch.int64)
    turned = (place - 0.5) * torch.tensor(signs) + 0.5
    turned = turned.flip(1) if swap else turned
    found = grid.spread(grid.stencil(turned, zero), torch.ones(300, 1), 1)[0, 0]
    here = grid.spread(grid.stencil(place, zero), torch.ones(300, 1), 1)[0, 0]
    expected = here.flip([axis for axis, sign in enumerate(signs) if sign < 0])
    torch.testing.assert_close(found, expected.T if swap else expected, rtol=0, atol=1e-4)


def test_walls_lie_between_two_rows_of_nodes() -> None:
    """The nodes beside a wall are half a cell from it, on both sides."""
    grid = ParticleGrid(BOX, 7)
    distance = grid.wall_distance(1.0)
    for wall, beside in enumerate(grid.beside_walls()):
        assert int(beside.sum()) == 2 * grid.shape[wall // 2]
        near = distance[wall][beside.bool()].abs()
        torch.testing.assert_close(near, torch.full_like(near, grid.spacing / 2))


def test_places_that_are_no_numbers_stay_so() -> None:
    """A rollout that diverges gives NaN, which the rollout freezes, and no error of an index."""
    grid = ParticleGrid(BOX, 7)
    place = torch.tensor([[torch.nan, 0.5], [0.5, 0.5]])
    stencil = grid.stencil(place, torch.zeros(2, dtype=torch.int64))
    found = grid.gather(stencil, torch.ones(1, 1, *grid.shape))
    assert found[0].isnan().all()
    assert found[1].isfinite().all()
