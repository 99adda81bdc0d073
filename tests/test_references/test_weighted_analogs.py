"""Weighted analogs: who follows which, and how good that is as shipped."""

from __future__ import annotations

import numpy as np
import pytest

from lagbench.data.registry import load
from lagbench.references import shipped
from lagbench.references.weighted_analogs import CHOSEN, divide_by_nearness


@pytest.mark.parametrize("sharpness", [0.0, 1.0, 3.0])
def test_shares_fall_with_the_distance(sharpness: float) -> None:
    """Every particle follows one analog; shares are d^-s over their sum, and in any
    stretch of particles nearly so.
    """
    distances = np.array([0.1, 0.15, 0.2, 0.4])
    followers = divide_by_nearness(distances, 1000, sharpness=sharpness)
    everybody = np.concatenate(followers)
    np.testing.assert_array_equal(np.sort(everybody), np.arange(1000))
    weights = distances**-sharpness
    shares = weights / weights.sum()
    for members, share in zip(followers, shares, strict=True):
        assert len(members) / 1000 == pytest.approx(share, abs=0.005)
        in_stretch = np.sum((members >= 300) & (members < 400))
        assert in_stretch / 100 == pytest.approx(share, abs=0.04)


def test_a_state_of_train_follows_itself() -> None:
    """An analog at distance 0 takes all particles, and nothing is divided by 0."""
    first, second = divide_by_nearness(np.array([0.0, 0.2]), 50, sharpness=3.0)
    assert len(first) == 50
    assert len(second) == 0


def test_it_is_the_best_naive_predictor_where_it_was_chosen() -> None:
    """Its mean is 5 % or more below that of the other naive predictors."""
    for key in CHOSEN:
        split, name, _ = key.rsplit("-", 2)
        references = shipped(load().size(split, name))
        assert references is not None
        means = {}
        for reference, scores in references.items():
            means[reference] = scores.scores["cloud_distance"].mean
        weighted = means["weighted-analogs"]
        assert weighted < 0.95 * means["ballistic-analog"]
        assert weighted < 0.95 * means["analog"]
