"""The box of tensors does what the box of arrays does."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from lagbench.data.box import Box
from lagbench.tensors import TensorBox

WALLED = Box.from_bounds([(0.1, 0.9), (0.0, 1.0)])
CHANNEL = Box.from_bounds([(0.0, 2.0), (0.1, 0.9)], periodic=[True, False])
SOLID = Box.from_bounds([(0.0, 1.0), (-1.0, 1.0), (0.0, 0.5)], periodic=[True] * 3)
EVERY_BOX = pytest.mark.parametrize("box", [WALLED, CHANNEL, SOLID])


def draw_points(box: Box, seed: int) -> torch.Tensor:
    """Return points in a box and beyond it [length], float64, [particle, axis]."""
    rng = np.random.default_rng(seed)
    points = box.low + box.lengths * rng.uniform(-2.0, 3.0, (300, box.dimension))
    return torch.from_numpy(points)


@EVERY_BOX
def test_ways_are_those_of_the_box_of_arrays(box: Box) -> None:
    start = draw_points(box, 0)
    end = draw_points(box, 1)
    way = TensorBox(box).displacement(start, end).numpy()
    expected = box.displacement(start.numpy(), end.numpy())
    assert_allclose(way, expected, atol=1e-6)


@EVERY_BOX
def test_points_inside_are_those_of_the_box_of_arrays(box: Box) -> None:
    points = draw_points(box, 2)
    inside = TensorBox(box).inside(points).numpy()
    assert box.contains(inside, tolerance=1e-6).all()
    gap = box.displacement(box.inside(points.numpy()), inside)
    assert_allclose(gap, 0.0, atol=1e-6)


def test_between_walls_the_bits_are_those_of_a_clamp_and_a_difference() -> None:
    box = TensorBox(WALLED)
    start = draw_points(WALLED, 3).float()
    end = draw_points(WALLED, 4).float()
    low, high = start.new_tensor(WALLED.bounds).T
    assert torch.equal(box.displacement(start, end), end - start)
    assert torch.equal(box.inside(start), start.clamp(low, high))
    velocity = end.clamp(low - start, high - start)
    assert torch.equal(box.stop_at_walls(start, end), velocity)


@EVERY_BOX
def test_gradients_are_those_of_a_difference(box: Box) -> None:
    start = draw_points(box, 5)
    end = draw_points(box, 6).requires_grad_()
    TensorBox(box).displacement(start, end).sum().backward()
    assert end.grad is not None
    assert bool((end.grad == 1.0).all())


def test_a_box_adds_nothing_to_the_weights() -> None:
    assert not TensorBox(SOLID).state_dict()
