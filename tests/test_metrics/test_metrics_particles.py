"""Errors of particles, bodies and clouds against NumPy, SciPy, searches and numbers
worked by hand.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from metric_flows import (
    CONFIG,
    Floats,
    lattice,
    measure,
    measured,
    pair_of,
    pairs_of,
    rollout,
    scenario_of,
)
from numpy.testing import assert_allclose

from lagbench.data.grid import Grid, Placement
from lagbench.errors import ChecksFailedError, NotInstalledError, UsageError
from lagbench.metrics import METRICS, aggregate, select, tally
from lagbench.metrics import measure as measure_all
from lagbench.metrics.bodies import rigid_residual
from lagbench.metrics.frame import Bonds
from lagbench.metrics.pointwise import HORIZONS, attribute_mse
from lagbench.metrics.transport import sinkhorn_divergence


def test_errors_of_two_particles_by_hand() -> None:
    """Errors (0.1, 0) and (0, -0.3): MSE = (0.01 + 0.09)/4 = 0.025, MAE = 0.4/4 =
    0.1.
    """
    position = [[0.4, 0.4], [0.6, 0.6]]
    predicted_position = [[0.5, 0.4], [0.6, 0.3]]
    still = np.zeros((2, 2))
    pair = pair_of(
        position,
        still,
        still,
        predicted_position=predicted_position,
    )
    errors = measured(pair, "position_mse", "position_mae")
    assert errors == pytest.approx([0.025, 0.1])


def test_attribute_error_equals_that_of_standardised_arrays() -> None:
    """Eq. 4.16 over z-scores of all four attributes, with the means of Eq. 4.15."""
    rng = np.random.default_rng(0)
    x, y = rng.random((2, 50, 2))
    normal_velocities = rng.standard_normal((2, 50, 2))
    u, v = 0.01 * normal_velocities
    mean = np.array([0.5, 0.4, 0.001, -0.002])
    std = np.array(CONFIG.attribute_std)
    attributes = np.hstack([x, u])
    predicted_attributes = np.hstack([y, v])
    z = (attributes - mean) / std
    z_predicted = (predicted_attributes - mean) / std
    pair = pair_of(x, u, v, predicted_position=y)
    expected = np.mean((z - z_predicted) ** 2)
    assert attribute_mse.measure(pair) == pytest.approx(expected)


def test_attributes_that_never_vary_have_no_standardised_error() -> None:
    """Particles that fall straight down have no horizontal velocity in all of train."""
    x = lattice(4)
    fall = np.tile([0.0, -0.01], (len(x), 1))
    std = np.array([*CONFIG.attribute_std[:2], 0.0, 0.1])
    pair = pair_of(x, fall, fall, predicted_position=x)
    scenario = replace(
        pair.scenario, config=replace(pair.scenario.config, attribute_std=tuple(std))
    )
    assert np.isnan(attribute_mse.measure(replace(pair, scenario=scenario)))


def test_materials_have_errors_of_their_own() -> None:
    """Jelly off by 0.2 and liquid exact: MSE of jelly 0.04, of liquid 0, of all 0.02.

    Snow is not there, and where there is one material only its error is not listed
    twice.
    """
    x = lattice(4)
    at_rest = np.zeros_like(x)
    material = [0, 1] * 8
    offset = 0.2 * np.array(material)
    pair = pair_of(
        x,
        at_rest,
        at_rest,
        predicted_position=x + offset[:, None],
        material=material,
        materials=ALL,
    )
    of_jelly = measure(pair, "position_mse_jelly")
    assert of_jelly == pytest.approx(0.04)
    of_liquid = measure(pair, "position_mse_liquid")
    assert of_liquid == pytest.approx(0.0)
    of_all = measure(pair, "position_mse")
    assert of_all == pytest.approx(0.02)
    assert not METRICS["position_mse_snow"].applies(pair)
    of_one_material = pair_of(x, at_rest, at_rest)
    assert not METRICS["position_mse_liquid"].applies(of_one_material)


def test_average_and_end_over_horizons() -> None:
    """Eqs. 4.17 and 4.18 over the rollout and its first frames; longer horizons do not
    exist.
    """
    truth = rollout()
    offset = np.zeros((8, 1, 2))
    offset[2:, 0, 0] = 0.3 * np.arange(1, 7)
    scenario = scenario_of(truth)
    metrics = []
    for name, metric in METRICS.items():
        if name.startswith(("mse_", "attribute")):
            metrics.append(metric)
    pieces = tally(
        pairs_of(scenario, truth, truth + offset),
        metrics,
        scenario.config.predicted_frames,
    )
    scores = aggregate(metrics, {7: pieces})
    # z-score of x: k; of u: 0.3 / 0.01 = 30; L = (k^2 + 30^2) / 4 for k = 1..6
    expected = [(k**2 + 900) / 4 for k in range(1, 7)]
    for ending, frames in (
        ("", 6),
        ("_5", 5),
        ("_1", 1),
    ):
        average = scores[f"mse_avg{ending}"].mean
        assert average == pytest.approx(np.mean(expected[:frames]))
        end = scores[f"mse_end{ending}"].mean
        assert end == pytest.approx(expected[frames - 1])
    horizons = [h for h in HORIZONS if f"mse_avg_{h}" in scores]
    assert sorted(horizons) == [1, 5]


def test_rmse_is_the_root_of_the_frame_mean() -> None:
    """Errors 3 and 4 in two frames: sqrt((9 + 16)/2) = 3.5355, not the mean 3.5; then
    over scenarios.
    """
    truth = np.full((4, 3, 2), 0.5)
    one = truth.copy()
    two = truth.copy()
    one[2] = 3.5
    one[3] = 4.5
    two[2:] = 1.5
    scenario = scenario_of(truth, horizon=2)
    metrics = [METRICS["position_mse"], METRICS["position_rmse"]]
    frames = scenario.config.predicted_frames
    tallies = {
        0: tally(pairs_of(scenario, truth, one), metrics, frames),
        1: tally(pairs_of(scenario, truth, two), metrics, frames),
    }
    scores = aggregate(metrics, tallies)
    score = scores["position_rmse"]
    roots = [math.sqrt(12.5), 1.0]
    assert_allclose(score.values, roots)
    assert score.mean == pytest.approx(sum(roots) / 2)
    assert_allclose(score.at(3), [4.0, 1.0])


def test_what_cannot_be_measured_is_refused() -> None:
    """A NaN position, another number of particles, a single given frame."""
    x = lattice(4)
    at_rest = np.zeros_like(x)
    y = x.copy()
    y[3, 1] = np.nan
    with pytest.raises(ChecksFailedError):
        pair_of(x, at_rest, at_rest, predicted_position=y)
    with pytest.raises(ChecksFailedError):
        scenario_of(np.stack([x, x])).snapshot(x, y)
    with pytest.raises(UsageError):
        pair_of(x, at_rest, at_rest[:9], predicted_position=x[:9])
    with pytest.raises(UsageError):
        scenario_of(x[None])


ALL = ("liquid", "jelly", "snow", "rope")


def turned(points: Floats, angle: float) -> Floats:
    """Rotate points about the origin."""
    cos = math.cos(angle)
    sin = math.sin(angle)
    rotation = np.array([[cos, sin], [-sin, cos]])
    return np.asarray(points @ rotation)


def test_rigid_residuals_by_hand() -> None:
    """Corners (+-1, +-1) stretched to (+-3, +-1) are off by 2 each, in any rotation.

    Reflection is not a rigid motion; a point body fits anything of its size.
    """
    corners = [
        (1.0, 1.0),
        (-1.0, 1.0),
        (-1.0, -1.0),
        (1.0, -1.0),
    ]
    square = np.array(corners)
    stretched = turned(square * [3.0, 1.0], 0.7)
    assert rigid_residual(square, stretched) == pytest.approx(2.0)

    body = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    mirrored = body * [-1.0, 1.0]
    assert rigid_residual(body, mirrored) > 0.3
    point = np.zeros((3, 2))
    assert rigid_residual(point, point + 1.0) == 0.0


def test_bodies_of_a_scenario_are_judged_apart() -> None:
    """Jelly rotated as a whole and rope stretched: only the rope has an error.

    The mean is half of it.
    """
    height = np.full(16, 0.7)
    jelly = 0.1 * lattice(4) + 0.2
    along_rope = np.linspace(0.5, 0.9, 16)
    along_longer_rope = np.linspace(0.4, 1.0, 16)
    rope = np.stack([along_rope, height], axis=1)
    longer = np.stack([along_longer_rope, height], axis=1)
    truth = np.vstack([jelly, rope])
    prediction = np.vstack([turned(jelly, 0.3), longer])
    at_rest = np.zeros_like(truth)
    pair = pair_of(
        truth,
        at_rest,
        at_rest,
        predicted_position=prediction,
        material=[1] * 16 + [3] * 16,
        materials=ALL,
    )
    # stretched about its middle by 1/2 of its own half length 0.2, uniform: 0.1 * rms
    # of linspace(-1, 1, 16)
    place = np.linspace(-1, 1, 16)
    expected = 0.1 * math.sqrt(np.mean(place**2))
    of_jelly = measure(pair, "shape_error_jelly")
    assert of_jelly == pytest.approx(0.0)
    of_rope = measure(pair, "shape_error_rope")
    assert of_rope == pytest.approx(expected)
    of_all = measure(pair, "shape_error")
    assert of_all == pytest.approx(expected / 2)


def test_bonds_of_a_chain() -> None:
    """Five links of a chain, one torn to 2.5 times its length: 4 of 5 are intact.

    At 2 times all are. Lone particles have no bonds.
    """
    spacing = 0.05
    along_chain = spacing * np.arange(6)
    chain = np.stack([along_chain, np.full(6, 0.5)], axis=1)
    torn = chain.copy()
    torn[3:, 0] += 1.5 * spacing
    stretched = chain.copy()
    stretched[3:, 0] += 0.99 * spacing

    bonds = Bonds.within(0.075, chain)
    assert len(bonds.pairs) == 5
    assert bonds.intact_share(chain) == 1.0
    assert bonds.intact_share(stretched) == 1.0
    assert bonds.intact_share(torn) == pytest.approx(0.8)
    lone = Bonds.within(0.01, chain)
    assert math.isnan(lone.intact_share(chain))


def test_connectivity_speaks_of_prediction_and_truth() -> None:
    """A prediction that scatters the jelly is torn, its truth is not.

    Liquid and snow flow and break: they have no shape to keep.
    """
    x = 0.2 * lattice(6)
    at_rest = np.zeros_like(x)
    pair = pair_of(
        x,
        at_rest,
        at_rest,
        predicted_position=4 * x,
        material=[1] * 36,
        materials=ALL,
    )
    assert measure(pair, "connectivity") == 0.0
    assert measure(pair, "connectivity_true") == 1.0
    fluid = pair_of(
        x,
        at_rest,
        at_rest,
        material=[0] * 18 + [2] * 18,
        materials=ALL,
    )
    for name, metric in METRICS.items():
        if name.startswith(("shape", "connect")):
            assert not metric.applies(fluid)


def cloud(seed: int, particles: int = 40) -> Floats:
    """Draw particles in the unit box."""
    rng = np.random.default_rng(seed)
    return rng.random((particles, 2))


def test_measured_at_frames_of_interest_and_the_last_only() -> None:
    """Expected gaps elsewhere: frames 3 and 5 and the last, 7, are measured; of a full
    box only that.
    """
    truth = rollout()
    metric = METRICS["sliced_w2"]
    for placement, frames in (
        (Placement.NODES, [3, 5, 7]),
        (Placement.CELL_CENTRES, [7]),
    ):
        scenario = scenario_of(truth, grid=Grid(10, placement))
        measured_frames = []
        for pair in pairs_of(scenario, truth, truth):
            if measure_all(pair, [metric]):
                measured_frames.append(pair.frame)
        assert measured_frames == frames


def cloud_score(
    shift: Floats, *, active: int | None, frames: int = 33
) -> tuple[list[int], float]:
    """Return the frames at which ``cloud_distance`` is measured, and its mean, for
    shifted materials.
    """
    truth = rollout(frames=frames)
    material = np.repeat([0, 2], [100, 300])
    guess = truth + shift[material // 2]
    task = {
        "horizon": frames - 2,
        "materials": ("liquid", "snow"),
        "grid": Grid(10, Placement.NODES),
    }
    whole_scenario = scenario_of(truth, material=material, **task)
    scenario = replace(whole_scenario, active_frames=active)
    metrics = [METRICS["cloud_distance"], METRICS["active_frames"]]
    pairs = pairs_of(scenario, truth, guess)
    pieces = tally(pairs, metrics, scenario.config.predicted_frames)
    scores = aggregate(metrics, {0: pieces})
    measured_frames = []
    for pair in pairs:
        if "cloud_distance" in measure_all(pair, metrics):
            measured_frames.append(pair.frame)
    if active is None:
        active = frames - 2
    assert scores["active_frames"].mean == active
    return measured_frames, scores["cloud_distance"].mean


@pytest.mark.parametrize(
    ("active", "frames"),
    [
        (None, [11, 21, 31]),
        (30, [11, 21, 31]),
        (29, [11, 21]),
        (9, [10]),
        (1, [2]),
    ],
)
def test_cloud_distance_stops_where_the_truth_rests(
    active: int | None, frames: list[int]
) -> None:
    """Predicted frames 10, 20, ... (numbers 11, 21, ...) up to the last active one,
    else that one.
    """
    no_shift = np.zeros((2, 2))
    measured_frames, _ = cloud_score(no_shift, active=active)
    assert measured_frames == frames


def test_cloud_distance_asks_for_materials_not_for_particles() -> None:
    """Particles that swap places cost nothing, materials that swap places do, by their
    share.

    A quarter shifted by 0.4, the rest by 0.2: (0.25 * 0.4 + 0.75 * 0.2) / sqrt(2).
    """
    shifts = np.array([[0.4, 0.0], [0.0, 0.2]])
    _, distance_of_shift = cloud_score(shifts, active=None)
    mean_shift = 0.25 * 0.4 + 0.75 * 0.2
    expected = mean_shift / math.sqrt(2)
    assert distance_of_shift == pytest.approx(expected, rel=1e-5)
    truth = rollout(frames=12)
    material = np.arange(400) % 2
    task = {
        "horizon": 10,
        "materials": ("liquid", "jelly"),
        "grid": Grid(10, Placement.NODES),
    }
    scenario = scenario_of(truth, material=material, **task)

    def distance(order: Floats) -> float:
        prediction = truth[:, order]
        pairs = pairs_of(scenario, truth, prediction)
        return measure(pairs[9], "cloud_distance")

    rng = np.random.default_rng(0)
    order_of_liquid = rng.permutation(np.arange(0, 400, 2))
    order_of_jelly = rng.permutation(np.arange(1, 400, 2))
    within = np.stack([order_of_liquid, order_of_jelly], axis=1).ravel()
    assert distance(within) == 0.0
    across = np.arange(400) ^ 1
    assert distance(across) > 0.01


def motion_of(truth: Floats, guess: Floats, name: str = "motion_distance") -> float:
    """Return a distance of clouds at frame 11 of a flow."""
    task = {"horizon": 10, "grid": Grid(10, Placement.NODES)}
    scenario = replace(
        scenario_of(truth, **task),
        config=replace(scenario_of(truth, **task).config, attribute_std=ATTRIBUTE_STD),
    )
    return measure(pairs_of(scenario, truth, guess)[9], name)


ATTRIBUTE_STD = (0.3, 0.2, 0.03, 0.02)  # a velocity counts 1.5 * 10 frames


def test_motion_distance_sees_errors_of_clouds_and_of_velocities() -> None:
    """A shift; a velocity of which the clouds know nothing; particles that are mixed up
    since the frame before.
    """
    truth = rollout(frames=12)
    shifted = truth + np.array([0.1, 0.0])
    assert motion_of(truth, shifted) == pytest.approx(0.1 / math.sqrt(2), rel=1e-4)

    faster = truth.copy()
    faster[10] += [0.01, 0.0]
    assert motion_of(truth, faster) == pytest.approx(0.15 / math.sqrt(2), rel=1e-4)

    mixed = truth.copy()
    mixed[11] = mixed[11][np.random.default_rng(0).permutation(truth.shape[1])]
    assert motion_of(truth, mixed) > 1.0
    for guess in (faster, mixed):
        assert motion_of(truth, guess, "cloud_distance") < 1e-6


@pytest.mark.slow
def test_sinkhorn_of_a_shift(monkeypatch: pytest.MonkeyPatch) -> None:
    """Entropic transport debiased by its own terms leaves |s|^2 for a shift by s, 0 for
    none. It is measured on request only, and without its package the error has the
    command that installs it.
    """
    by_default = {metric.name for metric in select()}
    assert "sinkhorn_pot" not in by_default
    with_transport = {metric.name for metric in select(extras=("transport",))}
    assert "sinkhorn_pot" in with_transport
    x = cloud(0)
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "ot", None)
        with pytest.raises(NotInstalledError):
            sinkhorn_divergence(x, x)
    pytest.importorskip("ot")
    assert sinkhorn_divergence(x, x) == 0.0
    near = sinkhorn_divergence(x, x + 0.1)
    assert near == pytest.approx(0.02, rel=1e-3)
    far = sinkhorn_divergence(x, x + 0.2)
    assert far == pytest.approx(0.08, rel=1e-3)
    outside = sinkhorn_divergence(x, x + np.array([9.0, 0.0]))
    assert outside == pytest.approx(81.0, rel=1e-2)
