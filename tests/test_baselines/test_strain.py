"""Strain since the first frame, against affine motions and mirror images."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from simple_models import greatest_difference, info, jittered
from torch import Tensor

from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.baselines.strain import UNIT, RestShape

BOUNDS = info().bounds


Matrix = list[list[float]]


def rest_shape(position: Tensor, *, bodies: int = 1) -> RestShape:
    """Return the first frame of bodies whose particles take turns."""
    layer = torch.arange(len(position)) % bodies
    grid = ParticleGrid(BOUNDS, 12, multiple=4)
    return RestShape.build(grid, position, layer, bodies)


def square_body(seed: int) -> Tensor:
    """Return a square body."""
    position = jittered(seed, low=0.3, high=0.7)
    return torch.from_numpy(position).float()


def change_shape(position: Tensor, gradient: Matrix) -> Tensor:
    """Return positions x F^T."""
    f = torch.tensor(gradient)
    return position @ f.T


@pytest.mark.parametrize(
    "gradient",
    [
        [[1.0, 0.0], [0.0, 1.0]],
        [[0.6, -0.8], [0.8, 0.6]],  # a rotation: no strain
        [[0.9, 0.0], [0.0, 0.9]],
        [[1.1, 0.05], [-0.02, 0.92]],
        [[1.0, 0.3], [0.0, 1.0]],
    ],
)
def test_affine_motion_has_the_strain_of_its_matrix(gradient: Matrix) -> None:
    """(F F^T - 1) / 2, at the edges of the body too, wherever it went."""
    f = np.array(gradient)
    first = square_body(0)
    moved = change_shape(first, gradient) + 0.05
    strain = rest_shape(first).strain(moved)

    matrix = 0.5 * (f @ f.T - np.eye(2))
    (xx, xy), (_, yy) = matrix
    components = np.array([xx, xy, yy])
    expected = np.tanh(components / UNIT)
    everywhere = np.tile(expected, (len(first), 1))
    assert_allclose(strain.numpy(), everywhere, rtol=0, atol=0.05)
    mean = strain.mean(dim=0).numpy()
    assert_allclose(mean, expected, rtol=0, atol=0.02)


def test_bodies_in_layers_of_their_own_fly_apart_unstrained() -> None:
    """Neither of two bodies is strained that lie in each other at first and part."""
    first = square_body(0)
    shift_of_body = torch.tensor([[-0.1, 0.0], [0.1, 0.05]])
    body = torch.arange(len(first)) % 2
    apart = first + shift_of_body[body]
    two_layers = rest_shape(first, bodies=2).strain(apart)
    one_layer = rest_shape(first).strain(apart)
    no_strain = torch.zeros_like(one_layer)
    assert greatest_difference(two_layers, no_strain) < 1e-4
    assert greatest_difference(one_layer, no_strain) > 0.1
