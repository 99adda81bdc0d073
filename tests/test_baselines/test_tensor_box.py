"""The box of tensors does what the box of arrays does."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from lagbench.data.box import Box, keep_outside
from lagbench.tensors import TensorBox

UNIT = (0.0, 1.0)
INNER = (0.1, 0.9)
WALLED = Box.from_bounds([INNER, UNIT])
CHANNEL = Box.from_bounds([(0.0, 2.0), INNER], [True, False])
SOLID = Box.from_bounds([UNIT, (-1.0, 1.0), (0.0, 0.5)], [True] * 3)
EVERY_BOX = pytest.mark.parametrize("box", [WALLED, CHANNEL, SOLID])


def draw_points(box: Box, seed: int) -> torch.Tensor:
    """Return points in a box and beyond it [length], float64, [particle, axis]."""
    rng = np.random.default_rng(seed)
    share = rng.uniform(-2.0, 3.0, (300, box.dimension))
    points = box.low + box.lengths * share
    return torch.from_numpy(points)


@EVERY_BOX
def test_ways_are_those_of_the_box_of_arrays(box: Box) -> None:
    start = draw_points(box, 0)
    end = draw_points(box, 1)
    tensor_box = TensorBox(box)
    way = tensor_box.displacement(start, end).numpy()
    expected = box.displacement(start.numpy(), end.numpy())
    assert_allclose(way, expected, atol=1e-6)


@EVERY_BOX
def test_points_inside_are_those_of_the_box_of_arrays(box: Box) -> None:
    points = draw_points(box, 2)
    tensor_box = TensorBox(box)
    inside = tensor_box.inside(points).numpy()
    assert box.contains(inside, tolerance=1e-6).all()
    expected = box.inside(points.numpy())
    gap = box.displacement(expected, inside)
    assert_allclose(gap, 0.0, atol=1e-6)


@pytest.mark.parametrize("low", [0.0, 0.1, -0.5, 0.3])
@pytest.mark.parametrize("length", [0.3, 0.7, 1.0, 6.0])
def test_wrapped_points_lie_in_the_box_whatever_is_rounded(
    low: float, length: float
) -> None:
    """Points next to whole periods are rounded to either side of an end."""
    box = Box.from_bounds([(low, low + length), UNIT], [True, False])
    points = []
    for periods in range(-4, 5):
        place = np.float32(low + periods * length)
        for _ in range(6):
            place = np.nextafter(place, np.float32(-np.inf))
        for _ in range(12):
            points.append([place, -0.25])
            place = np.nextafter(place, np.float32(np.inf))
    position = torch.tensor(np.array(points))
    tensor_box = TensorBox(box)
    x, y = tensor_box.wrap(position).unbind(dim=1)
    start = np.float32(low)
    end = start + np.float32(length)
    assert bool((x >= start).all())
    assert bool((x < end).all())
    # Between walls nothing is wrapped.
    assert torch.equal(y, position[:, 1])


def test_points_in_an_obstacle_are_those_of_the_box_of_arrays() -> None:
    """Across a periodic end the nearest image of the obstacle counts."""
    obstacle = np.array([1.95, 0.5, 0.1])
    offset = np.random.default_rng(3).normal(0.0, 0.1, (300, 2))
    points = obstacle[:2] + offset
    expected = CHANNEL.inside(keep_outside(points, obstacle))
    position = torch.from_numpy(CHANNEL.inside(points))
    own_obstacle = torch.from_numpy(obstacle).expand(300, 3)
    moved = TensorBox(CHANNEL).outside(position, own_obstacle)
    assert_allclose(CHANNEL.displacement(expected, moved.numpy()), 0.0, atol=1e-6)
