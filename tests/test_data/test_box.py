"""The box against distances by hand and a brute-force search of periodic images."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from lagbench.data.box import Box

Floats = NDArray[np.floating[Any]]

WALLED = Box.from_bounds([(0.1, 0.9), (0.0, 1.0)])
CHANNEL = Box.from_bounds(
    [(0.0, 2.0), (0.1, 0.9)],
    periodic=[True, False],
)
SOLID = Box.from_bounds(
    [(0.0, 1.0), (-1.0, 1.0), (0.0, 0.5)],
    periodic=[True, True, True],
)
BOXES = (WALLED, CHANNEL, SOLID)


def random_points(rng: np.random.Generator, box: Box, count: int) -> Floats:
    """Return points of a box, shape [point, axis]."""
    share = rng.random((count, box.dimension))
    return box.low + box.lengths * share


def nearest_image(box: Box, start: Floats, end: Floats) -> Floats:
    """Return the shortest of all ways to the images of a point, two periods around."""
    periods = []
    for is_periodic in box.periodic:
        periods.append(range(-2, 3) if is_periodic else range(1))
    ways = []
    for shift in itertools.product(*periods):
        image = end + np.array(shift) * box.lengths
        ways.append(image - start)
    return min(ways, key=np.linalg.norm)


@pytest.mark.parametrize("box", BOXES)
def test_a_displacement_leads_to_the_nearest_image(box: Box) -> None:
    rng = np.random.default_rng(0)
    start = random_points(rng, box, 50)
    end = random_points(rng, box, 50)
    ways = box.displacement(start, end)
    for way, here, there in zip(ways, start, end, strict=True):
        expected = nearest_image(box, here, there)
        assert_allclose(way, expected, atol=1e-12)


def test_the_largest_radius_is_half_of_the_shortest_period() -> None:
    assert WALLED.largest_radius == np.inf
    assert CHANNEL.largest_radius == 1.0  # its height of 0.8 lies between walls
    assert SOLID.largest_radius == 0.25
    assert WALLED.allows_radius(5.0)
    assert SOLID.allows_radius(0.25)
    assert not SOLID.allows_radius(0.251)


def test_between_walls_a_displacement_is_the_plain_difference_bit_for_bit() -> None:
    rng = np.random.default_rng(1)
    start = rng.random((100, 2)).astype(np.float32)
    end = rng.random((100, 2)).astype(np.float32)
    way = WALLED.displacement(start, end)
    assert way.dtype == np.float32
    assert_array_equal(way, end - start)


@pytest.mark.parametrize("box", [CHANNEL, SOLID])
def test_wrapped_points_lie_in_the_box_and_are_the_same_points(box: Box) -> None:
    rng = np.random.default_rng(2)
    share = rng.uniform(-3.0, 4.0, (200, box.dimension))
    position = box.low + box.lengths * share
    wrapped = box.wrap(position)
    periods = (wrapped - position) / box.lengths
    assert_allclose(periods, np.rint(periods), atol=1e-12)
    for axis, is_periodic in enumerate(box.periodic):
        along_axis = wrapped[:, axis]
        if is_periodic:
            assert (along_axis >= box.low[axis]).all()
            assert (along_axis < box.high[axis]).all()
        else:
            assert_array_equal(along_axis, position[:, axis])


def test_a_point_just_below_the_lower_end_does_not_wrap_to_the_upper_end() -> None:
    zero = np.float32(0.0)
    just_below = np.nextafter(zero, np.float32(-1.0))
    position = np.array([[just_below, 0.5]], np.float32)
    wrapped = CHANNEL.wrap(position)
    assert 0.0 <= wrapped[0, 0] < 2.0


def test_points_beyond_a_wall_are_put_on_it_and_others_wrapped() -> None:
    position = [
        [2.5, 0.95],
        [-0.5, 0.05],
        [1.0, 0.5],
    ]
    expected = [
        [0.5, 0.9],
        [1.5, 0.1],
        [1.0, 0.5],
    ]
    assert_allclose(CHANNEL.inside(position), expected)


def test_contained_points_lie_between_the_walls() -> None:
    points = [
        [0.5, 0.5],
        [0.95, 0.5],
        [np.nan, 0.5],
        [0.5, 1.0],
    ]
    contained = WALLED.contains(points)
    assert_array_equal(contained, [True, False, False, True])
    far_along_the_channel = [
        [7.0, 0.5],
        [7.0, 1.0],
    ]
    contained = CHANNEL.contains(far_along_the_channel)
    assert_array_equal(contained, [True, False])
    assert WALLED.contains([0.92, 0.5], tolerance=0.03)


def test_unwrapping_keeps_the_bits_along_walls() -> None:
    """Images lie next to the first point; components between walls stay as they are."""
    rng = np.random.Generator(np.random.PCG64(3))
    points = random_points(rng, CHANNEL, 100).astype(np.float32)
    unwrapped = CHANNEL.unwrap(points)
    assert_array_equal(unwrapped[:, 1], points[:, 1])
    assert np.abs(unwrapped[:, 0] - points[0, 0]).max() <= 1.0
    assert_allclose(CHANNEL.wrap(unwrapped)[:, 0], points[:, 0], atol=1e-6)


def test_walls_are_named_by_the_axes_that_have_them() -> None:
    assert WALLED.walls == ("left", "right", "bottom", "top")
    assert CHANNEL.walls == ("bottom", "top")
    assert SOLID.walls == ()
    cube = Box.from_bounds([(0.0, 1.0)] * 3)
    assert cube.walls == ("left", "right", "bottom", "top", "front", "back")
    assert SOLID.volume == pytest.approx(1.0)


def test_a_point_just_below_the_upper_end_stands_in_a_tree() -> None:
    """Its distance from the lower end rounds to the period: it stands at that end."""
    box = Box.from_bounds([(-1.0, 0.1), (0.0, 1.0)], periodic=[True, False])
    below_end = np.nextafter(0.1, 0.0)
    points = np.array([[below_end, 0.5], [-0.99, 0.5], [-0.5, 0.5]])
    tree = box.tree(points)
    neighbours = tree.query_ball_point(box.tree_points(points[:1]), 0.02)
    assert sorted(neighbours[0]) == [0, 1]
