"""How a box of three dimensions stands in a picture."""

from __future__ import annotations

import itertools

import numpy as np
import PIL.Image
import pytest
from numpy.testing import assert_allclose, assert_array_equal

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

BOXES = {
    "cube": Box.from_bounds([(0.0, 1.0)] * 3),
    "flat": Box.from_bounds([(0.1, 0.9), (0.2, 0.4), (0.0, 1.0)], [True, False, True]),
}


@pytest.mark.parametrize("name", BOXES)
def test_a_box_fills_the_picture_and_no_more(name: str) -> None:
    corners = np.array(list(itertools.product(*BOXES[name].bounds)))
    places = View(BOXES[name]).place(corners)
    reach = np.abs(places - 0.5).max()
    assert reach == pytest.approx(0.5 - RIM)


def test_lengths_across_the_line_of_sight_keep_their_scale() -> None:
    """An orthographic view is a rotation: places and depth give back the distance."""
    box = BOXES["cube"]
    view = View(box)
    points = np.random.default_rng(0).random((20, 3))
    corners = np.array(list(itertools.product(*box.bounds)))
    depths = view.depth(corners)
    assert depths.min() == 0.0
    assert depths.max() == 1.0
    nearest = corners[depths.argmin()]
    farthest = corners[depths.argmax()]
    assert_array_equal(nearest + farthest, [1.0, 1.0, 1.0])
    # the longest depth follows from Pythagoras on the diagonal of the cube
    across = np.linalg.norm(view.place(farthest) - view.place(nearest)) / view.scale
    longest = np.sqrt(3.0 - across**2)
    way = points - box.centre
    place = (view.place(points) - 0.5) / view.scale
    away = (view.depth(points) - 0.5) * longest
    length = np.sqrt((place**2).sum(axis=1) + away**2)
    assert_allclose(length, np.linalg.norm(way, axis=1), rtol=1e-12)


def test_up_is_up_and_the_back_is_farther() -> None:
    view = View(BOXES["cube"])
    centre = np.full(3, 0.5)
    right, up, back = np.eye(3) * 0.1
    assert view.place(centre + right)[0] > 0.5
    assert view.place(centre + up)[1] > 0.5
    assert view.place(centre + up)[0] == pytest.approx(0.5)
    assert view.depth(centre + back) > view.depth(centre)


def test_three_edges_meet_in_front() -> None:
    edges = list(View(BOXES["cube"]).edges())
    assert len(edges) == 12
    assert sum(is_front for _, is_front in edges) == 3


def test_the_farthest_particle_is_the_palest() -> None:
    colours = np.zeros((2, 3))
    shaded = shade(colours, np.array([0.0, 1.0]), np.ones(3))
    assert_allclose(shaded, [[0.0] * 3, [1.0 - PALEST] * 3])


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
    reduced = np.asarray(reduce_colours(image, palette).convert("RGB"))
    difference = reduced.astype(float) - exact
    assert np.abs(difference).max() <= 24
    assert np.sqrt(np.mean(difference**2)) <= 7


def test_flat_pictures_keep_their_palette() -> None:
    """A picture with signed vorticity has the palette that holds its colours."""
    colours = colour_bytes(build_vorticity_map())[None]
    image = PIL.Image.fromarray(colours)
    palette = choose_palette(image)
    assert_array_equal(palette, build_palette())
    reduced = np.asarray(reduce_colours(image, palette).convert("RGB"))
    assert np.abs(reduced.astype(float) - colours).max() <= 8
