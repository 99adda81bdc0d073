"""The box against distances by hand and a brute-force search of periodic images."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from lagbench.data.box import Box
from lagbench.errors import UsageError

WALLED = Box.from_bounds([(0.1, 0.9), (0.0, 1.0)])
CHANNEL = Box.from_bounds([(0.0, 2.0), (0.1, 0.9)], periodic=[True, False])
SOLID = Box.from_bounds([(0.0, 1.0), (-1.0, 1.0), (0.0, 0.5)], periodic=[True] * 3)
BOXES = (WALLED, CHANNEL, SOLID)


def nearest_image(box: Box, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the shortest of all ways to the images of a point, two periods around."""
    shifts = []
    for is_periodic in box.periodic:
        shifts.append(range(-2, 3) if is_periodic else range(1))
    ways = [
        end - start + np.array(shift) * box.lengths
        for shift in itertools.product(*shifts)
    ]
    return min(ways, key=lambda way: float(np.linalg.norm(way)))


@pytest.mark.parametrize("box", BOXES)
def test_a_displacement_leads_to_the_nearest_image(box: Box) -> None:
    rng = np.random.default_rng(0)
    start = box.low + box.lengths * rng.random((50, box.dimension))
    end = box.low + box.lengths * rng.random((50, box.dimension))
    ways = box.displacement(start, end)
    for way, here, there in zip(ways, start, end, strict=True):
        assert_allclose(way, nearest_image(box, here, there), atol=1e-12)


def test_between_walls_a_displacement_is_the_plain_difference_bit_for_bit() -> None:
    rng = np.random.default_rng(1)
    start = rng.random((100, 2)).astype("float32")
    end = rng.random((100, 2)).astype("float32")
    way = WALLED.displacement(start, end)
    assert way.dtype == np.float32
    assert_array_equal(way, end - start)


@pytest.mark.parametrize("box", [CHANNEL, SOLID])
def test_wrapped_points_lie_in_the_box_and_are_the_same_points(box: Box) -> None:
    rng = np.random.default_rng(2)
    position = box.low + box.lengths * rng.uniform(-3.0, 4.0, (200, box.dimension))
    wrapped = box.wrap(position)
    periods = (wrapped - position) / box.lengths
    assert_allclose(periods, np.rint(periods), atol=1e-12)
    for axis, is_periodic in enumerate(box.periodic):
        if is_periodic:
            assert (wrapped[:, axis] >= box.low[axis]).all()
            assert (wrapped[:, axis] < box.high[axis]).all()
        else:
            assert_array_equal(wrapped[:, axis], position[:, axis])


def test_a_point_just_below_the_lower_end_does_not_wrap_to_the_upper_end() -> None:
    tiny = np.nextafter(np.float32(0.0), np.float32(-1.0))
    wrapped = CHANNEL.wrap(np.array([[tiny, 0.5]], "float32"))
    assert 0.0 <= wrapped[0, 0] < 2.0


def test_points_beyond_a_wall_are_put_on_it_and_others_wrapped() -> None:
    inside = CHANNEL.inside([[2.5, 0.95], [-0.5, 0.05], [1.0, 0.5]])
    assert_allclose(inside, [[0.5, 0.9], [1.5, 0.1], [1.0, 0.5]])


def test_contained_points_lie_between_the_walls() -> None:
    points = [[0.5, 0.5], [0.95, 0.5], [np.nan, 0.5], [0.5, 1.0]]
    assert_array_equal(WALLED.contains(points), [True, False, False, True])
    assert_array_equal(CHANNEL.contains([[7.0, 0.5], [7.0, 1.0]]), [1, 0])
    assert WALLED.contains([0.92, 0.5], tolerance=0.03)


def test_walls_are_named_by_the_axes_that_have_them() -> None:
    assert WALLED.walls == ("left", "right", "bottom", "top")
    assert CHANNEL.walls == ("bottom", "top")
    assert SOLID.walls == ()
    cube = Box.from_bounds([(0.0, 1.0)] * 3)
    assert cube.walls == ("left", "right", "bottom", "top", "front", "back")
    assert SOLID.volume == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("bounds", "periodic"),
    [
        ([(0.0, 1.0)], None),
        ([(0.0, 1.0)] * 4, None),
        ([(0.0, 1.0), (1.0, 1.0)], None),
        ([(0.0, 1.0), (0.0, float("nan"))], None),
        ([(0.0, 1.0), (0.0, 1.0)], [True]),
    ],
)
def test_what_is_no_box_is_refused(
    bounds: list[tuple[float, float]], periodic: list[bool] | None
) -> None:
    with pytest.raises(UsageError):
        Box.from_bounds(bounds, periodic)
