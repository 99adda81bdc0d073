"""How a box of three dimensions stands in a picture."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.figures.solid import PALEST, RIM, View, shade

CUBE = Box.from_bounds([(0.0, 1.0)] * 3)
FLAT = Box.from_bounds(
    [(0.1, 0.9), (0.2, 0.4), (0.0, 1.0)],
    periodic=[True, False, True],
)
BOXES = {"cube": CUBE, "flat": FLAT}


def corners_of(box: Box) -> NDArray[np.float64]:
    """Return the eight corners of a box, shape [corner, axis]."""
    corners = list(itertools.product(*box.bounds))
    return np.array(corners)


@pytest.mark.parametrize("name", BOXES)
def test_a_box_fills_the_picture_and_no_more(name: str) -> None:
    box = BOXES[name]
    places = View(box).place(corners_of(box))
    reach = np.abs(places - 0.5).max()
    assert reach == pytest.approx(0.5 - RIM)


def test_lengths_across_the_line_of_sight_keep_their_scale() -> None:
    """An orthographic view is a rotation: places and depth give back the distance."""
    view = View(CUBE)
    rng = np.random.default_rng(0)
    points = rng.random((20, 3))
    corners = corners_of(CUBE)
    depths = view.depth(corners)
    assert depths.min() == 0.0
    assert depths.max() == 1.0
    nearest = corners[depths.argmin()]
    farthest = corners[depths.argmax()]
    assert_array_equal(nearest + farthest, [1.0, 1.0, 1.0])
    # the longest depth follows from Pythagoras on the diagonal of the cube
    between_places = view.place(farthest) - view.place(nearest)
    across = np.linalg.norm(between_places) / view.scale
    longest = np.sqrt(3.0 - across**2)
    place = (view.place(points) - 0.5) / view.scale
    away = (view.depth(points) - 0.5) * longest
    square_place = np.sum(place**2, axis=1)
    length = np.sqrt(square_place + away**2)
    expected = np.linalg.norm(points - CUBE.centre, axis=1)
    assert_allclose(length, expected, rtol=1e-12)


def test_up_is_up_and_the_back_is_farther() -> None:
    view = View(CUBE)
    centre = np.full(3, 0.5)
    right, up, back = np.eye(3) * 0.1
    right_x, _ = view.place(centre + right)
    assert right_x > 0.5
    up_x, up_y = view.place(centre + up)
    assert up_x == pytest.approx(0.5)
    assert up_y > 0.5
    assert view.depth(centre + back) > view.depth(centre)


def test_the_farthest_particle_is_the_palest() -> None:
    black = np.zeros((2, 3))
    depths = np.array([0.0, 1.0])
    nearest, farthest = shade(black, depths, np.ones(3))
    assert_allclose(nearest, 0.0)
    assert_allclose(farthest, 1.0 - PALEST)
