"""Energy, momentum, density and divergence against closed forms and numbers worked by
hand.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from metric_flows import (
    Floats,
    lattice,
    measure,
    measured,
    pair_of,
    pairs_of,
    scenario_of,
    swirl,
)
from numpy.testing import assert_allclose

from lagbench.metrics import METRICS, Score, aggregate, select, tally


def alone(name: str, *args: Any) -> float:
    """Measure a metric on one pair, made of the arguments, alone in its rollout."""
    metric = METRICS[name]
    statistics = measured(pair_of(*args), *metric.of)
    series = [np.array([value]) for value in statistics]
    (value,) = metric.series(*series)
    return float(value)


def scores_of(truth: Floats, prediction: Floats) -> dict[str, Score]:
    """Return all scores of one scenario."""
    scenario = scenario_of(truth, horizon=len(truth) - 2)
    metrics = select()
    pairs = pairs_of(scenario, truth, prediction)
    pieces = tally(pairs, metrics, scenario.config.predicted_frames)
    return aggregate(metrics, {0: pieces})


def turning(x: Floats) -> Floats:
    """Return the velocity of rotation about the centre of the box at rate 1."""
    arm_x, arm_y = (x - 0.5).T
    return np.stack([-arm_y, arm_x], axis=1)


def numbers(first: int, last: int) -> Floats:
    """Return whole numbers for frames, shape [frame, 1, 1]."""
    return np.arange(float(first), last + 1.0)[:, None, None]


def test_energy_by_hand() -> None:
    """Two particles of mass 1/2, speeds^2 0.05 and 0.04: E = (0.05 + 0.04)/4 = 0.0225
    (Eq. 5.11).

    E is quadratic: twice as fast is ratio 4, retention 4 against a steady truth's 1,
    error 3.
    """
    x = [[0.4, 0.4], [0.6, 0.6]]
    u = [[0.1, 0.2], [0.0, -0.2]]
    at_rest = np.zeros((2, 2))
    pair = pair_of(x, u, at_rest)
    assert measure(pair, "energy_true") == pytest.approx(0.0225)
    assert measure(pair, "energy_predicted") == pytest.approx(0.0)
    truth = lattice(10) + 0.01 * numbers(0, 4)
    prediction = truth.copy()
    prediction[2:] = truth[1] + 0.02 * numbers(1, 3)
    scores = scores_of(truth, prediction)
    for name, expected in (
        ("energy_ratio", 4.0),
        ("energy_retention", 4.0),
        ("energy_retention_true", 1.0),
        ("energy_error", 3.0),
    ):
        assert scores[name].mean == pytest.approx(expected)


def test_energies_of_a_truth_that_slows_or_rests() -> None:
    """E_true = 1, 0: the second frame is scaled by 1e-3, so 1e-4 there is an error 0.1.

    Of 0.9 and 1 % of the peak, the peak, then nothing, the ratio takes the second and
    third frame. No ratio, retention or error exists where the truth never moves; its
    frames are counted.
    """
    predicted = np.array([0.5, 1e-4])
    true = np.array([1.0, 0.0])
    errors = METRICS["energy_error"].series(predicted, true)
    assert_allclose(errors, [0.5, 0.1])

    predicted = np.array([5.0, 0.03, 9.0, 7.0])
    true = np.array([0.009, 0.01, 1.0, 0.0])
    ratios = METRICS["energy_ratio"].series(predicted, true)
    assert_allclose(ratios, [math.nan, 3.0, 9.0, math.nan])

    at_rest = np.repeat(lattice(10)[None], 5, axis=0)
    drift = 0.001 * numbers(0, 4)
    scores = scores_of(at_rest, at_rest + drift)
    for name in (
        "energy_ratio",
        "energy_retention",
        "energy_error",
        "momentum_error",
        "angular_momentum_error",
    ):
        assert math.isnan(scores[name].mean)
        assert scores[name].undefined == (3,)


def test_momentum_errors_have_a_floor() -> None:
    """A truth that slows to 1e-6 of its speed is scaled by 1e-3 of the first frame.

    The errors are 0.1, then 100 times the share of momentum.
    """
    x = lattice(12)
    u = 0.01 * turning(x) + 0.001
    last = x + 2 * u
    truth = np.stack([x, x + u, last, last + 1e-6 * u])
    prediction = truth.copy()
    prediction[2:] = truth[1] + 1.1 * numbers(1, 2) * u
    scores = scores_of(truth, prediction)

    momentum = np.hypot(*np.sum(u, axis=0))
    speeds = np.hypot(*u.T)
    share = momentum / np.sum(speeds)
    ratio = (1.1 - 1e-6) / 1e-3
    expected = [0.1 * share, ratio * share]
    errors = scores["momentum_error"].per_frame[0]
    assert_allclose(errors, expected, rtol=1e-6)
    angular_errors = scores["angular_momentum_error"].per_frame[0]
    assert angular_errors[1] < 1.2e3


def test_momentum_by_hand() -> None:
    """Truth two particles at speeds 3 and 4 apart, prediction with (0.3, 0.4) more
    each: 2 * 0.5 / 7.

    Solid-body rotation off by 10 %: L_pred - L_true = 0.1 L, and the scale is L itself.
    Added uniform motion changes momentum, not angular momentum of a symmetric body.
    """
    x = [[0.3, 0.5], [0.7, 0.5]]
    u = np.array([[3.0, 0.0], [0.0, 4.0]])
    more = np.array([0.3, 0.4])
    error = alone("momentum_error", x, u, u + more)
    assert error == pytest.approx(1.0 / 7.0)
    x = lattice(12)
    u = 0.1 * turning(x)
    faster = u + np.array([0.01, 0.02])
    for predicted, expected in (
        (1.1 * u, 0.1),
        (-u, 2.0),
        (faster, 0.0),
    ):
        error = alone("angular_momentum_error", x, u, predicted)
        assert error == pytest.approx(expected)
    assert alone("momentum_error", x, u, faster) > 0.1


def test_fields_of_an_expansion_and_of_missing_material() -> None:
    """The flow 0.01 r expands at 0.02 at nodes away from the walls; the swirl does not.

    Emptying the box takes density 1 from the inside nodes: RMSE is the RMS of the
    truth's density.
    """
    x = lattice(30)
    u = 0.01 * swirl(x)
    expansion = 0.01 * (x - 0.5)
    pair = pair_of(x, u, u + expansion)
    inside = pair.predicted_fields.divergence[4:-4, 4:-4]
    assert inside == pytest.approx(0.02, rel=1e-6)
    predicted_rms = measure(pair, "divergence_rms")
    true_rms = measure(pair, "divergence_rms_true")
    assert 0.01 < predicted_rms < 0.03
    assert true_rms < 0.1 * predicted_rms
    x = lattice(20)
    at_rest = np.zeros_like(x)
    pair = pair_of(x, at_rest, at_rest, predicted_position=x + 10.0)
    density = pair.truth.fields.density
    assert density[3:-3, 3:-3] == pytest.approx(1.0)
    expected = math.sqrt(np.mean(density**2))
    assert measure(pair, "density_rmse") == pytest.approx(expected)
