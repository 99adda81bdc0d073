"""Metrics in two and three dimensions, between walls and in periodic boxes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import entropy

from lagbench.data.box import Box
from lagbench.data.grid import Grid, Placement
from lagbench.metrics import METRICS, FramePair, Scenario, TaskConfig
from lagbench.metrics.bodies import fit_rotation, rigid_residual, rotate_in_plane
from lagbench.metrics.conservation import angular_momentum
from lagbench.metrics.distributions import energy_spectrum
from lagbench.metrics.frame import Bonds, sliced_wasserstein2

Floats = NDArray[np.float64]

SQUARE = [(0.0, 1.0)] * 2
CUBE = [(0.0, 1.0)] * 3
WALLED = Box.from_bounds(SQUARE)
CHANNEL = Box.from_bounds(SQUARE, periodic=[True, False])
TORUS = Box.from_bounds(SQUARE, periodic=[True, True])
SOLID = Box.from_bounds(CUBE)
SOLID_CHANNEL = Box.from_bounds(CUBE, periodic=[True, False, True])
SOLID_TORUS = Box.from_bounds(CUBE, periodic=[True, True, True])
BOXES = (WALLED, CHANNEL, TORUS, SOLID, SOLID_CHANNEL, SOLID_TORUS)
EVERY_BOX = pytest.mark.parametrize("box", BOXES)


def lattice(dimension: int, side: int) -> Floats:
    """Return particles that fill the unit box, shape [particle, axis]."""
    axis = (np.arange(side) + 0.5) / side
    axes = [axis] * dimension
    coordinates = np.meshgrid(*axes, indexing="ij")
    points = np.stack(coordinates, axis=-1)
    return points.reshape(-1, dimension)


def scenario_in(box: Box, position: Floats, *, material: int = 0) -> Scenario:
    """Return a scenario of particles at rest in a box."""
    particle_count = len(position)
    position_std = (0.3,) * box.dimension
    velocity_std = (0.01,) * box.dimension
    config = TaskConfig(
        grid=Grid(8, Placement.CELL_CENTRES, box),
        input_frames=2,
        horizon=6,
        frames_of_interest=(2,),
        attribute_std=position_std + velocity_std,
        radius=0.2,
    )
    return Scenario(
        config=config,
        input_positions=np.stack([position, position]),
        material=np.full(particle_count, material, np.int8),
        particle_mass=1.0 / particle_count,
        area=1.0,
    )


def pair_at_rest(scenario: Scenario, truth: Floats, prediction: Floats) -> FramePair:
    """Return a pair of clouds of which no particle moves."""
    return FramePair(
        scenario,
        2,
        scenario.snapshot(truth, truth),
        scenario.snapshot(prediction, prediction),
    )


def measure(name: str, pair: FramePair) -> float:
    """Return the value of a metric."""
    return METRICS[name].measure(pair)


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
def test_a_particle_just_across_a_periodic_end_is_near(box: Box) -> None:
    rng = np.random.default_rng(1)
    true = rng.random((50, box.dimension))
    predicted = rng.random((50, box.dimension))
    scenario = scenario_in(box, true)
    pair = pair_at_rest(scenario, true, predicted)
    distance = np.abs(predicted - true)
    nearest = np.minimum(distance, 1.0 - distance)
    periodic = np.asarray(box.periodic)
    distance[:, periodic] = nearest[:, periodic]
    expected = np.mean(distance**2)
    mse = measure("position_mse", pair)
    assert mse == pytest.approx(expected, rel=1e-12)


def test_a_whole_period_is_no_error_and_a_crossing_no_jump() -> None:
    position = lattice(3, 6)
    velocity = [0.3, 0.0, 0.0]
    pair = pair_in(
        SOLID_TORUS,
        position,
        velocity=velocity,
        shift=[1.0, 0.0, -2.0],
    )
    mse = measure("position_mse", pair)
    assert mse == pytest.approx(0.0, abs=1e-24)
    wrapped = SOLID_TORUS.wrap(position - velocity)
    snapshot = pair.scenario.snapshot(position, wrapped)
    assert_allclose(snapshot.velocity[:, 0], 0.3, atol=1e-12)


def test_only_walls_have_an_outside() -> None:
    position = np.full((4, 2), 0.5)
    scenario = scenario_in(CHANNEL, position)
    moved = position.copy()
    moved[0] = [1.3, 0.5]
    moved[1] = [0.5, 1.3]
    pair = pair_at_rest(scenario, position, moved)
    assert pair.outside_share == 0.25


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("is_periodic", [False, True])
def test_the_spectrum_of_a_mode_lies_in_its_shell(
    dimension: int, is_periodic: bool
) -> None:
    count = 12
    number = 3
    places = (np.arange(count) + 0.5) / count
    half_waves = number * (2.0 if is_periodic else 1.0)
    wave = np.cos(np.pi * half_waves * places)
    nodes = (count,) * dimension
    velocity = np.zeros((*nodes, dimension))
    for axis in range(dimension):
        field = np.zeros_like(velocity)
        along_axis = np.moveaxis(field, axis, -2)
        along_axis[..., 0] = wave
        energy = energy_spectrum(field, [is_periodic] * dimension)
        expected = np.zeros_like(energy)
        expected[number - 1] = np.sum(field**2)
        assert_allclose(energy, expected, atol=1e-10)


def test_shells_of_a_torus_are_those_of_the_fourier_transform() -> None:
    rng = np.random.default_rng(2)
    velocity = rng.standard_normal((8, 8, 8, 3))
    modes = np.fft.fftn(velocity, axes=(0, 1, 2), norm="ortho")
    power = np.sum(np.abs(modes) ** 2, axis=-1)
    waves = np.fft.fftfreq(8, 1 / 8)
    kx, ky, kz = np.meshgrid(waves, waves, waves, indexing="ij")
    number_of_waves = np.sqrt(kx**2 + ky**2 + kz**2)
    shell = np.rint(number_of_waves)
    expected = []
    for number in range(1, 5):
        expected.append(power[shell == number].sum())
    energy = energy_spectrum(velocity, [True] * 3)
    assert_allclose(energy, expected, rtol=1e-12)


def shells_with_energy(energy: Floats) -> list[int]:
    """Return the places of the shells that are not empty."""
    places: list[int] = np.flatnonzero(energy > 1e-12).tolist()
    return places


def two_waves(count: int) -> Floats:
    """Return a wave with two periods on the unit length."""
    places = (np.arange(count) + 0.5) / count
    return np.cos(2.0 * np.pi * 2 * places)


def test_a_periodic_axis_beside_walls_counts_half_waves() -> None:
    velocity = np.zeros((12, 12, 2))
    velocity[..., 1] = two_waves(12)[:, None]
    energy = energy_spectrum(velocity, [True, False])
    assert shells_with_energy(energy) == [3]


def test_a_long_periodic_axis_counts_waves_on_its_length() -> None:
    velocity = np.zeros((24, 12, 2))
    velocity[..., 0] = two_waves(12)
    energy = energy_spectrum(velocity, [True, True])
    assert shells_with_energy(energy) == [3]


def centred_points(rng: np.random.Generator, *shape: int) -> Floats:
    """Return normal points about the origin, shape [particle, axis]."""
    points = rng.standard_normal(shape)
    return points - points.mean(axis=0)


def test_a_known_rotation_is_found_and_both_forms_agree() -> None:
    rng = np.random.default_rng(3)
    body = centred_points(rng, 40, 3)
    rotation = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
    rotated = body @ rotation.T
    fitted = fit_rotation(rotated, body)
    assert_allclose(fitted, rotation, atol=1e-12)
    shifted = rotated + 0.4
    assert rigid_residual(shifted, body) < 1e-12
    mirrored = body * [1.0, 1.0, -1.0]
    assert rigid_residual(mirrored, body) > 0.1

    for _ in range(20):
        truth = centred_points(rng, 9, 2)
        prediction = centred_points(rng, 9, 2)
        rotation = fit_rotation(truth, prediction)
        by_svd = prediction @ rotation.T
        in_plane = rotate_in_plane(truth, prediction)
        assert_allclose(by_svd, in_plane, atol=1e-12)


def test_a_body_across_a_periodic_end_keeps_its_shape() -> None:
    body = 0.2 * (lattice(2, 5) - 0.5)
    across_the_end = np.array([0.98, 0.5])
    elsewhere = np.array([0.3, 0.02])
    truth = TORUS.wrap(body + across_the_end)
    prediction = TORUS.wrap(body + elsewhere)
    scenario = scenario_in(TORUS, truth, material=1)
    pair = pair_at_rest(scenario, truth, prediction)
    assert measure("shape_error", pair) < 1e-12
    assert measure("connectivity", pair) == 1.0


def test_bonds_reach_across_periodic_ends_only() -> None:
    near_left = [0.02, 0.5]
    near_right = [0.98, 0.5]
    near_bottom = [0.5, 0.02]
    near_top = [0.5, 0.98]
    position = np.array([near_left, near_right, near_bottom, near_top])
    between_walls = Bonds.within(0.1, position)
    assert len(between_walls.pairs) == 0
    in_channel = Bonds.within(0.1, position, CHANNEL)
    assert in_channel.pairs.tolist() == [[0, 1]]
    in_torus = Bonds.within(0.1, position, TORUS)
    assert len(in_torus.pairs) == 2
    assert in_torus.intact_share(position) == 1.0


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_shifted_cloud_is_off_by_the_shift_over_the_root_of_the_dimension(
    dimension: int,
) -> None:
    rng = np.random.default_rng(5)
    cloud = rng.random((300, dimension))
    expected = 0.2 / math.sqrt(dimension)
    for axis in range(dimension):
        shift = np.zeros(dimension)
        shift[axis] = 0.2
        distance = sliced_wasserstein2(cloud, cloud + shift)
        assert distance == pytest.approx(expected, rel=0.01)


def test_angular_momentum_is_a_scalar_or_a_vector() -> None:
    rate = np.array([0.01, -0.02, 0.03])
    position = lattice(3, 5)
    arm = position - 0.5
    scenario = scenario_in(SOLID, position)
    velocity = np.cross(rate, arm)
    snapshot = scenario.snapshot(position, position - velocity)
    # about the third axis, and the same about every other
    inertia = np.sum(arm[:, 0] ** 2 + arm[:, 1] ** 2)
    momentum = angular_momentum(snapshot)
    assert_allclose(momentum, inertia * rate, rtol=1e-10)

    plane = lattice(2, 5)
    arm = plane - 0.5
    arm_x, arm_y = arm.T
    velocity = 0.03 * np.stack([-arm_y, arm_x], axis=1)
    scenario = scenario_in(WALLED, plane)
    snapshot = scenario.snapshot(plane, plane - velocity)
    expected = 0.03 * np.sum(arm**2)
    assert float(angular_momentum(snapshot)) == pytest.approx(expected)


def test_vorticity_of_a_solid_rotation_is_twice_its_rate_at_every_node() -> None:
    rate = np.array([0.01, -0.02, 0.03])
    position = lattice(3, 16)
    velocity = np.cross(rate, position - 0.5)
    pair = pair_in(SOLID, position, velocity=velocity)
    omega = pair.true_vorticity.reshape(pair.node_count, 3)
    error = np.abs(omega - 2.0 * rate).max(axis=1)
    assert pair.node_count == 6**3
    # The transfer bends the flow at walls.
    assert np.quantile(error, 0.25) < 1e-12


def test_divergences_in_space_compare_the_components_of_the_vorticity() -> None:
    """The prediction turns about another axis, so at most nodes its vorticity has the
    same length: only the components tell it from the truth.
    """
    position = lattice(3, 16)
    arm = position - 0.5
    rate = np.array([0.01, -0.02, 0.03])
    scenario = scenario_in(SOLID, position)
    truth = scenario.snapshot(position, position - np.cross(rate, arm))
    turned = np.cross(np.roll(rate, 1), arm)
    prediction = scenario.snapshot(position, position - turned)
    pair = FramePair(scenario, 2, truth, prediction)
    p = np.abs(pair.true_vorticity).reshape(-1, 3)
    q = np.abs(pair.predicted_vorticity).reshape(-1, 3)
    divergence = METRICS["vorticity_kl"].measure(pair)
    assert divergence == pytest.approx(entropy(p.ravel(), q.ravel()), rel=1e-6)
    lengths = np.linalg.norm(p, axis=1), np.linalg.norm(q, axis=1)
    assert divergence > 10.0 * entropy(*lengths)
