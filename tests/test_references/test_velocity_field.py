"""The field that carries particles, in two and three dimensions.

Both readings reproduce a linear function exactly, whatever the points are.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lagbench.references.predictor import fitted_field, velocity_field

Floats = NDArray[np.float64]


def scattered(count: int, dimension: int, *, seed: int = 0) -> Floats:
    """Return random points of the unit box."""
    return np.random.default_rng(seed).random((count, dimension))


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_linear_field_is_exact(dimension: int) -> None:
    """Constant plus gradient: at places between the points nothing is lost."""
    points = scattered(800, dimension)
    gradient = np.random.default_rng(1).normal(size=(dimension, dimension))
    constant = np.arange(dimension) - 0.5
    field = velocity_field(points, points @ gradient + constant)
    places = 0.3 + 0.4 * scattered(60, dimension, seed=2)
    expected = places @ gradient + constant
    np.testing.assert_allclose(field(places), expected, atol=1e-9)


def test_a_rotated_cloud_gives_a_rotated_velocity() -> None:
    """The fit in three dimensions knows no axes."""
    points = scattered(500, 3) - 0.5
    velocities = np.sin(4.0 * points[:, [1, 2, 0]])
    places = 0.4 * (scattered(40, 3, seed=3) - 0.5)
    rotation = Rotation.random(random_state=4).as_matrix()
    turned = fitted_field(points @ rotation.T, velocities @ rotation.T)
    expected = fitted_field(points, velocities)(places) @ rotation.T
    np.testing.assert_allclose(turned(places @ rotation.T), expected, atol=1e-8)


def test_the_fit_converges_as_fast_as_the_triangles() -> None:
    """Halving the spacing of a smooth field's points quarters the error, or nearly."""

    def error(side: int) -> float:
        lattice = (np.arange(side) + 0.5) / side
        axes = np.meshgrid(lattice, lattice, lattice, indexing="ij")
        points = np.stack(axes, axis=-1).reshape(-1, 3)
        points += 0.25 / side * (scattered(len(points), 3, seed=5) - 0.5)
        field = fitted_field(points, np.sin(3.0 * points))
        places = 0.25 + 0.5 * scattered(200, 3, seed=6)
        difference = field(places) - np.sin(3.0 * places)
        return float(np.sqrt(np.mean(difference**2)))

    assert error(20) < error(10) / 3.0
