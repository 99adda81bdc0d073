"""The free-surface solver as a caller sees it: closed forms, limits, errors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from free_surface_scenarios import Part, parameters, scenario, start
from numpy.testing import assert_allclose

from lagbench.errors import WorkFailedError
from lagbench.generators.free_surface import FreeSurface, courant
from lagbench.generators.shapes import Disc, Rectangle
from lagbench.generators.split import Device, InitialState, Material

# Each module of kernels takes seconds to compile.
pytestmark = pytest.mark.slow

CONSTANTS = parameters()
WEIGHTLESS = parameters(gravity=0.0)
LOW = CONSTANTS.wall / CONSTANTS.grid
DISC = Disc(0.12)


Vector = tuple[float, float]


def ball(
    material: Material,
    velocity: Vector = (0.0, 0.0),
    height: float = 0.6,
) -> InitialState:
    """One disc in mid-air."""
    disc = Part(material, DISC, (0.5, height), velocity)
    return scenario(CONSTANTS, disc)


def mean_height(solver: FreeSurface) -> float:
    """Return the mean height of the first scenario's particles [length]."""
    position = solver.position()[0].astype(np.float64)
    height = position[:, 1]
    return float(height.mean())


@pytest.mark.parametrize("material", Material)
def test_free_flight_is_a_parabola(material: Material) -> None:
    """A body in the air has mean velocity v + g t and mean height y + v t + g t^2 /
    2.
    """
    flying = ball(material, (0.25, 0.5))
    solver = start(CONSTANTS, [flying])
    y = mean_height(solver)
    substeps = 180
    solver.advance(substeps)
    t = substeps * CONSTANTS.dt
    velocity = solver.velocity()[0].astype(np.float64)
    vx, vy = velocity.mean(axis=0)
    assert abs(vx - 0.25) <= 2e-5
    expected_vy = 0.5 - 2.5 * t
    assert abs(vy - expected_vy) <= 2e-5
    # Symplectic Euler: position lags by half a substep of acceleration.
    fall_time = t * (t + CONSTANTS.dt)
    fall = 0.5 * 2.5 * fall_time
    expected_height = y + 0.5 * t - fall
    assert abs(mean_height(solver) - expected_height) <= 2e-5


@pytest.mark.parametrize("material", Material)
def test_momentum_and_spin_are_conserved(material: Material) -> None:
    """Without gravity and walls, sums of v and of r x v + dx^2/4 (C_yx - C_xy) stay."""
    state = scenario(WEIGHTLESS, Part(material, DISC, (0.5, 0.5)))
    x, y = (state.position - 0.5).T
    rotation = 3.0 * np.stack([-y, x], axis=1)
    gradient = np.array([[0.0, -3.0], [3.0, 0.0]])
    turning = dataclasses.replace(
        state,
        velocity=rotation + np.array([0.1, 0.2]),
        affine=np.tile(gradient, (len(x), 1, 1)),
    )
    solver = start(WEIGHTLESS, [turning])
    sums = []
    for _ in range(2):
        x, y = solver.position()[0].astype(np.float64).T
        u, v = solver.velocity()[0].astype(np.float64).T
        affine = solver.affine()[0].astype(np.float64)
        spin = 0.25 / WEIGHTLESS.grid**2 * (affine[:, 1, 0] - affine[:, 0, 1])
        sums.append([u.sum(), v.sum(), (x * v - y * u + spin).sum()])
        solver.advance(100)
    before, after = np.array(sums)
    assert_allclose(after[:2], before[:2], rtol=1e-4)
    assert_allclose(after[2], before[2], rtol=2e-3)


@pytest.mark.parametrize("material", Material)
def test_compression_stores_energy(material: Material) -> None:
    """An impact turns kinetic into elastic energy; nothing is gained."""
    centre = (0.5, LOW + 0.16)
    falling = Part(material, DISC, centre, (0.0, -2.0))
    state = scenario(WEIGHTLESS, falling)
    solver = start(WEIGHTLESS, [state])
    before = solver.energy().total[0]
    solver.advance(45)
    energy = solver.energy()
    assert energy.elastic[0] > 0.002 * before
    assert energy.total[0] <= before * 1.0001


def mean_speed_along_x(solver: FreeSurface) -> float:
    """Return the mean velocity along x of the first scenario's particles."""
    velocity = solver.velocity()[0]
    return float(velocity[:, 0].mean())


