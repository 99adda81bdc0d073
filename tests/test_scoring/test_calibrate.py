"""The fit of calibrated rows against polynomials with known minima."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from lagbench.data.registry import load
from lagbench.references.calibrated import ROWS, change_constants, fastest_sound
from lagbench.scoring.calibrate import (
    count_terms,
    minimum_of_surface,
    spread_points,
)


def test_the_minimum_of_a_quadratic_polynomial_is_found() -> None:
    """In the box, or on its edge where the minimum lies beyond."""
    ends = np.array([[-1.0, 1.0], [0.0, 2.0]])
    points = spread_points(ends, 2 * count_terms(2))
    x, y = points.T
    values = 3.0 + (x - 0.2) ** 2 + 2.0 * (y - 0.5) ** 2 + 0.5 * (x - 0.2) * (y - 0.5)
    assert_allclose(minimum_of_surface(points, values, ends), [0.2, 0.5], atol=1e-5)
    assert_allclose(minimum_of_surface(points, x - y, ends), [-1.0, 2.0], atol=1e-5)


def test_points_fill_the_box() -> None:
    """Each quarter of each side has as many, within one or two."""
    points = spread_points(np.array([[0.0, 4.0], [-2.0, 2.0]]), 64)
    for column in (points[:, 0], points[:, 1] + 2.0):
        counts = np.bincount(column.astype(int), minlength=4)
        assert counts.min() >= 14
        assert counts.max() <= 18


@pytest.mark.parametrize("split", ["fluid", "multimaterial", "fluid-3d"])
def test_softer_matter_takes_longer_time_steps(split: str) -> None:
    """Sound crosses as many cells in a time step as before."""
    size = load().size(split, "mini")
    assert change_constants(size, {}).parameters == size.parameters
    softer = change_constants(size, {"modulus": -1.0, "moduli": -1.0})
    ratio = fastest_sound(softer) / fastest_sound(size)
    assert_allclose(ratio, np.exp(-0.5))
    assert softer.substeps_per_frame == np.ceil(ratio * size.substeps_per_frame)


def test_every_split_has_a_row_to_fit() -> None:
    """Its ranges are not empty."""
    for split in load().splits:
        size = load().size(split, "mini")
        rows = [row for row in ROWS if row.fits(size)]
        assert rows, split
        for row in rows:
            for low, high in row.ranges(size).values():
                assert low < high
