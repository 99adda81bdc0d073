"""The differentiable grid fields are those of lagbench.data.grid, and their gradients are right."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from lagbench.baselines import torch_grid
from lagbench.data import grid as reference
from lagbench.data.grid import Grid, Placement
from lagbench.errors import UsageError

GRIDS = [Grid(8), Grid(8, Placement.NODES), Grid(11)]


def particles(*shape: int, seed: int = 0, low: float = 0.0, high: float = 1.0) -> tuple[Any, Any]:
    """Return positions and velocities of shape [..., 2] in float64."""
    rng = np.random.default_rng(seed)
    return rng.uniform(low, high, (*shape, 2)), 0.01 * rng.normal(size=(*shape, 2))


def torches(*arrays: NDArray[np.float64], dtype: torch.dtype = torch.float64) -> list[Tensor]:
    """Return arrays as tensors."""
    return [torch.from_numpy(array).to(dtype) for array in arrays]


def compare(found: torch_grid.Fields, expected: reference.Fields, tolerance: float) -> None:
    """Compare every field; vorticity and divergence are 0 where the scorer's are NaN."""
    np.testing.assert_array_equal(found.differentiable.numpy(), expected.differentiable)
    for name in ("weight", "velocity", "density", "vorticity", "divergence"):
        truth = np.nan_to_num(getattr(expected, name))
        scale = np.abs(truth).max()
        np.testing.assert_allclose(getattr(found, name).numpy(), truth, rtol=0, atol=tolerance * scale)


@pytest.mark.parametrize("grid", GRIDS, ids=str)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-13), (torch.float32, 1e-5)])
def test_fields_are_those_of_the_scorer(grid: Grid, dtype: torch.dtype, tolerance: float) -> None:
    """Frames with particles up to the walls and beyond them give the scorer's fields."""
    x, u = particles(2, 3, 500, low=-0.02, high=1.02)
    x, u = x.astype(np.float32), u.astype(np.float32)
    full = grid.full_weight(500, 1.0)
    expected = reference.fields(x, u, grid, full=full)
    assert expected.differentiable.any()
    assert not expected.differentiable.all()
    found = torch_grid.fields(*torches(x, u, dtype=dtype), grid, full=full)
    compare(found, expected, tolerance)


def test_windows_side_by_side_are_as_alone() -> None:
    """Windows of unequal particle numbers in one row, the second of them empty, give each its own fields."""
    grid, full = Grid(6), 4.0
    x, u = particles(350)
    counts = [150, 0, 200]
    sample = torch.arange(3).repeat_interleave(torch.tensor(counts))
    found = torch_grid.fields(*torches(x, u), grid, full=full, sample=sample, windows=3)
    for window, end in enumerate(np.cumsum(counts)):
        own = slice(end - counts[window], end)
        alone = reference.fields(x[own], u[own], grid, full=full)
        np.testing.assert_allclose(found.velocity[window].numpy(), alone.velocity, atol=1e-15)
        np.testing.assert_allclose(found.weight[window].numpy(), alone.weight, atol=1e-12)
    counted = torch_grid.transfer(*torches(x, u), grid, sample=sample)
    assert torch.equal(counted.weight, found.weight)


def test_counted_nodes_may_be_those_of_the_truth() -> None:
    """A prediction that leaves the truth's nodes empty has velocity 0 there."""
    grid = Grid(6)
    full = grid.full_weight(400, 1.0)
    x, u = particles(400)
    truth = reference.fields(x, u, grid, full=full)
    expected = reference.fields(x / 2, u, grid, full=full, counted=truth.counted)
    found = torch_grid.fields(*torches(x / 2, u), grid, full=full, counted=torch.from_numpy(truth.counted))
    compare(found, expected, 1e-12)


def test_rotation_has_twice_its_rate() -> None:
    """A lattice turning at rate 3 has vorticity 6 and no divergence at every inner node."""
    grid = Grid(10)
    axis = (torch.arange(20, dtype=torch.float64) + 0.5) / 20  # two particles per cell and axis
    x = torch.cartesian_prod(axis, axis)
    u = 3.0 * torch.stack([0.5 - x[:, 1], x[:, 0] - 0.5], dim=1)
    found = torch_grid.fields(x, u, grid, full=4.0)
    inner = (slice(2, -2), slice(2, -2))  # the outermost nodes lack particles on one side
    torch.testing.assert_close(found.vorticity[inner], torch.full((6, 6), 6.0, dtype=torch.float64))
    torch.testing.assert_close(found.divergence[inner], torch.zeros(6, 6, dtype=torch.float64))


@pytest.mark.parametrize("name", ["density", "velocity", "vorticity", "divergence"])
@pytest.mark.parametrize("cells", [4, 5])
def test_gradients(name: str, cells: int) -> None:
    """Gradients to positions and velocities are those of finite differences."""
    grid = Grid(cells)
    x, u = torches(*particles(40, seed=3, low=-0.05, high=0.9))
    u = 100 * u
    full = grid.full_weight(40, 0.9)
    counted = torch_grid.fields(x, u, grid, full=full).counted
    assert counted.any()

    def field(position: Tensor, velocity: Tensor) -> Tensor:
        found = torch_grid.fields(position, velocity, grid, full=full, counted=counted)
        return torch.as_tensor(getattr(found, name))

    assert torch.autograd.gradcheck(field, (x.requires_grad_(), u.requires_grad_()))


def test_weight_and_momentum_are_conserved() -> None:
    """Away from the walls the weights of a particle sum to 1, wherever it is: the gradient is 0."""
    x, u = torches(*particles(30, low=0.3, high=0.7))
    sums = torch_grid.transfer(x.requires_grad_(), u.requires_grad_(), Grid(8))
    torch.testing.assert_close(sums.weight.sum(), torch.tensor(30.0, dtype=torch.float64))
    total = sums.weight.sum() + sums.momentum.sum()
    at_x, at_u = torch.autograd.grad(total, (x, u))
    torch.testing.assert_close(at_u, torch.ones_like(at_u))
    assert float(at_x.abs().max()) < 1e-12


def test_lost_particles_have_no_weight_and_no_gradient() -> None:
    """Positions outside the box or without a number change nothing, and all gradients stay numbers."""
    x, u = torches(*particles(50))
    x[:3] = torch.tensor([[1.5, 0.5], [float("nan"), 0.5], [0.5, -float("inf")]])
    u[1] = float("nan")
    grid = Grid(6)
    kept = torch_grid.fields(x[3:], u[3:], grid, full=2.0)
    found = torch_grid.fields(x.requires_grad_(), u.requires_grad_(), grid, full=2.0)
    torch.testing.assert_close(found.velocity, kept.velocity)
    (found.vorticity.square().sum() + found.density.square().sum()).backward()
    for gradient in (x.grad, u.grad):
        assert gradient is not None
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
def test_shapes_that_do_not_fit_are_refused(x: Tensor, u: Tensor, sample: Tensor | None) -> None:
    """Positions, velocities and windows of unequal lengths are errors that give the shapes."""
    with pytest.raises(UsageError, match="do not fit"):
        torch_grid.transfer(x, u, Grid(4), sample=sample)
