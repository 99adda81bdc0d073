"""Shapes and their particles: areas by counting, distances by hand, spread by k-d
tree.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scenario_draws import neighbours

from lagbench.generators import draws, shapes

# Three overlapping unit discs in a row, and one that touches them from above.
ROW = np.array(
    [
        [-1.0, 0.0],
        [0.0, 0.0],
        [1.0, 0.0],
        [0.0, 1.5],
    ]
)
SHAPES: dict[str, shapes.Shape] = {
    "rectangle": shapes.Rectangle(0.3, 0.15),
    "rope": shapes.Rectangle(0.65, 0.05, (0.6, 0.8)),
    "disc": shapes.Disc.of_area(0.05),
    "blobs": shapes.Blobs.of_area(0.05, ROW, cells=512),
}


def source(scenario: int = 0) -> np.random.Generator:
    """Return a stream of its own for one test."""
    stream: np.random.Generator
    stream = draws.generator("fluid", "test", 1, scenario)
    return stream


@pytest.mark.parametrize("name", SHAPES)
def test_area_reach_and_distance_agree_with_counting(name: str) -> None:
    """The points inside a fine grid give the area to 0.5 % and the bounding box to a
    cell.

    Outside, the distance is that to the nearest of them.
    """
    shape = SHAPES[name]
    node_count = 1501
    cell = 1.2 / node_count
    middles = np.arange(node_count) + 0.5
    side = 1.2 * middles / node_count - 0.6
    columns, rows = np.meshgrid(side, side)
    grid = np.stack([columns, rows], -1).reshape(-1, 2)
    inside = grid[shape.distance(grid) <= 0.0]
    area = len(inside) * cell**2
    assert area == pytest.approx(shape.measure, rel=5e-3)
    low = np.negative(shape.reach)
    greatest = inside.max(axis=0)
    least = inside.min(axis=0)
    assert_allclose(greatest, shape.reach, atol=cell)
    assert_allclose(least, low, atol=cell)

    rng = np.random.Generator(np.random.PCG64(1))
    share = rng.random((300, 2))
    probes = share * 1.6 - 0.8
    distance = shape.distance(probes)
    is_outside = distance > 0.0
    outer_probes = probes[is_outside]
    outer_distance = distance[is_outside]
    gaps, _ = neighbours(outer_probes, 1, among=inside)
    assert_allclose(outer_distance, gaps[:, 0], atol=1.5 * cell)


@pytest.mark.parametrize("count", [97, 625, 2500])
@pytest.mark.parametrize("name", SHAPES)
def test_sample_points_lie_evenly_inside(name: str, count: int) -> None:
    """All inside, nearest neighbours between half and 1.5 times the mean spacing."""
    body = shapes.body_at(SHAPES[name], 0.5, 0.4)
    position = shapes.sample_points(source(), body, count)
    assert position.shape == (count, 2)
    distance = body.distance(position)
    assert distance.max() <= 2.0**-20
    spacing = math.sqrt(body.shape.measure / count)
    gaps, _ = neighbours(position, 2)
    gap = gaps[:, 1]
    assert gap.min() > 0.5 * spacing
    assert gap.max() < 1.5 * spacing


def test_sample_points_have_the_centre_and_spread_of_the_body() -> None:
    """Second moments of a 0.65 x 0.05 bar along (0.6, 0.8): length^2/12 and
    width^2/12.
    """
    rope = shapes.body_at(SHAPES["rope"], 0.5, 0.5)
    position = shapes.sample_points(source(), rope, 2500)
    covariance = np.cov(position.T, bias=True)
    moments, axes = np.linalg.eigh(covariance)
    expected = [0.05**2 / 12, 0.65**2 / 12]
    assert moments == pytest.approx(expected, rel=0.03)
    long_axis = np.abs(axes[:, 1])
    centre = position.mean(axis=0)
    assert_allclose(long_axis, [0.6, 0.8], atol=0.003)
    assert_allclose(centre, 0.5, atol=0.003)
    # Two scenarios spread different points in the same body.
    body = shapes.body_at(SHAPES["disc"], 0.5, 0.5)
    first = shapes.sample_points(source(0), body, 50)
    second = shapes.sample_points(source(1), body, 50)
    gaps, _ = neighbours(second, 1, among=first)
    assert gaps.min() > 0.0


@given(
    scenario=st.integers(0, 2**30),
    name=st.sampled_from(sorted(SHAPES)),
)
def test_place_keeps_within_its_region(scenario: int, name: str) -> None:
    """The bounding box lies in the region whatever was drawn."""
    region = ((0.05, 0.95), (0.1, 0.8))
    stream = source(scenario)
    body = shapes.place(stream, SHAPES[name], region)
    quantum = 2.0**-20
    for axis, (low, high) in enumerate(region):
        centre = body.centre[axis]
        reach = body.shape.reach[axis]
        assert low - quantum <= centre - reach
        assert centre + reach <= high + quantum
