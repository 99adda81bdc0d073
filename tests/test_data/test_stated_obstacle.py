"""The obstacle that a file states, and points that are kept out of it."""

from __future__ import annotations

import numpy as np

from lagbench.data.box import keep_outside, parse_obstacle

STATED = {"obstacle_x": 0.25, "obstacle_y": 0.5, "obstacle_diameter": 0.125}


def test_centre_and_radius_come_from_the_attributes() -> None:
    """The radius is half of the diameter; a file without a diameter has no obstacle."""
    obstacle = parse_obstacle(STATED, 2, where="a file")
    assert obstacle is not None
    np.testing.assert_array_equal(obstacle, np.float32([0.25, 0.5, 0.0625]))
    assert parse_obstacle({"viscosity": 1e-3}, 2, where="a file") is None
    ball = parse_obstacle({**STATED, "obstacle_z": 0.75}, 3, where="a file")
    assert ball is not None
    np.testing.assert_array_equal(ball, np.float32([0.25, 0.5, 0.75, 0.0625]))


def test_points_inside_are_put_on_the_surface() -> None:
    """They move away from the centre; points outside and the centre itself stay."""
    obstacle = np.float32([0.25, 0.5, 0.125])
    points = np.array([[0.25, 0.5], [0.25, 0.5625], [0.25, 0.75], [0.28, 0.54]])
    moved = keep_outside(points, obstacle)
    np.testing.assert_array_equal(moved[[0, 2]], points[[0, 2]])
    np.testing.assert_allclose(moved[1], [0.25, 0.625])
    np.testing.assert_allclose(moved[3], [0.25 + 0.075, 0.5 + 0.1])
