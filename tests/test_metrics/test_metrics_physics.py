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
    measured,
    pair_of,
    pairs_of,
    rollout,
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
    return float(metric.series(*series)[0])


def scores_of(truth: Floats, prediction: Floats) -> dict[str, Score]:
    """Return all scores of one scenario."""
    scenario = scenario_of(truth, horizon=len(truth) - 2)
    metrics = select()
    pieces = tally(
        pairs_of(scenario, truth, prediction),
        metrics,
        scenario.config.predicted_frames,
    )
    return aggregate(metrics, {0: pieces})


def turning(x: Floats) -> Floats:
    """Return the velocity of rotation about the centre of the box at rate 1."""
    return np.stack([-(x[:, 1] - 0.5), x[:, 0] - 0.5], axis=1)


def test_energy_by_hand() -> None:
    """Two particles of mass 1/2, speeds^2 0.05 and 0.04: E = (0.05 + 0.04)/4 = 0.0225
    (Eq. 5.11).

    E is quadratic: twice as fast is ratio 4, retention 4 against a steady truth's 1,
    error 3.
    """
    x = [[0.4, 0.4], [0.6, 0.6]]
    u = [[0.1, 0.2], [0.0, -0.2]]
    pair = pair_of(x, u, np.zeros((2, 2)))
    assert measured(pair, "energy_true", "energy_predicted") == pytest.approx(
        [0.0225, 0.0]
    )
    truth = lattice(10) + 0.01 * np.arange(5)[:, None, None]
    prediction = truth.copy()
    prediction[2:] = truth[1] + 0.02 * np.arange(1, 4)[:, None, None]
    scores = scores_of(truth, prediction)
    names = (
        "energy_ratio",
        "energy_retention",
        "energy_retention_true",
        "energy_error",
    )
    assert [scores[name].mean for name in names] == pytest.approx([4.0, 4.0, 1.0, 3.0])


def test_energies_of_a_truth_that_slows_or_rests() -> None:
    """E_true = 1, 0: the second frame is scaled by 1e-3, so 1e-4 there is an error 0.1.

    Of 0.9 and 1 % of the peak, the peak, then nothing, the ratio takes the second and
    third frame. No ratio, retention or error exists where the truth never moves; its
    frames are counted.
    """
    predicted = np.array([0.5, 1e-4])
    errors = METRICS["energy_error"].series(predicted, np.array([1.0, 0.0]))
    assert_allclose(errors, [0.5, 0.1])

    predicted = np.array([5.0, 0.03, 9.0, 7.0])
    true = np.array([0.009, 0.01, 1.0, 0.0])
    ratios = METRICS["energy_ratio"].series(predicted, true)
    assert_allclose(ratios, [math.nan, 3.0, 9.0, math.nan])

    at_rest = np.repeat(lattice(10)[None], 5, axis=0)
    drift = 0.001 * np.arange(5)[:, None, None]
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
    truth = np.stack([x, x + u, x + 2 * u, x + 2 * u + 1e-6 * u])
    prediction = truth.copy()
    steps = np.arange(1, 3)[:, None, None]
    prediction[2:] = truth[1] + 1.1 * steps * u
    scores = scores_of(truth, prediction)

    momentum = np.hypot(*np.sum(u, axis=0))
    share = momentum / np.sum(np.hypot(u[:, 0], u[:, 1]))
    expected = [0.1 * share, (1.1 - 1e-6) / 1e-3 * share]
    errors = scores["momentum_error"].per_frame[0]
    assert_allclose(errors, expected, rtol=1e-6)
    assert scores["angular_momentum_error"].per_frame[0, 1] < 1.2e3


def test_momentum_by_hand() -> None:
    """Truth two particles at speeds 3 and 4 apart, prediction with (0.3, 0.4) more
    each: 2 * 0.5 / 7.

    Solid-body rotation off by 10 %: L_pred - L_true = 0.1 L, and the scale is L itself.
    Added uniform motion changes momentum, not angular momentum of a symmetric body.
    """
    u = np.array([[3.0, 0.0], [0.0, 4.0]])
    found = alone(
        "momentum_error",
        [[0.3, 0.5], [0.7, 0.5]],
        u,
        u + np.array([0.3, 0.4]),
    )
    assert found == pytest.approx(1.0 / 7.0)
    x = lattice(12)
    u = 0.1 * turning(x)
    faster = u + np.array([0.01, 0.02])
    errors = [alone("angular_momentum_error", x, u, v) for v in (1.1 * u, -u, faster)]
    assert errors == pytest.approx([0.1, 2.0, 0.0])
    assert alone("momentum_error", x, u, faster) > 0.1


def test_fields_of_an_expansion_and_of_missing_material() -> None:
    """The flow 0.01 r expands at 0.02 at nodes away from the walls; the swirl does not.

    Emptying the box takes density 1 from the inside nodes: RMSE is the RMS of the
    truth's density.
    """
    x = lattice(30)
    u = 0.01 * swirl(x)
    pair = pair_of(x, u, u + 0.01 * (x - 0.5))
    found = pair.predicted_fields.divergence[4:-4, 4:-4]
    assert found == pytest.approx(0.02, rel=1e-6)
    expanding, still = measured(pair, "divergence_rms", "divergence_rms_true")
    assert 0.01 < expanding < 0.03
    assert still < 0.1 * expanding
    x = lattice(20)
    pair = pair_of(x, 0 * x, 0 * x, predicted_position=x + 10.0)
    density = pair.truth.fields.density
    assert density[3:-3, 3:-3] == pytest.approx(1.0)
    assert METRICS["density_rmse"].measure(pair) == pytest.approx(
        math.sqrt(np.mean(density**2))
    )


def test_observables_of_the_truth_do_not_depend_on_the_prediction() -> None:
    """What is shown of the truth is the same beside any prediction."""
    truth = rollout()
    rng = np.random.default_rng(3)
    ours, theirs = (
        scores_of(truth, truth + s * rng.standard_normal(truth.shape))
        for s in (0.0, 0.01)
    )
    for name in ("energy_true", "energy_retention_true", "divergence_rms_true"):
        assert ours[name].mean == theirs[name].mean
