"""The mean cloud of analogs: weights, means of known clouds, and how good it is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lagbench.data.box import UNIT_SQUARE
from lagbench.data.registry import load
from lagbench.references import shipped
from lagbench.references.analog_barycentre import (
    CHOSEN,
    MeanCloud,
    follow_all,
    weights_of,
)
from lagbench.references.ballistic_analog import FollowedAnalog
from lagbench.references.table import NAIVE


@pytest.mark.parametrize("sharpness", [0.0, 1.0, 3.0])
def test_weights_fall_with_the_distance(sharpness: float) -> None:
    """Weights are d^-s over their sum; with s = 0 all are alike."""
    distances = np.array([0.1, 0.15, 0.2, 0.4])
    powers = distances**-sharpness
    expected = powers / powers.sum()
    assert weights_of(distances, sharpness) == pytest.approx(expected)


def test_a_state_of_train_is_its_own_analog() -> None:
    """An analog at distance 0 has all the weight, and nothing is divided by 0."""
    distances = np.array([0.0, 0.2])
    weights = weights_of(distances, 3.0)
    assert weights == pytest.approx([1.0, 0.0])


def liquid_in_the_unit_square(count: int) -> Any:
    """Return what the mean of clouds needs to know of a scenario."""
    material = np.zeros(count, np.int8)
    return SimpleNamespace(material=material, box=UNIT_SQUARE)


def analog_at(paths: NDArray[np.float64]) -> FollowedAnalog:
    """Return an analog of distance 0.1 that all particles follow from 0."""
    count = paths.shape[1]
    everybody = np.arange(count)
    start = np.zeros((count, 2))
    return FollowedAnalog(0.1, everybody, paths, start)


def test_the_mean_of_two_gaussian_clouds_has_the_closed_form() -> None:
    """The barycentre of N(m, a^2 C) and N(n, b^2 C) is N((m + n)/2, ((a + b)/2)^2 C).

    The clouds are one sample of N(0, C), moved and scaled, in another order; so the
    mean cloud is that sample moved and scaled, and no particle's number matters.
    """
    rng = np.random.default_rng(5)
    mixing = np.array(
        [
            [0.05, 0.02],
            [0.0, 0.03],
        ]
    )
    sample = rng.standard_normal((200, 2)) @ mixing
    order = rng.permutation(200)
    first = 0.4 + 0.5 * sample
    second = (0.6 + 1.5 * sample)[order]
    analogs = [analog_at(first[None]), analog_at(second[None])]
    given = liquid_in_the_unit_square(200)
    combine = MeanCloud(2.0)
    mean = combine(given, analogs, 1)
    assert mean == pytest.approx(0.5 + sample, abs=1e-12)


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
    given = liquid_in_the_unit_square(2)
    combine = MeanCloud(2.0)
    for frame in range(1, 5):
        mean = combine(given, analogs, frame)
        assert mean == pytest.approx(start)
    middle = np.full((2, 2), 0.4)
    ninth = combine(given, analogs, 9)
    tenth = combine(given, analogs, 10)
    assert ninth == pytest.approx(middle)
    assert tenth == pytest.approx(start)


def test_all_particles_follow_each_analog() -> None:
    """Nobody is left out."""
    distances = np.array([0.1, 0.2])
    for members in follow_all(distances, 7):
        np.testing.assert_array_equal(members, np.arange(7))


def test_it_is_the_best_naive_predictor_where_it_was_chosen() -> None:
    """Its mean is 5 % or more below that of the other naive predictors."""
    for key in CHOSEN:
        split, name, _ = key.rsplit("-", 2)
        references = shipped(load().size(split, name))
        assert references is not None
        means = {}
        for reference, scores in references.items():
            if reference in NAIVE:
                score = scores.scores["cloud_distance"]
                means[reference] = score.mean
        best = means.pop("analog-barycentre")
        assert best < 0.95 * min(means.values())