def test_friction_decelerates_by_mu_g() -> None:
    """A block that slides on the floor loses mu g of speed per second, and keeps it
    without friction.
    """
    decelerations = {}
    for friction in (0.0, 0.3):
        shape = Rectangle(0.3, 0.1)
        centre = (0.3, LOW + 0.065)
        block = Part(Material.ROPE, shape, centre)
        state = scenario(CONSTANTS, block, friction=friction)
        solver = start(CONSTANTS, [state])
        solver.advance(600)
        resting = solver.position()[0].astype(np.float64)
        pushed = state.velocity + np.array([0.6, 0.0])
        sliding = dataclasses.replace(state, position=resting, velocity=pushed)
        solver.load([sliding])
        solver.advance(60)
        early = mean_speed_along_x(solver)
        solver.advance(180)
        late = mean_speed_along_x(solver)
        duration = 180 * CONSTANTS.dt
        decelerations[friction] = (early - late) / duration
    assert abs(decelerations[0.0]) <= 1e-4
    braked = decelerations[0.3]
    assert braked == pytest.approx(0.3 * 2.5, rel=0.1)


def test_walls_contain_particles_and_health_reports_extremes() -> None:
    """Nothing leaves the box; health reports the extremes of the last advance."""
    towards_corner = (-2.0, -2.0)
    centre = (0.25, 0.25)
    drop = Part(Material.LIQUID, DISC, centre, towards_corner)
    state = scenario(CONSTANTS, drop)
    solver = start(CONSTANTS, [state])
    assert solver.health()[0].max_speed == 2.0
    solver.advance(120)
    health = solver.health()[0]
    assert health.finite
    cell_per_substep = 1.0 / (CONSTANTS.grid * CONSTANTS.dt)
    assert 2.0 < health.max_speed < cell_per_substep
    assert 0.5 <= health.jacobian_min < 0.99
    assert health.jacobian_max == 1.0
    position = solver.position()
    assert position.min() >= np.float32(LOW)
    assert position.max() <= np.float32(1.0 - LOW)


def test_runaway_particle_is_reported() -> None:
    """Speeds beyond one cell per substep name the scenario, the substeps and the
    bound.
    """
    bound = 1.0 / (CONSTANTS.grid * CONSTANTS.dt)
    body = ball(Material.LIQUID)  # gravity takes it past the bound
    fall = (0.0, 1e-3 - bound)
    velocity = np.full_like(body.velocity, fall)
    falling = dataclasses.replace(body, velocity=velocity)
    snow = ball(Material.SNOW)
    jelly = ball(Material.JELLY)
    states = [snow, falling, jelly]
    solver = start(CONSTANTS, states, device=Device.PARALLEL)
    with pytest.raises(WorkFailedError) as caught:
        solver.advance(60)
    assert caught.value.where == "scenario 1, substeps 0 to 60"


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("device", [Device.CPU, Device.PARALLEL])
def test_what_is_not_a_number_is_reported(poison: float, device: Device) -> None:
    """A corrupt velocity neither crashes the process nor passes unseen."""
    jelly = ball(Material.JELLY)
    solver = start(CONSTANTS, [jelly], device=device)
    carried = solver._kernels.particle_state.to_numpy()
    carried[0, 7, :2] = poison
    solver._kernels.particle_state.from_numpy(carried)
    with pytest.raises(WorkFailedError) as caught:
        solver.advance(20)
    assert caught.value.where == "scenario 0, substeps 0 to 20"
    names_bound = "every number is finite" in str(caught.value)
    names_value = "NaN or an infinite number" in str(caught.value)
    assert names_bound == names_value
    assert "e+38" not in str(caught.value)
    assert solver.position().min() >= np.float32(LOW)


def test_courant_numbers_by_hand() -> None:
    """Liquid: sqrt(30) 128/1200; snow: sqrt(5 E (1 - nu) / ((1 + nu)(1 - 2 nu)))
    64/1200.
    """
    fluid = parameters(grid=128, dt=1 / 1200, liquid_modulus=30.0)
    liquid_number = courant(fluid)[Material.LIQUID]
    assert liquid_number == pytest.approx(0.58424, abs=1e-5)

    numbers = courant(parameters(grid=64, dt=1 / 1200))
    square_speed = 5 * 40 * 0.8 / (1.2 * 0.6)
    sound_speed = np.sqrt(square_speed)
    snow_number = sound_speed * 64 / 1200
    assert numbers[Material.SNOW] == pytest.approx(snow_number)
    assert max(numbers.values()) <= 0.8


def test_jacobian_of_liquid_and_of_solids() -> None:
    """Liquid reports its J within its bounds, solids the determinant of F."""
    falling = (0.0, -2.0)
    drop = Part(Material.LIQUID, DISC, (0.25, 0.2), falling)
    rope = Part(Material.ROPE, DISC, (0.75, 0.2), falling)
    state = scenario(CONSTANTS, drop, rope)
    solver = start(CONSTANTS, [state])
    solver.advance(60)
    jacobian = solver.jacobian()[0]
    is_liquid = state.material == Material.LIQUID
    is_solid = ~is_liquid
    ratio = solver.volume_ratio()[0, is_liquid]
    np.testing.assert_array_equal(jacobian[is_liquid], ratio)
    deformation = solver.deformation()[0, is_solid]
    determinant = np.linalg.det(deformation.astype(np.float64))
    assert_allclose(jacobian[is_solid], determinant, atol=1e-6)
    assert determinant.min() < 0.99
