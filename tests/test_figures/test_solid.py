"""How a box of three dimensions stands in a picture."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import PIL.Image
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.figures.canvas import (
    build_palette,
    build_speed_map,
    build_vorticity_map,
    choose_palette,
    colour_bytes,
    reduce_colours,
)
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


def test_three_edges_meet_in_front() -> None:
    edges = list(View(CUBE).edges())
    assert len(edges) == 12
    front_count = sum(is_front for _, is_front in edges)
    assert front_count == 3


def test_the_farthest_particle_is_the_palest() -> None:
    black = np.zeros((2, 3))
    depths = np.array([0.0, 1.0])
    nearest, farthest = shade(black, depths, np.ones(3))
    assert_allclose(nearest, 0.0)
    assert_allclose(farthest, 1.0 - PALEST)


def written_colours(image: PIL.Image.Image, palette: Any) -> NDArray[np.float64]:
    """Return the colours of a picture as its file has them."""
    reduced = reduce_colours(image, palette).convert("RGB")
    return np.asarray(reduced).astype(float)


def test_pale_particles_keep_their_hue() -> None:
    """Speeds that fade into the paper are nearly the colours of the file."""
    speeds = colour_bytes(build_speed_map()).astype(float)
    paper = build_palette()[0].astype(float)
    rows = []
    for share in np.linspace(PALEST, 1.0, 25):
        rows.append(share * speeds + (1.0 - share) * paper)
    exact = np.array(rows).round().astype(np.uint8)
    image = PIL.Image.fromarray(exact)
    palette = choose_palette(image)
    assert not np.array_equal(palette, build_palette())
    difference = written_colours(image, palette) - exact
    assert np.abs(difference).max() <= 24
    mean_square = np.mean(difference**2)
    assert np.sqrt(mean_square) <= 7


def test_flat_pictures_keep_their_palette() -> None:
    """A picture with signed vorticity has the palette that holds its colours."""
    colours = colour_bytes(build_vorticity_map())[None]
    image = PIL.Image.fromarray(colours)
    palette = choose_palette(image)
    assert_array_equal(palette, build_palette())
    difference = written_colours(image, palette) - colours
    assert np.abs(difference).max() <= 8
