"""Vorticity errors and distributions against SciPy, closed forms and numbers worked by
hand.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.fft
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from metric_flows import lattice, measure, measured, pair_of, swirl
from numpy.testing import assert_allclose, assert_equal
from numpy.typing import NDArray

from lagbench.metrics import METRICS, FramePair
from lagbench.metrics.distributions import (
    energy_spectrum,
    histograms,
    kl,
    normalise,
    wasserstein1,
)
from lagbench.metrics.vorticity import frames_before_fall, pearson, slope

NUMBERS = st.floats(-1e3, 1e3).map(lambda value: round(value, 3))
VALUES = arrays(np.float64, 40, elements=NUMBERS)


def rotating_disc(scale: float, noise: float = 0.0) -> FramePair:
    """Return a pair in which the prediction turns ``scale`` times as fast, with
    noise.
    """
    x = lattice(30)
    u = 0.01 * swirl(x)
    rng = np.random.default_rng(1)
    noise_velocity = noise * rng.standard_normal(u.shape)
    return pair_of(x, u, scale * u + noise_velocity)


def rotation(position: NDArray[np.float64], rate: float) -> NDArray[np.float64]:
    """Return the velocity of a rotation about the middle of the box."""
    arm_x, arm_y = (position - 0.5).T
    return rate * np.stack([-arm_y, arm_x], axis=1)


def test_a_scaled_flow_has_closed_errors() -> None:
    """With omega_pred = 1.2 omega: RMSE = 0.2 rms(omega), r = 1, slope of the residual
    0.2.

    A prediction at rest has r = -omega: slope -1, no correlation. One that also turns
    by Omega has residual 2 Omega wherever no wall is near.
    """
    pair = rotating_disc(1.2)
    omega = pair.true_vorticity
    names = [
        "vorticity_mse",
        "vorticity_mae",
        "vorticity_pearson",
        "vorticity_residual_slope",
        "vorticity_residual_mean",
    ]
    actual = measured(pair, *names)
    expected = [
        0.04 * np.mean(omega**2),
        0.2 * np.mean(np.abs(omega)),
        1.0,
        0.2,
        0.2 * np.mean(omega),
    ]
    assert actual == pytest.approx(expected)
    at_rest = rotating_disc(0.0)
    by_one_vector = flying(1e-3, 0.0)
    for still in (at_rest, by_one_vector):
        actual = measured(still, "vorticity_residual_slope", "vorticity_pearson")
        assert actual == pytest.approx([-1.0, math.nan], nan_ok=True)
    x = lattice(30)
    u = 0.01 * swirl(x)
    pair = pair_of(x, u, u + rotation(x, 0.003))
    median = measure(pair, "vorticity_residual_p50")
    assert median == pytest.approx(0.006)


def test_taylor_green_vorticity_follows_its_closed_form() -> None:
    """Omega = 2 pi U sin(pi x) sin(pi y), damped as spline and central difference damp
    a wave.
    """
    pair = rotating_disc(1.0)
    omega = pair.truth.fields.vorticity[2:-2, 2:-2]
    place = (np.arange(10) + 0.5) / 10
    wave = np.sin(np.pi * place)[2:-2]
    # with k h = pi / 10: the quadratic spline keeps (sin(kh/2) / (kh/2))^3 along each
    # axis, which is 0.98772, the difference sin(kh) / (kh) = 0.98363; in all 0.9596
    damping = 0.98772**2 * 0.98363
    amplitude = damping * 0.02 * np.pi
    expected = amplitude * np.outer(wave, wave)
    assert_allclose(omega, expected, rtol=1e-3)


def test_correlation_slope_and_residuals_are_scipys_and_numpys() -> None:
    """Eq. 5.21 is scipy.stats.pearsonr, the slope that of linregress.

    Of 1 2 3 and 1 3 2: covariance 1, both sums of squares 2, so r = 1/2. Mean, std,
    greatest size and percentiles are those of r = predicted - true (Eq. 5.22).
    """
    pair = rotating_disc(0.7, noise=0.003)
    x = pair.true_vorticity
    y = pair.predicted_vorticity
    residual = y - x
    correlation = scipy.stats.pearsonr(x, y).statistic
    actual = measure(pair, "vorticity_pearson")
    assert actual == pytest.approx(correlation, rel=1e-12)
    fitted_slope = scipy.stats.linregress(x, residual).slope
    actual = measure(pair, "vorticity_residual_slope")
    assert actual == pytest.approx(fitted_slope, rel=1e-9)

    expected = {
        "mean": residual.mean(),
        "std": residual.std(),
        "max": np.abs(residual).max(),
    }
    for percent in (5, 25, 50, 75, 95):
        expected[f"p{percent:02}"] = np.percentile(residual, percent)
    names = [f"vorticity_residual_{name}" for name in expected]
    statistics = measured(pair, *names)
    assert_allclose(statistics, list(expected.values()), rtol=1e-12)


@pytest.mark.parametrize("constant", [0.0, 0.1, 1e9])
def test_a_constant_field_has_no_correlation(constant: float) -> None:
    """Pearson is NaN where either field is constant to rounding; SciPy says the same,
    with a warning.
    """
    x = np.linspace(-1.0, 1.0, 30)
    y = np.full(30, constant) * (1 + 1e-16)
    assert math.isnan(pearson(x, y))
    assert math.isnan(pearson(y, x))
    assert math.isnan(slope(y, x))
    with pytest.warns(scipy.stats.ConstantInputWarning):
        theirs = scipy.stats.pearsonr(x, y)
    assert math.isnan(theirs.statistic)


RELATIVE = [
    "vorticity_pearson",
    "vorticity_residual_slope",
    "vorticity_kl",
    "vorticity_kl_hist",
    "vorticity_kl_hist_abs",
]
FLIGHT = np.array([3.0, -5.0]) * 2.0**-10


def flying(turn: float, predicted_turn: float) -> FramePair:
    """Return particles at float32 positions that all fly by one vector, plus a swirl on
    either side.
    """
    rng = np.random.default_rng(3)
    jitter = rng.integers(-4096, 4096, (1024, 2)) * 2.0**-20
    x = lattice(32) + jitter
    velocities = []
    for scale in (turn, predicted_turn):
        before = x - FLIGHT - scale * swirl(x)
        velocities.append(x - before.astype(np.float32))
    return pair_of(x, *velocities)


def test_a_body_that_only_flies_has_no_pattern_of_vorticity() -> None:
    """What vorticity there is comes from the order of sums: its pattern says nothing,
    errors are 0.
    """
    pair = flying(0.0, 0.0)
    assert (pair.truth.velocity == FLIGHT).all()
    largest = np.abs(pair.true_vorticity).max()
    assert 0.0 < largest < 1e-14
    assert np.isnan(measured(pair, *RELATIVE)).all()
    mae = measure(pair, "vorticity_mae")
    assert mae == pytest.approx(0.0, abs=1e-14)
    distance = measure(pair, "vorticity_w1")
    assert distance == pytest.approx(0.0, abs=1e-14)
    beside_a_swirl = flying(0.0, 1e-3)
    assert np.isnan(measured(beside_a_swirl, *RELATIVE)).all()
    assert measure(beside_a_swirl, "vorticity_mae") > 1e-3


def test_the_least_swirl_that_positions_can_show_is_compared() -> None:
    """A swirl of some twenty roundings of float32; the prediction's is twice as fast.

    What counts is the speed at the compared nodes: a particle that is flung far away
    hides no swirl.
    """
    pair = flying(1e-6, 2e-6)
    r, tilt, *divergences = measured(pair, *RELATIVE)
    assert r == pytest.approx(1.0, abs=1e-3)
    assert tilt == pytest.approx(1.0, abs=0.03)
    assert np.isfinite(divergences).all()
    x = lattice(32)
    velocity = FLIGHT + 1e-3 * swirl(x)
    place = x.copy()
    speed = velocity.copy()
    place[0] = 1e12
    speed[0] = 1e12
    pair = pair_of(x, velocity, speed, predicted_position=place)
    assert measure(pair, "vorticity_pearson") > 0.9


def test_fewer_than_sixteen_nodes_are_undefined() -> None:
    """A blob of 4 x 4 cells with 2 x 2 differentiable nodes has no vorticity metrics,
    and no divergence.
    """
    x = 0.3 + 0.4 * lattice(20)
    u = 0.01 * swirl(x)
    pair = pair_of(x, u, u)
    blob = replace(pair.scenario, area=0.16)
    truth = blob.snapshot(x, x - u)
    prediction = blob.snapshot(x, x - 1.1 * u)
    small = FramePair(blob, 2, truth, prediction)
    assert small.node_count == 4
    names = []
    for name, metric in METRICS.items():
        if metric.statistic and name.startswith(("vorticity", "divergence")):
            names.append(name)
    assert len(names) > 10
    assert np.isnan(measured(small, *names)).all()
    assert not math.isnan(measure(small, "density_rmse"))


def test_divergences_are_scipys_entropy() -> None:
    """Eqs. 5.23-5.25, per node and of NumPy's histogram: SciPy normalises its arguments
    itself.

    P = (1/4, 3/4), Q = (1/2, 1/2): ln(1/2)/4 + 3 ln(3/2)/4 = 0.130812. There are 64
    bins over the truth's range, the outer ones open, half a count added to each.
    """
    pair = rotating_disc(1.3, noise=0.002)
    p = np.abs(pair.true_vorticity) + 1e-10
    q = np.abs(pair.predicted_vorticity) + 1e-10
    divergence = measure(pair, "vorticity_kl")
    expected = scipy.stats.entropy(p, q)
    assert divergence == pytest.approx(expected, rel=1e-9)
    p = normalise(np.array([-1.0, 3.0]))
    q = normalise(np.array([2.0, -2.0]))
    assert kl(p, q) == pytest.approx(0.130812, abs=1e-6)
    for name, of in (
        ("vorticity_kl_hist", np.asarray),
        ("vorticity_kl_hist_abs", np.abs),
    ):
        x = of(pair.true_vorticity)
        y = of(pair.predicted_vorticity)
        edges = np.linspace(x.min(), x.max(), 65)
        edges[0] = -np.inf
        edges[-1] = np.inf
        true_counts, _ = np.histogram(x, edges)
        predicted_counts, _ = np.histogram(y, edges)
        expected = scipy.stats.entropy(true_counts + 0.5, predicted_counts + 0.5)
        divergence = measure(pair, name)
        assert divergence == pytest.approx(expected, rel=1e-9)


def test_values_on_an_edge_belong_to_the_bin_above() -> None:
    """Truth 0..64 has edges at whole numbers: one value per bin, two in the last; 3
    falls into bin 3.

    Where the truth has no range there are no bins.
    """
    truth = np.arange(65.0)
    prediction = np.full(65, 3.0)
    p, q = histograms(truth, prediction)  # type: ignore[misc]
    assert_allclose(p * 97, [1.5] * 63 + [2.5])
    assert_allclose(q * 97, [0.5] * 3 + [65.5] + [0.5] * 60)
    constant = np.ones(20)
    assert histograms(constant, np.arange(20.0)) is None
    x = lattice(30)
    at_rest = pair_of(x, 0 * x, 0.01 * swirl(x))
    divergence = measure(at_rest, "vorticity_kl_hist")
    assert math.isnan(divergence)


@given(VALUES, VALUES)
def test_wasserstein_is_scipys(x: np.ndarray, y: np.ndarray) -> None:
    """The mean distance of order statistics is scipy.stats.wasserstein_distance."""
    expected = scipy.stats.wasserstein_distance(x, y)
    assert wasserstein1(x, y) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("correlations", "frames"),
    [
        ([0.99, 0.96, 0.94, 0.99], 2.0),
        ([0.99, math.nan, 0.5], 1.0),
        ([0.95, 0.95], 2.0),
        ([0.1], 0.0),
        ([0.99, math.nan], 1.0),
        ([math.nan] * 4, math.nan),  # neither stable nor unstable
    ],
)
def test_stable_frames_by_hand(correlations: list[float], frames: float) -> None:
    """Frames before the first value under 0.95; undefined ones do not count, the
    threshold itself holds.
    """
    actual = frames_before_fall(np.array(correlations))
    assert_equal(actual, frames)


def test_nrmse_is_the_ratio_of_sums_over_frames() -> None:
    """MSE 1, 9 over mean squares 4, 16: sqrt(10 / 20); the frame in which the truth
    rests counts too.

    A flow turning ``s`` times as fast is off by |s - 1| of its own strength, whatever
    that is.
    """
    metric = METRICS["vorticity_nrmse"]

    def nrmse(mse: list[float], square: list[float]) -> float:
        series = metric.series(np.array(mse), np.array(square))
        return metric.over_frames(series)

    for square in ([4.0, 16.0], [20.0, 0.0]):
        assert nrmse([1.0, 9.0], square) == pytest.approx(math.sqrt(0.5))
    for scale in (0.0, 1.0, 1.5, -1.0):
        pair = rotating_disc(scale)
        mse = measure(pair, "vorticity_mse")
        square = measure(pair, "vorticity_square_true")
        expected = abs(scale - 1.0)
        assert nrmse([mse], [square]) == pytest.approx(expected, abs=1e-12)


def test_the_spectrum_is_scipys_cosine_transform() -> None:
    """Shell sums of squared DCT-II coefficients (orthonormal) of both components."""
    velocity = np.random.default_rng(2).standard_normal((9, 12, 2))
    modes = scipy.fft.dctn(velocity, axes=(0, 1), norm="ortho")
    power = np.sum(modes**2, axis=-1)
    wave_x, wave_y = np.indices((9, 12))
    shell = np.rint(np.hypot(wave_x, wave_y))
    expected = []
    for number in range(1, 9):
        expected.append(power[shell == number].sum())
    energy = energy_spectrum(velocity)
    assert_allclose(energy, expected, rtol=1e-12)


def test_the_spectrum_forgives_place_and_punishes_smoothing() -> None:
    """A mirrored flow has the same energy at every scale; one that lost its small
    eddies has not.

    Ten times the speed is a hundred times the energy in every shell, two decades; rest
    counts six.
    """
    for scale, decades in (
        (1.0, 0.0),
        (10.0, 2.0),
        (0.1, 2.0),
        (0.0, 6.0),
    ):
        pair = replace(rotating_disc(scale), frame=3)
        error = measure(pair, "spectrum_error")
        assert error == pytest.approx(decades, abs=1e-9)

    rng = np.random.default_rng(4)
    x = lattice(40)
    smooth = 0.01 * swirl(x)
    u = smooth + 0.003 * rng.standard_normal(x.shape)
    rows = u.reshape(40, 40, 2)
    mirrored = rows[::-1].reshape(-1, 2) * [-1.0, 1.0]

    def spectrum_error(predicted_velocity: NDArray[np.float64]) -> float:
        pair = pair_of(x, u, predicted_velocity, frames_of_interest=(2,))
        return measure(replace(pair, frame=2), "spectrum_error")

    assert spectrum_error(mirrored) < 1e-9
    assert spectrum_error(smooth) > 0.5
