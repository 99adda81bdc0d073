"""Projections: shapes against SciPy's rotations, densities against lattices, momentum
kept by both.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from simple_models import info, jittered
from torch import Tensor

from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.baselines.projection import (
    LEARNING_SCALE,
    DensityProjection,
    Projection,
    ShapeMatching,
)

BOUNDS = info().bounds


def body(seed: int, low: float = 0.3, high: float = 0.7) -> Tensor:
    """Return a square body in double precision."""
    return torch.from_numpy(jittered(seed, low=low, high=high)).double()


def shape(position: Tensor, cells: int = 8) -> ShapeMatching:
    """Return the clusters of one body in double precision."""
    grid = ParticleGrid(BOUNDS, cells).double()
    return ShapeMatching.build(
        grid, position, torch.zeros(len(position), dtype=torch.int64), 1
    )


def crowd(position: Tensor) -> DensityProjection:
    """Return the densities of one window in double precision."""
    grid = ParticleGrid(BOUNDS, 8).double()
    return DensityProjection.build(
        grid, position, torch.zeros(len(position), dtype=torch.int64), 1
    )


def turn(position: Tensor, angle: float) -> Tensor:
    """Return positions turned about the middle of the box."""
    cosine = np.cos(angle)
    sine = np.sin(angle)
    return (position - 0.5) @ torch.tensor([[cosine, sine], [-sine, cosine]]) + 0.5


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0, -3.1])
def test_rigid_motion_is_left_as_it_is(angle: float) -> None:
    """However far a body turns and flies, it has its shape."""
    first = body(0)
    moved = turn(first, angle) + torch.tensor([0.1, -0.2])
    torch.testing.assert_close(shape(first).match(moved), moved, rtol=0, atol=1e-9)


def test_clusters_turn_as_scipy_says() -> None:
    """Each cluster's rotation is the best weighted one, found by SciPy node by node."""
    rng = np.random.default_rng(0)
    first = body(0, low=0.4, high=0.6)[:40]
    now = turn(first, 0.7) + torch.from_numpy(rng.normal(0.0, 0.01, (40, 2)))
    found = shape(first, cells=6)
    weight = np.zeros((found.node_count, 40))
    for particle, (nodes, shares) in enumerate(
        zip(found.stencil.node.view(-1, 9), found.stencil.weight, strict=True)
    ):
        weight[nodes.numpy(), particle] = shares.numpy()
    expected = np.zeros((40, 2))
    for each in weight[weight.sum(axis=1) > 0.0]:
        x, y = (np.pad(one.numpy(), ((0, 0), (0, 1))) for one in (first, now))
        here, there = (np.average(one, axis=0, weights=each) for one in (x, y))
        best, _ = Rotation.align_vectors(y - there, x - here, weights=each)
        angle = best.as_rotvec()[2]  # in the plane: no other axis
        flat = Rotation.from_rotvec([0.0, 0.0, angle])
        expected += each[:, None] * (there + flat.apply(x - here))[:, :2]
    np.testing.assert_allclose(found.match(now).numpy(), expected, rtol=0, atol=1e-9)


def test_shape_matching_keeps_both_momenta_and_restores_the_shape() -> None:
    """Whatever a body is pressed to, its centre and its spin stay, and every step is
    nearer to its shape.
    """
    rng = np.random.default_rng(1)
    first = body(0)
    found = shape(body(0))
    now = turn(first, 0.3) + torch.from_numpy(rng.normal(0.0, 0.02, first.shape))
    there = found.match(now)
    pushed = there - now
    torch.testing.assert_close(
        pushed.sum(dim=0), torch.zeros(2).double(), rtol=0, atol=1e-9
    )
    spin = (now[:, 0] * pushed[:, 1] - now[:, 1] * pushed[:, 0]).sum()
    assert abs(float(spin)) < 1e-9 < float(pushed.abs().sum())
    before, after = (
        (torch.pdist(one) - torch.pdist(first)).square().mean() for one in (now, there)
    )
    assert float(after) < 0.1 * float(before)


def test_a_lone_particle_has_finite_gradients() -> None:
    """It has no direction and stays where it is."""
    first = torch.tensor([[0.51, 0.52]], dtype=torch.float64)
    now = torch.tensor([[0.3, 0.4]], dtype=torch.float64, requires_grad=True)
    there = shape(first).match(now)
    there.sum().backward()
    torch.testing.assert_close(there, now)
    assert bool(now.grad.isfinite().all())


@pytest.mark.parametrize("sides", [(0.875, 0.875), (0.875, 0.31)])
@pytest.mark.parametrize("cells", [6, 7])
def test_a_full_box_is_evenly_dense(cells: int, sides: tuple[float, float]) -> None:
    """Beside walls too, where splines lie partly outside, and where cells do not fill
    the box.
    """
    bounds = tuple((0.0625, 0.0625 + side) for side in sides)
    axes = [
        low + (high - low) * (torch.arange(150).double() + 0.5) / 150
        for low, high in bounds
    ]
    lattice = torch.cartesian_prod(*axes)
    one = torch.zeros(150**2, dtype=torch.int64)
    grid = ParticleGrid(bounds, cells).double()
    found = DensityProjection.build(grid, lattice, one, 1)
    rho, mass = found.relative_density(grid.stencil(lattice, one))
    torch.testing.assert_close(rho, torch.ones_like(rho), rtol=4e-3, atol=0)
    assert float(mass.sum()) == pytest.approx(150**2)
    assert float(found.greatest) == pytest.approx(
        (150 * grid.spacing) ** 2 / (sides[0] * sides[1]), rel=4e-3
    )


