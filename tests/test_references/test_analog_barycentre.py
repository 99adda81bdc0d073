"""The mean cloud of analogs: weights, means of known clouds, and how good it is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

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
    expected = distances**-sharpness / np.sum(distances**-sharpness)
    assert weights_of(distances, sharpness) == pytest.approx(expected)


def test_a_state_of_train_is_its_own_analog() -> None:
    """An analog at distance 0 has all the weight, and nothing is divided by 0."""
    assert weights_of(np.array([0.0, 0.2]), 3.0) == pytest.approx([1.0, 0.0])


def test_the_mean_of_two_gaussian_clouds_has_the_closed_form() -> None:
    """The barycentre of N(m, a^2 C) and N(n, b^2 C) is N((m + n)/2, ((a + b)/2)^2 C).

    The clouds are one sample of N(0, C), moved and scaled, in another order; so the
    mean cloud is that sample moved and scaled, and no particle's number matters.
    """
    rng = np.random.default_rng(5)
    sample = rng.standard_normal((200, 2)) @ np.array([[0.05, 0.02], [0.0, 0.03]])
    order = rng.permutation(200)
    first = 0.4 + 0.5 * sample
    second = (0.6 + 1.5 * sample)[order]
    analogs = []
    for cloud in (first, second):
        everybody = np.arange(200)
        analogs.append(FollowedAnalog(0.1, everybody, cloud[None], np.zeros((200, 2))))
    given: Any = SimpleNamespace(material=np.zeros(200, np.int8), box=UNIT_SQUARE)
    mean = MeanCloud(2.0)(given, analogs, 1)
    assert mean == pytest.approx(0.5 + sample, abs=1e-12)


def test_clouds_are_matched_in_every_tenth_frame() -> None:
    """The partners are kept up to the ninth frame and sought anew in the tenth."""
    start = np.array([[0.2, 0.2], [0.6, 0.6]])
    swapped = start[::-1]
    nearest = np.tile(start, (11, 1, 1))
    other = np.concatenate([nearest[:5], np.tile(swapped, (6, 1, 1))])
    everybody = np.arange(2)
    analogs = []
    for paths in (nearest, other):
        analogs.append(FollowedAnalog(0.1, everybody, paths, np.zeros((2, 2))))
    given: Any = SimpleNamespace(material=np.zeros(2, np.int8), box=UNIT_SQUARE)
    combine = MeanCloud(2.0)
    for frame in range(1, 5):
        assert combine(given, analogs, frame) == pytest.approx(start)
    assert combine(given, analogs, 9) == pytest.approx(np.full((2, 2), 0.4))
    assert combine(given, analogs, 10) == pytest.approx(start)


def test_all_particles_follow_each_analog() -> None:
    """Nobody is left out."""
    for members in follow_all(np.array([0.1, 0.2]), 7):
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
                means[reference] = scores.scores["cloud_distance"].mean
        best = means.pop("analog-barycentre")
        assert best < 0.95 * min(means.values())
