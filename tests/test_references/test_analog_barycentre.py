"""The mean cloud of analogs: weights, means of known clouds, and how good it is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.data.registry import load
from lagbench.references.analog_barycentre import (
    MATCHED_TOGETHER,
    MeanCloud,
    weights_of,
)
from lagbench.references.ballistic_analog import FollowedAnalog
from lagbench.references.train_library import mirrors_of

Floats = NDArray[np.float64]


@pytest.mark.parametrize("sharpness", [0.0, 1.0, 3.0])
def test_weights_fall_with_the_distance(sharpness: float) -> None:
    """Weights are d^-s over their sum; with s = 0 all are alike."""
    distances = np.array([0.1, 0.15, 0.2, 0.4])
    powers = distances**-sharpness
    expected = powers / powers.sum()
    assert weights_of(distances, sharpness) == pytest.approx(expected)


def scenario_of(material: NDArray[np.int8], box: Box) -> Any:
    """Return what the mean of clouds needs to know of a scenario."""
    return SimpleNamespace(material=material, box=box)


def liquid_in_a_unit_box(count: int, dimension: int = 2) -> Any:
    """Return a scenario of liquid between walls."""
    material = np.zeros(count, np.int8)
    box = Box.from_bounds([(0.0, 1.0)] * dimension)
    return scenario_of(material, box)


def analog_at(paths: Floats, distance: float = 0.1) -> FollowedAnalog:
    """Return an analog that all particles follow without any offset."""
    _, count, dimension = paths.shape
    everybody = np.arange(count)
    offset = np.zeros((count, dimension))
    return FollowedAnalog(distance, everybody, paths, offset)


@pytest.mark.parametrize(
    ("dimension", "count"), [(2, 200), (3, 200), (3, 2 * MATCHED_TOGETHER)]
)
def test_the_mean_of_two_gaussian_clouds_has_the_closed_form(
    dimension: int, count: int
) -> None:
    """The barycentre of N(m, a^2 C) and N(n, b^2 C) is N((m + n)/2, ((a + b)/2)^2 C).

    The clouds are one sample of N(0, C), moved and scaled, in another order; so the
    mean cloud is that sample moved and scaled, and no particle's number matters. This
    is so, too, when there are too many particles to be matched together.
    """
    rng = np.random.default_rng(5)
    mixing = np.array(
        [
            [0.05, 0.02, 0.0],
            [0.0, 0.03, 0.01],
            [0.0, 0.0, 0.02],
        ]
    )
    sample = rng.standard_normal((count, dimension)) @ mixing[:dimension, :dimension]
    order = rng.permutation(count)
    first = 0.4 + 0.5 * sample
    second = (0.6 + 1.5 * sample)[order]
    analogs = [analog_at(first[None]), analog_at(second[None])]
    given = liquid_in_a_unit_box(count, dimension)
    combine = MeanCloud(2.0)
    mean = combine(given, analogs, 1)
    assert mean == pytest.approx(0.5 + sample, abs=1e-12)


def moving_bodies(dimension: int) -> tuple[Any, list[FollowedAnalog], Floats]:
    """Return two bodies, three analogs of their motion, and their mean motion.

    In each analog the bodies keep their shapes and move at speeds of their own, in
    the second one past each other. Within a body the particles have another order in
    each analog. The mean is that of the velocities, with weights d^-2 / sum d^-2.
    """
    rng = np.random.default_rng(8)
    count = 40  # particles of a body
    frames = np.arange(12.0)
    left = rng.uniform(0.3, 0.4, (count, dimension))
    right = rng.uniform(0.6, 0.7, (count, dimension))
    material = np.repeat([0, 2], count).astype(np.int8)

    distances = np.array([0.1, 0.2, 0.4])
    weights = np.array([16.0, 4.0, 1.0]) / 21.0
    velocities = rng.uniform(-0.01, 0.01, (3, 2, dimension))  # [analog, body, axis]
    velocities[1, 0, 0] = 0.035
    velocities[1, 1, 0] = -0.035

    analogs = []
    for distance, (left_velocity, right_velocity) in zip(
        distances, velocities, strict=True
    ):
        left_path = left + frames[:, None, None] * left_velocity
        right_path = right + frames[:, None, None] * right_velocity
        left_order = rng.permutation(count)
        right_order = rng.permutation(count)
        if not analogs:  # the mean has the order of the nearest analog
            left_order = np.arange(count)
            right_order = np.arange(count)
        paths = [left_path[:, left_order], right_path[:, right_order]]
        analogs.append(analog_at(np.concatenate(paths, axis=1), float(distance)))

    mean_velocity = np.einsum("k,kbx->bx", weights, velocities)
    start = np.concatenate([left, right])
    velocity = np.repeat(mean_velocity, count, axis=0)
    expected = start + frames[:, None, None] * velocity
    box = Box.from_bounds([(0.0, 1.0)] * dimension)
    return scenario_of(material, box), analogs, expected


@pytest.mark.parametrize(
    ("split", "images"),
    [
        ("multimaterial", 2),
        ("multimaterial-3d", 4),
    ],
)
def test_mirrored_analogs_have_the_mirrored_mean(split: str, images: int) -> None:
    """In all mirror images of a box the mean cloud is the mirrored one."""
    size = load().size(split, "mini")
    given, analogs, expected = moving_bodies(size.box.dimension)
    frame = 7
    mirrors = mirrors_of(size)
    assert len(mirrors) == images
    for mirror in mirrors:
        mirrored_analogs = []
        for analog in analogs:
            paths = mirror.positions(analog.paths)
            mirrored_analogs.append(analog_at(paths, analog.distance))
        combine = MeanCloud(2.0)
        mean = combine(given, mirrored_analogs, frame)
        mirrored = mirror.positions(expected[frame])
        assert mean == pytest.approx(mirrored, abs=1e-12)


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_mean_across_the_ends_of_a_periodic_box_lies_there(dimension: int) -> None:
    """Halfway between 0.9 and 0.2 of the next image is 1.05; with walls it is 0.55."""
    nearest = np.full((1, 1, dimension), 0.9)
    other = np.full((1, 1, dimension), 0.2)
    analogs = [analog_at(nearest), analog_at(other)]
    given = liquid_in_a_unit_box(1, dimension)
    is_periodic = [False] * dimension
    is_periodic[0] = True
    given.box = Box.from_bounds([(0.0, 1.0)] * dimension, is_periodic)
    combine = MeanCloud(2.0)
    mean = combine(given, analogs, 1)
    expected = [1.05] + [0.55] * (dimension - 1)
    assert mean == pytest.approx(np.array([expected]))


def test_clouds_are_matched_in_every_tenth_frame() -> None:
    """The partners are kept up to the ninth frame and sought anew in the tenth."""
    start = np.array(
        [
            [0.2, 0.2],
            [0.6, 0.6],
        ]
    )
    swapped = start[::-1]
    nearest = np.tile(start, (11, 1, 1))
    later = np.tile(swapped, (6, 1, 1))
    other = np.concatenate([nearest[:5], later])
    analogs = [analog_at(nearest), analog_at(other)]
    given = liquid_in_a_unit_box(2)
    combine = MeanCloud(2.0)
    for frame in range(1, 5):
        mean = combine(given, analogs, frame)
        assert mean == pytest.approx(start)
    middle = np.full((2, 2), 0.4)
    ninth = combine(given, analogs, 9)
    tenth = combine(given, analogs, 10)
    assert ninth == pytest.approx(middle)
    assert tenth == pytest.approx(start)