@pytest.mark.parametrize("shift", [(-0.22, -0.22), (-0.22, 0.0), (0.0, -0.22)])
def test_what_is_pressed_together_comes_apart(shift: tuple[float, float]) -> None:
    """At rest nothing moves, by a bit; two bodies in one place part, and their centre
    stays.
    """
    first = torch.cat([body(0, 0.3, 0.45), body(1, 0.3, 0.45) - torch.tensor(shift)])
    found = crowd(first)
    limit = torch.ones(len(first)).double()
    assert torch.equal(found.correct(first, torch.tensor(1.0), limit), first)
    now = first.clone()
    now[256:] += torch.tensor(shift)
    there = now
    most = []
    for _ in range(12):
        most.append(
            float(
                found.relative_density(found.grid.stencil(there, found.sample))[0].max()
            )
        )
        there = found.correct(there, torch.tensor(1.0), limit)
    torch.testing.assert_close(there.mean(dim=0), now.mean(dim=0), rtol=0, atol=1e-9)
    assert most[0] > 1.6
    assert most[-1] < 1.15


def test_a_heap_is_not_thrown_apart() -> None:
    """A body in a twenty-fifth of its place: what is pushed goes a cell or two, however
    dense it is.
    """
    found = crowd(body(0))
    heap = 0.5 + 0.2 * (body(1) - 0.5)
    moved = found.correct(heap, torch.tensor(1.0), torch.ones(256).double()) - heap
    assert 1.0 < float(moved.norm(dim=1).max()) / found.grid.spacing < 2.5


def test_nothing_spins_by_rounding() -> None:
    """In single precision a body at rest stays there for hundreds of frames."""
    first = body(0).float()
    found = ShapeMatching.build(
        ParticleGrid(BOUNDS, 15), first, torch.zeros(256).long(), 1
    )
    there = first
    for _ in range(300):
        there = found.match(there)
    assert float((there - first).abs().max()) < 5e-5


def test_shares_and_limits_are_those_of_their_material() -> None:
    """Jelly and rope go their own share of the way; each material has its own limit."""
    first = torch.cat([body(0), body(1)]).float()
    now = first + 0.02 * torch.randn(
        first.shape, generator=torch.Generator().manual_seed(0)
    )
    material = torch.tensor([1, 3]).repeat(256)
    sample = torch.zeros(512).long()
    model = Projection(BOUNDS, shape=(8,), density=())
    shares = torch.tensor([0.25, 0.75])
    with torch.no_grad():
        model.held.copy_(shares.logit() / LEARNING_SCALE)
    found = model(model.start(first, material, sample, 1), now)
    for kind, share in ((1, 0.25), (3, 0.75)):
        own = material == kind
        there = ShapeMatching.build(
            ParticleGrid(BOUNDS, 8), first[own], sample[own], 1
        ).match(now[own])
        torch.testing.assert_close(
            found[own], now[own] + share * (there - now[own]), rtol=0, atol=1e-6
        )
    model = Projection(BOUNDS, shape=(), density=(8,))
    pressed = 0.9 * (first - 0.5) + 0.5
    with torch.no_grad():
        model.limit[1] = 1.0
    drawn = model.start(first, material, sample, 1)
    limit = torch.where(material == 1, 1.2, 1.0)
    expected = drawn.densities[0].correct(pressed, torch.tensor(1.0), limit)
    torch.testing.assert_close(model(drawn, pressed), expected, rtol=0, atol=1e-7)
    assert not torch.allclose(
        expected, drawn.densities[0].correct(pressed, torch.tensor(1.0), 0 * limit + 1)
    )


def test_liquids_and_other_windows_are_none_of_a_shape() -> None:
    """Only jelly and rope come back; windows side by side have what each has alone."""
    first = torch.cat([body(0), body(1, 0.4, 0.6)]).float()
    now = (
        0.9 * (first - 0.5)
        + 0.5
        + 0.01 * torch.randn(512, 2, generator=torch.Generator().manual_seed(0))
    )
    sample = torch.arange(2).repeat_interleave(256)
    model = Projection(BOUNDS, shape=(4, 8), density=(8,))
    material = torch.tensor([0, 1, 2, 3]).repeat(128)
    together = model(model.start(first, material, sample, 2), now)
    for window in range(2):
        own = sample == window
        alone = model(
            model.start(first[own], material[own], torch.zeros(256).long(), 1), now[own]
        )
        torch.testing.assert_close(together[own], alone, rtol=0, atol=1e-6)
    still = Projection(BOUNDS, shape=(4, 8), density=())
    moved = (still(still.start(first, material, sample, 2), now) - now).abs().amax(
        dim=1
    ) > 0.0
    assert torch.equal(moved, (material == 1) | (material == 3))


def test_every_weight_has_a_gradient() -> None:
    """Where nothing is elastic or dense too, as training on several devices asks
    for.
    """
    first = body(0).float()
    for material in (0, 1):
        model = Projection(BOUNDS, shape=(4, 8), density=(8,))
        drawn = model.start(
            first, torch.full((256,), material), torch.zeros(256).long(), 1
        )
        model(drawn, first + 0.3).sum().backward()
        assert all(each.grad is not None for each in model.parameters())
