"""Metrics in two and three dimensions, between walls and in periodic boxes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from lagbench.data.box import Box
from lagbench.data.grid import Grid, Placement
from lagbench.metrics import METRICS, FramePair, Scenario, TaskConfig
from lagbench.metrics.bodies import fit_rotation, rigid_residual, rotate_in_plane
from lagbench.metrics.conservation import angular_momentum
from lagbench.metrics.distributions import energy_spectrum
from lagbench.metrics.frame import Bonds, directions
from lagbench.metrics.transport import sliced_wasserstein2

Floats = NDArray[np.float64]

WALLED = Box.from_bounds([(0.0, 1.0)] * 2)
CHANNEL = Box.from_bounds([(0.0, 1.0)] * 2, periodic=[True, False])
TORUS = Box.from_bounds([(0.0, 1.0)] * 2, periodic=[True, True])
SOLID = Box.from_bounds([(0.0, 1.0)] * 3)
SOLID_CHANNEL = Box.from_bounds([(0.0, 1.0)] * 3, periodic=[True, False, True])
SOLID_TORUS = Box.from_bounds([(0.0, 1.0)] * 3, periodic=[True] * 3)
BOXES = (WALLED, CHANNEL, TORUS, SOLID, SOLID_CHANNEL, SOLID_TORUS)
EVERY_BOX = pytest.mark.parametrize("box", BOXES)


def lattice(dimension: int, side: int) -> Floats:
    """Return particles that fill the unit box, shape [particle, axis]."""
    axis = (np.arange(side) + 0.5) / side
    points = np.meshgrid(*[axis] * dimension, indexing="ij")
    return np.stack(points, axis=-1).reshape(-1, dimension)


def scenario_in(box: Box, position: Floats, *, material: int = 0) -> Scenario:
    """Return a scenario of particles at rest in a box."""
    config = TaskConfig(
        grid=Grid(8, Placement.CELL_CENTRES, box),
        input_frames=2,
        horizon=6,
        frames_of_interest=(2,),
        attribute_std=(0.3,) * box.dimension + (0.01,) * box.dimension,
        radius=0.2,
    )
    return Scenario(
        config=config,
        input_positions=np.stack([position, position]),
        material=np.full(len(position), material, np.int8),
        particle_mass=1.0 / len(position),
        area=1.0,
    )


def pair_in(
    box: Box,
    position: Floats,
    *,
    velocity: ArrayLike = 0.0,
    shift: ArrayLike = 0.0,
) -> FramePair:
    """Return a pair whose prediction is the truth moved by a shift."""
    scenario = scenario_in(box, position)
    before = position - np.asarray(velocity)
    truth = scenario.snapshot(position, before)
    prediction = scenario.snapshot(position + shift, before + shift)
    return FramePair(scenario, 2, truth, prediction)


@EVERY_BOX
def test_all_errors_vanish_where_the_prediction_is_the_truth(box: Box) -> None:
    rng = np.random.default_rng(0)
    position = lattice(box.dimension, 16 if box.dimension == 2 else 10)
    velocity = 0.01 * rng.standard_normal(position.shape)
    pair = pair_in(box, position, velocity=velocity)
    names = ("position_rmse", "sliced_w2", "spectrum_error", "vorticity_mse")
    names += ("momentum_gap", "angular_momentum_gap", "density_rmse", "vorticity_w1")
    for name in names:
        metric = METRICS[name]
        if metric.statistic is not None:
            assert metric.measure(pair) == pytest.approx(0.0, abs=1e-12), name
    assert METRICS["vorticity_pearson"].measure(pair) == pytest.approx(1.0)
    assert METRICS["outside_share"].measure(pair) == 0.0


@EVERY_BOX
def test_a_particle_just_across_a_periodic_end_is_near(box: Box) -> None:
    rng = np.random.default_rng(1)
    true = rng.random((50, box.dimension))
    predicted = rng.random((50, box.dimension))
    scenario = scenario_in(box, true)
    pair = FramePair(
        scenario,
        2,
        scenario.snapshot(true, true),
        scenario.snapshot(predicted, predicted),
    )
    way = np.abs(predicted - true)
    periodic = np.asarray(box.periodic)
    way[:, periodic] = np.minimum(way, 1.0 - way)[:, periodic]
    mse = METRICS["position_mse"].measure(pair)
    assert mse == pytest.approx(np.mean(way**2), rel=1e-12)


def test_a_whole_period_is_no_error_and_a_crossing_no_jump() -> None:
    position = lattice(3, 6)
    pair = pair_in(SOLID_TORUS, position, velocity=[0.3, 0.0, 0.0], shift=[1.0, 0, -2])
    assert METRICS["position_mse"].measure(pair) == pytest.approx(0.0, abs=1e-24)
    scenario = pair.scenario
    wrapped = SOLID_TORUS.wrap(position - [0.3, 0.0, 0.0])
    snapshot = scenario.snapshot(position, wrapped)
    assert_allclose(snapshot.velocity[:, 0], 0.3, atol=1e-12)


def test_only_walls_have_an_outside() -> None:
    position = np.full((4, 2), 0.5)
    scenario = scenario_in(CHANNEL, position)
    moved = position.copy()
    moved[0] = [1.3, 0.5]
    moved[1] = [0.5, 1.3]
    truth = scenario.snapshot(position, position)
    prediction = scenario.snapshot(moved, moved)
    pair = FramePair(scenario, 2, truth, prediction)
    assert pair.outside_share == 0.25


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("is_periodic", [False, True])
def test_the_spectrum_of_a_mode_lies_in_its_shell(
    dimension: int, is_periodic: bool
) -> None:
    count = 12
    number = 3
    places = (np.arange(count) + 0.5) / count
    wave = np.cos(np.pi * number * places * (2.0 if is_periodic else 1.0))
    velocity = np.zeros((count,) * dimension + (dimension,))
    for axis in range(dimension):
        field = np.zeros_like(velocity)
        np.moveaxis(field, axis, -2)[..., 0] = wave
        energy = energy_spectrum(field, [is_periodic] * dimension)
        expected = np.zeros_like(energy)
        expected[number - 1] = np.sum(field**2)
        assert_allclose(energy, expected, atol=1e-10)


def test_shells_of_a_torus_are_those_of_the_fourier_transform() -> None:
    rng = np.random.default_rng(2)
    velocity = rng.standard_normal((8, 8, 8, 3))
    modes = np.fft.fftn(velocity, axes=(0, 1, 2), norm="ortho")
    power = (np.abs(modes) ** 2).sum(axis=-1)
    waves = np.fft.fftfreq(8, 1 / 8)
    kx, ky, kz = np.meshgrid(waves, waves, waves, indexing="ij")
    shell = np.rint(np.sqrt(kx**2 + ky**2 + kz**2))
    expected = [power[shell == number].sum() for number in range(1, 5)]
    energy = energy_spectrum(velocity, [True] * 3)
    assert_allclose(energy, expected, rtol=1e-12)


def test_a_periodic_axis_beside_walls_counts_half_waves() -> None:
    places = (np.arange(12) + 0.5) / 12
    velocity = np.zeros((12, 12, 2))
    velocity[..., 1] = np.cos(2.0 * np.pi * 2 * places)[:, None]
    energy = energy_spectrum(velocity, [True, False])
    assert np.flatnonzero(energy > 1e-12).tolist() == [3]


def test_a_long_periodic_axis_counts_waves_on_its_length() -> None:
    places = (np.arange(12) + 0.5) / 12
    velocity = np.zeros((24, 12, 2))
    velocity[..., 0] = np.cos(2.0 * np.pi * 2 * places)
    energy = energy_spectrum(velocity, [True, True])
    assert np.flatnonzero(energy > 1e-12).tolist() == [3]


def test_a_known_rotation_is_found_and_both_forms_agree() -> None:
    rng = np.random.default_rng(3)
    body = rng.standard_normal((40, 3))
    body -= body.mean(axis=0)
    rotation = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
    assert_allclose(fit_rotation(body @ rotation.T, body), rotation, atol=1e-12)
    assert rigid_residual(body @ rotation.T + 0.4, body) < 1e-12
    assert rigid_residual(body * [1.0, 1.0, -1.0], body) > 0.1

    for _ in range(20):
        t = rng.standard_normal((9, 2))
        p = rng.standard_normal((9, 2))
        t -= t.mean(axis=0)
        p -= p.mean(axis=0)
        by_svd = p @ fit_rotation(t, p).T
        assert_allclose(by_svd, rotate_in_plane(t, p), atol=1e-12)


def test_a_noisy_fit_is_that_of_scipy() -> None:
    rng = np.random.default_rng(4)
    truth = rng.standard_normal((30, 3))
    truth -= truth.mean(axis=0)
    prediction = truth + rng.normal(0.0, 0.2, truth.shape)
    prediction -= prediction.mean(axis=0)
    best, distance = Rotation.align_vectors(truth, prediction)
    ours = fit_rotation(truth, prediction)
    assert_allclose(ours, best.as_matrix(), atol=1e-10)
    expected = distance / math.sqrt(len(truth))
    assert rigid_residual(truth, prediction) == pytest.approx(expected)


def test_a_body_across_a_periodic_end_keeps_its_shape() -> None:
    body = 0.2 * (lattice(2, 5) - 0.5)
    truth = TORUS.wrap(body + np.array([0.98, 0.5]))
    prediction = TORUS.wrap(body + np.array([0.3, 0.02]))
    scenario = scenario_in(TORUS, truth, material=1)
    pair = FramePair(
        scenario,
        2,
        scenario.snapshot(truth, truth),
        scenario.snapshot(prediction, prediction),
    )
    assert METRICS["shape_error"].measure(pair) < 1e-12
    assert METRICS["connectivity"].measure(pair) == 1.0


def test_bonds_reach_across_periodic_ends_only() -> None:
    position = np.array([[0.02, 0.5], [0.98, 0.5], [0.5, 0.02], [0.5, 0.98]])
    assert len(Bonds.within(0.1, position).pairs) == 0
    assert Bonds.within(0.1, position, CHANNEL).pairs.tolist() == [[0, 1]]
    assert len(Bonds.within(0.1, position, TORUS).pairs) == 2
    assert Bonds.within(0.1, position, TORUS).intact_share(position) == 1.0


def test_directions_are_unit_vectors_spread_evenly() -> None:
    for dimension in (2, 3):
        rows = directions(dimension).astype(np.float64)
        assert_allclose(np.linalg.norm(rows, axis=1), 1.0, atol=1e-6)
        spread = rows.T @ rows / len(rows)
        assert_allclose(spread, np.eye(dimension) / dimension, atol=0.01)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_shifted_cloud_is_off_by_the_shift_over_the_root_of_the_dimension(
    dimension: int,
) -> None:
    rng = np.random.default_rng(5)
    cloud = rng.random((300, dimension))
    for axis in range(dimension):
        shift = np.zeros(dimension)
        shift[axis] = 0.2
        distance = sliced_wasserstein2(cloud, cloud + shift)
        assert distance == pytest.approx(0.2 / math.sqrt(dimension), rel=0.01)


def test_angular_momentum_is_a_scalar_or_a_vector() -> None:
    rate = np.array([0.01, -0.02, 0.03])
    position = lattice(3, 5)
    arm = position - 0.5
    scenario = scenario_in(SOLID, position)
    snapshot = scenario.snapshot(position, position - np.cross(rate, arm))
    inertia = np.sum(arm[:, 0] ** 2 + arm[:, 1] ** 2)  # the same about every axis
    assert_allclose(angular_momentum(snapshot), inertia * rate, rtol=1e-10)

    plane = lattice(2, 5)
    arm = plane - 0.5
    turned = np.stack([-0.03 * arm[:, 1], 0.03 * arm[:, 0]], axis=1)
    snapshot = scenario_in(WALLED, plane).snapshot(plane, plane - turned)
    expected = 0.03 * np.sum(arm**2)
    assert float(angular_momentum(snapshot)) == pytest.approx(expected)


def test_vorticity_of_a_solid_rotation_is_twice_its_rate_at_every_node() -> None:
    rate = np.array([0.01, -0.02, 0.03])
    position = lattice(3, 16)
    velocity = np.cross(rate, position - 0.5)
    pair = pair_in(SOLID, position, velocity=velocity)
    omega = pair.true_vorticity.reshape(pair.node_count, 3)
    deep = np.abs(omega - 2.0 * rate).max(axis=1)
    assert pair.node_count == 6**3
    assert np.quantile(deep, 0.25) < 1e-12  # the transfer bends the flow at walls
