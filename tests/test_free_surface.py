"""The free-surface solver as a caller sees it: closed forms, limits, errors."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from free_surface_scenarios import Part, parameters, run, scenario, start

from lagbench.errors import UsageError, WorkFailedError
from lagbench.generators.free_surface import courant
from lagbench.generators.shapes import Disc, Rectangle
from lagbench.generators.solver import Device
from lagbench.generators.split import InitialState, Material

CONSTANTS = parameters()
WEIGHTLESS = parameters(gravity=0.0)
LOW = CONSTANTS.wall / CONSTANTS.grid
DISC = Disc(0.12)


def ball(
    material: Material, velocity: tuple[float, float] = (0.0, 0.0), height: float = 0.6
) -> InitialState:
    """One disc in mid-air."""
    return scenario(CONSTANTS, Part(material, DISC, (0.5, height), velocity))


def angular_momentum(
    position: np.ndarray, velocity: np.ndarray, affine: np.ndarray, dx: float
) -> float:
    """Sum of r x v and of the APIC part dx^2/4 (C_yx - C_xy), per unit particle
    mass.
    """
    x, v, c = (a.astype(np.float64) for a in (position, velocity, affine))
    orbital = x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]
    return float((orbital + 0.25 * dx * dx * (c[:, 1, 0] - c[:, 0, 1])).sum())


@pytest.mark.parametrize("material", Material)
def test_free_flight_is_a_parabola(material: Material) -> None:
    """A body in the air has mean velocity v + g t and mean height y + v t + g t^2 /
    2.
    """
    solver = start(CONSTANTS, [ball(material, (0.25, 0.5))])
    y = solver.position()[0, :, 1].astype(np.float64).mean()
    substeps = 180
    solver.advance(substeps)
    t = substeps * CONSTANTS.dt
    vx, vy = solver.velocity()[0].astype(np.float64).mean(axis=0)
    assert abs(vx - 0.25) <= 2e-5
    assert abs(vy - (0.5 - 2.5 * t)) <= 2e-5
    # Symplectic Euler: position lags by half a substep of acceleration.
    expected = y + 0.5 * t - 0.5 * 2.5 * t * (t + CONSTANTS.dt)
    assert abs(solver.position()[0, :, 1].astype(np.float64).mean() - expected) <= 2e-5


@pytest.mark.parametrize("material", Material)
def test_momentum_and_spin_are_conserved(material: Material) -> None:
    """Without gravity and walls, linear and angular momentum stay what they were."""
    spin = 3.0
    state = scenario(WEIGHTLESS, Part(material, DISC, (0.5, 0.5)))
    r = state.position - 0.5
    turning = dataclasses.replace(
        state,
        velocity=spin * np.stack([-r[:, 1], r[:, 0]], axis=1) + np.array([0.1, 0.2]),
        affine=np.broadcast_to(np.array([[0.0, -spin], [spin, 0.0]]), (len(r), 2, 2)),
    )
    solver = start(WEIGHTLESS, [turning])
    dx = 1 / WEIGHTLESS.grid
    momentum = solver.velocity()[0].astype(np.float64).sum(axis=0)
    before = angular_momentum(
        solver.position()[0], solver.velocity()[0], solver.affine()[0], dx
    )
    solver.advance(100)
    after = angular_momentum(
        solver.position()[0], solver.velocity()[0], solver.affine()[0], dx
    )
    np.testing.assert_allclose(
        solver.velocity()[0].astype(np.float64).sum(axis=0), momentum, rtol=1e-4
    )
    assert abs(after - before) <= 2e-3 * abs(before)


def test_energy_of_a_moving_body_by_hand() -> None:
    """Kinetic m v^2/2, gravitational m g h, elastic 0 at the start."""
    state = ball(Material.JELLY, (0.5, -1.0))
    energy = start(CONSTANTS, [state]).energy()
    height = state.position[:, 1].mean() - LOW
    assert energy.kinetic[0] == pytest.approx(0.5 * state.area * 1.25)
    assert energy.gravitational[0] == pytest.approx(state.area * 2.5 * height, rel=1e-3)
    assert energy.elastic[0] == pytest.approx(0.0, abs=1e-12)
    assert energy.total[0] == pytest.approx(energy.kinetic[0] + energy.gravitational[0])


@pytest.mark.parametrize("material", Material)
def test_compression_stores_energy(material: Material) -> None:
    """An impact turns kinetic into elastic energy; nothing is gained."""
    solver = start(
        WEIGHTLESS,
        [scenario(WEIGHTLESS, Part(material, DISC, (0.5, LOW + 0.16), (0.0, -2.0)))],
    )
    before = solver.energy().total[0]
    solver.advance(45)
    energy = solver.energy()
    assert energy.elastic[0] > 0.002 * before
    assert energy.total[0] <= before * 1.0001


def test_friction_decelerates_by_mu_g() -> None:
    """A block that slides on the floor loses mu g of speed per second, and keeps it
    without friction.
    """
    speeds = {}
    for friction in (0.0, 0.3):
        block = Part(Material.ROPE, Rectangle(0.3, 0.1), (0.3, LOW + 0.065))
        state = scenario(CONSTANTS, block, friction=friction)
        solver = start(CONSTANTS, [state])
        solver.advance(600)
        resting = solver.position()[0].astype(np.float64)
        pushed = state.velocity + np.array([0.6, 0.0])
        solver.load([dataclasses.replace(state, position=resting, velocity=pushed)])
        solver.advance(60)
        early = solver.velocity()[0, :, 0].mean()
        solver.advance(180)
        speeds[friction] = (early - solver.velocity()[0, :, 0].mean()) / (
            180 * CONSTANTS.dt
        )
    assert abs(speeds[0.0]) <= 1e-4
    assert speeds[0.3] == pytest.approx(0.3 * 2.5, rel=0.1)


def test_walls_hold_and_health_tells() -> None:
    """Nothing leaves the box; health reports the extremes of the last advance."""
    state = scenario(CONSTANTS, Part(Material.LIQUID, DISC, (0.25, 0.25), (-2.0, -2.0)))
    solver = start(CONSTANTS, [state])
    assert solver.health()[0].max_speed == 2.0
    solver.advance(120)
    health = solver.health()[0]
    assert health.finite
    assert 2.0 < health.max_speed < 1.0 / (CONSTANTS.grid * CONSTANTS.dt)
    assert 0.5 <= health.jacobian_min < 0.99
    assert health.jacobian_max == 1.0
    assert solver.position().min() >= np.float32(LOW)
    assert solver.position().max() <= np.float32(1.0 - LOW)


def test_displace_moves_and_keeps_in_the_box() -> None:
    """Offsets are added in float32 and clamped just inside the walls."""
    solver = start(CONSTANTS, [ball(Material.LIQUID)])
    before = solver.position()
    offset = np.zeros_like(before)
    offset[0, 0] = 2.0**-20, -(2.0**-20)
    offset[0, 1] = -5.0, 5.0
    solver.displace(offset)
    after = solver.position()
    np.testing.assert_array_equal(after[0, 0], before[0, 0] + offset[0, 0])
    np.testing.assert_allclose(after[0, 1], [LOW, 1.0 - LOW], atol=1e-4)
    np.testing.assert_array_equal(after[0, 2:], before[0, 2:])
    solver.advance(5)


def test_runaway_particle_is_reported() -> None:
    """Speeds beyond one cell per substep name the scenario, the substeps and the
    bound.
    """
    bound = 1.0 / (CONSTANTS.grid * CONSTANTS.dt)
    body = ball(Material.LIQUID)  # gravity takes it past the bound
    falling = dataclasses.replace(
        body, velocity=np.full_like(body.velocity, (0.0, 1e-3 - bound))
    )
    states = [ball(Material.SNOW), falling, ball(Material.JELLY)]
    solver = start(CONSTANTS, states, device=Device.PARALLEL)
    with pytest.raises(
        WorkFailedError, match=r"scenario 1, substeps 0 to 60(?s:.*)CFL"
    ):
        solver.advance(60)


@pytest.mark.parametrize("poison", [np.nan, np.inf, 1e30])
@pytest.mark.parametrize("device", [Device.CPU, Device.PARALLEL])
def test_what_is_not_a_number_is_reported(poison: float, device: Device) -> None:
    """A corrupt velocity neither crashes the process nor passes unseen."""
    solver = start(CONSTANTS, [ball(Material.JELLY)], device=device)
    carried = solver._kernels.carried.to_numpy()
    carried[0, 7, :2] = poison
    solver._kernels.carried.from_numpy(carried)
    with pytest.raises(WorkFailedError, match="blew up") as caught:
        solver.advance(20)
    assert ("every number is finite" in str(caught.value.expected)) == (
        "NaN or an infinite number" in str(caught.value.got)
    )
    assert "e+38" not in str(caught.value.got)
    assert solver.position().min() >= np.float32(LOW)


def test_states_that_do_not_fit_are_refused() -> None:
    """Another count of scenarios or particles, NaN and speeds beyond the CFL bound are
    errors.
    """
    solver = start(CONSTANTS, [ball(Material.LIQUID)])
    good = ball(Material.LIQUID)
    with pytest.raises(UsageError, match="number of scenarios"):
        solver.load([good, good])
    with pytest.raises(UsageError, match="shape of position"):
        solver.load([dataclasses.replace(good, position=good.position[:-1])])
    for wild in (
        {"position": good.position * np.nan},
        {"velocity": good.velocity + 100.0},
    ):
        with pytest.raises(WorkFailedError, match="bounds"):
            solver.load([dataclasses.replace(good, **wild)])


def test_courant_numbers_by_hand() -> None:
    """Liquid: sqrt(30) 128/1200; snow: sqrt(5 E (1 - nu) / ((1 + nu)(1 - 2 nu)))
    64/1200.
    """
    fluid = parameters(grid=128, dt=1 / 1200, liquid_modulus=30.0)
    assert courant(fluid)[Material.LIQUID] == pytest.approx(0.58424, abs=1e-5)
    both = courant(parameters(grid=64, dt=1 / 1200))
    assert both[Material.SNOW] == pytest.approx(
        np.sqrt(5 * 40 * 0.8 / (1.2 * 0.6)) * 64 / 1200
    )
    assert max(both.values()) <= 0.8


def test_jacobian_of_liquid_and_of_solids() -> None:
    """Liquid reports its J within its bounds, solids the determinant of F."""
    places = {Material.LIQUID: (0.25, 0.2), Material.ROPE: (0.75, 0.2)}
    state = scenario(
        CONSTANTS, *(Part(kind, DISC, at, (0.0, -2.0)) for kind, at in places.items())
    )
    solver = start(CONSTANTS, [state])
    solver.advance(60)
    liquid = state.material == Material.LIQUID
    np.testing.assert_array_equal(
        solver.jacobian()[0, liquid], solver.volume_ratio()[0, liquid]
    )
    determinant = np.linalg.det(solver.deformation()[0, ~liquid].astype(np.float64))
    np.testing.assert_allclose(solver.jacobian()[0, ~liquid], determinant, atol=1e-6)
    assert determinant.min() < 0.99


def test_two_bodies_in_touch_share_the_grid() -> None:
    """A liquid that falls on jelly stops above it: the bodies do not pass through each
    other.
    """
    below = Part(Material.JELLY, Rectangle(0.86, 0.2), (0.5, LOW + 0.11))
    above = Part(Material.LIQUID, Rectangle(0.5, 0.1), (0.5, LOW + 0.32))
    state = scenario(CONSTANTS, below, above)
    position = run(CONSTANTS, [state], 600)[0][0]
    jelly = state.material == Material.JELLY
    assert position[jelly, 1].mean() < position[~jelly, 1].mean() - 0.1
