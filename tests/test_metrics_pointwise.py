"""Pointwise errors against NumPy, SciPy and numbers worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from metric_flows import SETTING, lattice, pair_of, pairs_of, rollout, scenario_of
from numpy.testing import assert_allclose

from lagbench.errors import ChecksFailedError, UsageError
from lagbench.metrics import METRICS, Metric, aggregate, tally
from lagbench.metrics.pointwise import HORIZONS, attribute_mse

POSITION_MSE = METRICS["position_mse"]


def value(name: str, *args: object, **kwargs: object) -> float:
    """Measure a metric on the pair that the arguments describe."""
    return METRICS[name].measure(pair_of(*args, **kwargs))  # type: ignore[arg-type]


def test_errors_of_two_particles_by_hand() -> None:
    """Errors (0.1, 0) and (0, -0.3): MSE = (0.01 + 0.09)/4 = 0.025, MAE = 0.4/4 = 0.1."""
    x = [[0.4, 0.4], [0.6, 0.6]]
    y = [[0.5, 0.4], [0.6, 0.3]]
    still = np.zeros((2, 2))
    assert value("position_mse", x, still, still, predicted_position=y) == pytest.approx(0.025)
    assert value("position_mae", x, still, still, predicted_position=y) == pytest.approx(0.1)


def test_velocity_is_a_frame_difference() -> None:
    """Velocity errors come from positions of two frames: u = x(f) - x(f-1)."""
    truth = rollout()
    prediction = truth + 0.01 * np.arange(8)[:, None, None]
    pairs = pairs_of(scenario_of(truth), truth, prediction)
    # the first predicted frame moves by 0.02 against the last given frame of the truth
    assert METRICS["velocity_mse"].measure(pairs[0]) == pytest.approx(0.02**2)
    assert METRICS["velocity_mse"].measure(pairs[1]) == pytest.approx(0.01**2)
    assert METRICS["velocity_mae"].measure(pairs[5]) == pytest.approx(0.01)


def test_attribute_error_equals_that_of_standardised_arrays() -> None:
    """Eq. 4.16 over z-scores of all four attributes, with the means of Eq. 4.15 put in."""
    rng = np.random.default_rng(0)
    x, y = rng.random((2, 50, 2))
    u, v = 0.01 * rng.standard_normal((2, 50, 2))
    mean, std = np.array([0.5, 0.4, 0.001, -0.002]), np.array(SETTING.attribute_std)
    z = (np.hstack([x, u]) - mean) / std
    z_predicted = (np.hstack([y, v]) - mean) / std
    assert attribute_mse.measure(pair_of(x, u, v, predicted_position=y)) == pytest.approx(
        np.mean((z - z_predicted) ** 2)
    )


def test_materials_have_errors_of_their_own() -> None:
    """Jelly off by 0.2 and liquid exact: the jelly's MSE is 0.04, the liquid's 0, the whole's 0.02."""
    x = lattice(4)
    material = [0, 1] * 8
    y = x + 0.2 * np.array(material)[:, None] * (1, 1)
    pair = pair_of(
        x,
        0 * x,
        0 * x,
        predicted_position=y,
        material=material,
        materials=("liquid", "jelly", "snow", "rope"),
    )
    assert METRICS["position_mse_jelly"].measure(pair) == pytest.approx(0.04)
    assert METRICS["position_mse_liquid"].measure(pair) == 0.0
    assert METRICS["position_mse"].measure(pair) == pytest.approx(0.02)
    assert not METRICS["position_mse_snow"].applies(pair)


def test_a_split_of_one_material_has_no_columns_per_material() -> None:
    """In the cavity the liquid's error is the error; it is not listed twice."""
    x = lattice(4)
    assert not METRICS["position_mse_liquid"].applies(pair_of(x, 0 * x, 0 * x))


def growing() -> tuple[float, ...]:
    """Return the attribute MSE of a prediction whose x is off by 0.3 k at predicted frame k."""
    # z-score of x: k; of u: 0.3 / 0.01 = 30; L = (k^2 + 30^2) / 4 for k = 1..6
    return tuple((k**2 + 900) / 4 for k in range(1, 7))


def test_average_and_end_over_horizons() -> None:
    """Eqs. 4.17 and 4.18 over the rollout and its first frames; longer horizons do not exist."""
    truth = rollout()
    offset = np.zeros((8, 1, 2))
    offset[2:, 0, 0] = 0.3 * np.arange(1, 7)
    scenario = scenario_of(truth)
    metrics = [METRICS[name] for name in METRICS if name.startswith(("mse_", "attribute"))]
    pieces = tally(pairs_of(scenario, truth, truth + offset), metrics, scenario.setting.predicted_frames)
    scores = aggregate(metrics, {7: pieces})
    expected = growing()
    assert scores["mse_avg"].mean == pytest.approx(np.mean(expected))
    assert scores["mse_end"].mean == pytest.approx(expected[-1])
    assert scores["mse_avg_5"].mean == pytest.approx(np.mean(expected[:5]))
    assert scores["mse_end_5"].mean == pytest.approx(expected[4])
    assert scores["mse_avg_1"].mean == scores["mse_end_1"].mean == pytest.approx(expected[0])
    assert {h for h in HORIZONS if f"mse_avg_{h}" in scores} == {1, 5}


def test_rmse_is_the_root_of_the_frame_mean() -> None:
    """Errors 3 and 4 in two frames: sqrt((9 + 16)/2) = 3.5355, not the mean 3.5; then over scenarios."""
    truth = np.full((4, 3, 2), 0.5)
    one, two = truth.copy(), truth.copy()
    one[2], one[3] = 3.5, 4.5
    two[2:] = 1.5
    scenario = scenario_of(truth, horizon=2)
    metrics: list[Metric] = [POSITION_MSE, METRICS["position_rmse"]]
    frames = scenario.setting.predicted_frames
    tallies = {i: tally(pairs_of(scenario, truth, p), metrics, frames) for i, p in enumerate((one, two))}
    score = aggregate(metrics, tallies)["position_rmse"]
    assert_allclose(score.values, [np.sqrt(12.5), 1.0])
    assert score.mean == pytest.approx((np.sqrt(12.5) + 1.0) / 2)
    assert_allclose(score.at(3), [4.0, 1.0])


def test_positions_that_are_no_numbers_are_refused() -> None:
    """A NaN position fails loudly instead of leaking into means; the message counts particles."""
    x = lattice(4)
    y = x.copy()
    y[3, 1] = np.nan
    with pytest.raises(ChecksFailedError, match="1 of 16 particles"):
        pair_of(x, 0 * x, 0 * x, predicted_position=y)


def test_shapes_that_do_not_fit_are_refused() -> None:
    """Another number of particles, or a single given frame, is a usage error."""
    x = lattice(4)
    with pytest.raises(UsageError, match="wrong shape"):
        pair_of(x, 0 * x, 0 * x[:9], predicted_position=x[:9])
    with pytest.raises(UsageError, match="given frames"):
        scenario_of(x[None], material=np.zeros(16))
