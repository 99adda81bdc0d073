"""Relaxation against derivatives by torch, conservation, and squeezed particles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from simple_models import batch, network
from torch import Tensor

from lagbench.baselines.relaxation import SHARE, SOFTNESS, Relaxation
from lagbench.data.box import Box
from lagbench.tensors import TensorBox

RADIUS = 0.06
RADIUS_3D = 0.12
SUPPORT = {2: 2.0 * RADIUS, 3: 1.5 * RADIUS_3D}
DENSEST = 1.2


def relaxation(
    *, iterations: int = 1, dimension: int = 2, periodic: bool = True
) -> Relaxation:
    """Return a relaxation in a unit box."""
    box = Box.from_bounds([(0.0, 1.0)] * dimension, [periodic] * dimension)
    radius = RADIUS if dimension == 2 else RADIUS_3D
    return Relaxation(
        TensorBox(box), radius=radius, iterations=iterations, densest=DENSEST
    )


def one_window(position: Tensor) -> Tensor:
    """Return the window of particles that are all in the first one."""
    return torch.zeros(len(position), dtype=torch.int64)


def lattice(count: int, dimension: int = 2) -> Tensor:
    """Return particles in the middle of the cells of a unit box."""
    axis = (torch.arange(count) + 0.5) / count
    axes = torch.meshgrid([axis] * dimension, indexing="ij")
    return torch.stack(axes, dim=-1).reshape(-1, dimension)


def squeezed(position: Tensor, *, strain: float = 0.3) -> Tensor:
    """Return particles that are drawn to the centre of the box."""
    way = position - 0.5
    distance = way.norm(dim=1, keepdim=True)
    return 0.5 + way * (1.0 - strain * torch.exp(-((distance / 0.2) ** 2)))


def densities(position: Tensor, *, periodic: bool) -> Tensor:
    """Return densities from the distances of all pairs, in float64."""
    way = position[:, None] - position[None, :]
    if periodic:
        way = way - torch.round(way.detach())
    support = SUPPORT[position.shape[1]]
    square_distance = (way / support).square().sum(dim=2)
    kernel = (1.0 - square_distance).clamp(min=0.0) ** 3
    return kernel.sum(dim=1)


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("periodic", [False, True])
def test_an_iteration_is_that_of_position_based_fluids(
    dimension: int, periodic: bool
) -> None:
    """dx_k = sum_i lambda_i grad_k C_i, with the gradients of torch."""
    rng = np.random.default_rng(4)
    points = rng.uniform(0.0, 0.3, (40, dimension))
    position = torch.tensor(points).double().requires_grad_()
    part = relaxation(dimension=dimension, periodic=periodic)
    limit = 1.1 * densities(position, periodic=periodic).detach().min()

    excess = (densities(position, periodic=periodic) / limit - 1.0).clamp(min=0.0)
    support = SUPPORT[dimension]
    expected = torch.zeros_like(position)
    for value in excess:
        if value == 0.0:
            continue
        (gradient,) = torch.autograd.grad(value, position, retain_graph=True)
        gradient = support * gradient  # the unit of length is the support
        multiplier = -value / (gradient.square().sum() + SOFTNESS)
        expected += SHARE * support * multiplier * gradient
    expected = part.box.inside(position + expected).detach()

    start = position.detach()
    moved = part(start, one_window(start), limit[None])
    assert (moved - start).abs().max() > 0.01
    difference = part.box.displacement(moved, expected)
    assert difference.abs().max() < 1e-6


@pytest.mark.parametrize("dimension", [2, 3])
def test_squeezed_particles_return_below_the_limit(dimension: int) -> None:
    """Their centre stays, because each pair moves apart by equal ways."""
    count = 30 if dimension == 2 else 12
    resting = lattice(count, dimension)
    sample = one_window(resting)
    part = relaxation(iterations=40, dimension=dimension)
    limit = part.limit(resting, sample)
    crowded = squeezed(resting)
    density = densities(crowded.double(), periodic=True)
    assert density.max() > 1.3 * limit

    relaxed = part(crowded, sample, limit)
    density = densities(relaxed.double(), periodic=True)
    assert density.max() < 1.02 * limit
    way = part.box.displacement(crowded, relaxed)
    assert way.abs().max() > 0.01
    assert way.double().mean(dim=0).abs().max() < 1e-5


def test_particles_stay_between_walls() -> None:
    """A heap in a corner spreads along the walls and inwards."""
    rng = np.random.default_rng(5)
    heap = torch.tensor(rng.uniform(0.0, 0.03, (50, 2))).float()
    part = relaxation(iterations=20, periodic=False)
    relaxed = part(heap, one_window(heap), torch.tensor([8.0]))
    assert relaxed.min() >= 0.0
    assert densities(relaxed.double(), periodic=False).max() < 12.0
    assert densities(heap.double(), periodic=False).min() > 35.0


def test_the_velocity_across_a_periodic_end_is_the_shortest_way() -> None:
    """A heap at the end of a box spreads to both sides."""
    rng = np.random.default_rng(6)
    heap = rng.normal(0.0, 0.01, (30, 2)) % 1.0
    box = {"bounds": ((0.0, 1.0), (0.0, 1.0)), "periodic": ("x", "y")}
    model = network(changes=box, radius=RADIUS, relaxation=3, densest=1.01)
    rested = np.concatenate([heap[:1], rng.uniform(0.0, 1.0, (29, 2))])
    state = model.start(batch(np.stack([rested, rested])))
    limit = model.relaxation.limit(state.position, state.sample)
    position = torch.tensor(heap).float()
    crowded = replace(state, position=position, density_limit=limit)
    moved, after = model.advance(crowded)
    way = model.box.displacement(position, after)
    assert (after[:, 0] < 0.5).any()
    assert (after[:, 0] > 0.5).any()
    assert way.abs().max() > 1e-3
    torch.testing.assert_close(moved.velocity[:, -1], way, atol=1e-6, rtol=0.0)
