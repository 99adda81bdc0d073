"""The closed-box solver's physics on small boxes, and what it says when it fails."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from box_scenarios import (
    ALL_LIDS,
    FREE_SLIP,
    INERT,
    NO_SLIP,
    after,
    box,
    loaded,
    parameters,
    scenario,
)
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from lagbench.errors import UsageError, WorkFailedError
from lagbench.generators.draws import quantise
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.split import Device, InitialState

# Each module of kernels takes seconds to compile.
pytestmark = pytest.mark.slow


def with_velocity(
    state: InitialState,
    velocity: NDArray[np.float64],
    affine: NDArray[np.float64],
) -> InitialState:
    """Return a state with other velocities, rounded as states must be."""
    return dataclasses.replace(
        state,
        velocity=quantise(velocity),
        affine=quantise(affine),
    )


def cells_of_vortex(
    constants: FullBoxParameters,
    state: InitialState,
) -> tuple[Any, Any]:
    """Return velocity and gradient of u = sin kx cos ky, v = -cos kx sin ky, k =
    pi/L.
    """
    low, high = box(constants)
    k = np.pi / (high - low)
    x, y = k * (state.position - low).T
    sin_x = np.sin(x)
    cos_x = np.cos(x)
    sin_y = np.sin(y)
    cos_y = np.cos(y)
    velocity = np.stack([sin_x * cos_y, -cos_x * sin_y], axis=1)
    straight = cos_x * cos_y
    across = sin_x * sin_y
    matrix = np.array(
        [
            [straight, -across],
            [across, -straight],
        ]
    )
    gradient = k * matrix.transpose(2, 0, 1)
    return velocity, gradient


def test_a_regular_lattice_stays_at_rest() -> None:
    """Nine particles per cell, evenly spaced: density and J are 1 everywhere and
    nothing moves.
    """
    state = scenario(NO_SLIP, jitter=0.0)
    result = after(NO_SLIP, [state], 400)
    position = result["position"][0]
    assert_allclose(position, state.position, rtol=0, atol=2e-5)
    speed = np.abs(result["velocity"])
    assert speed.max() < 2e-5
    assert_allclose(result["jacobian"], 1.0, rtol=0, atol=2e-5)


def test_transfers_conserve_momentum() -> None:
    """Without pressure, viscosity and shift nothing changes the momentum of a patch off
    the walls.
    """
    state = scenario(INERT, seed=1, speed=0.3, viscosity=0.0)
    distance = np.abs(state.position - 0.5).max(axis=1)
    patch = distance < 0.15
    velocity = state.velocity * patch[:, None]
    affine = state.affine * patch[:, None, None]
    state = with_velocity(state, velocity, affine)
    before = state.velocity.sum(axis=0)
    result = after(INERT, [state], 4)
    moved = result["velocity"][0].astype(np.float64)
    change = np.abs(moved - state.velocity)
    assert change.max() > 0.05
    total_speed = np.abs(state.velocity).sum()
    momentum = moved.sum(axis=0)
    assert_allclose(momentum, before, rtol=0, atol=1e-6 * total_speed)


def test_a_vortex_decays_as_navier_stokes_says() -> None:
    """The free-slip vortex sin kx cos ky is a solution with amplitude exp(-2 nu k^2
    t).
    """
    exact = {
        "velocity_relaxation": 0.0,
        "density_coupling": 0.002,
        "shift": 0.002,
    }
    constants = parameters(
        particles=4900,
        grid=32,
        dt=2e-3,
        no_slip=False,
        **exact,
    )
    state = scenario(constants, seed=2, viscosity=5e-3)
    shape, gradient = cells_of_vortex(constants, state)
    state = with_velocity(state, 0.05 * shape, 0.05 * gradient)
    solver = loaded(constants, [state])
    solver.advance(2000)
    position = solver.position()[0]
    moved = dataclasses.replace(state, position=position)
    shape, _ = cells_of_vortex(constants, moved)
    velocity = solver.velocity()[0]
    projection = np.sum(velocity * shape)
    amplitude = projection / np.sum(shape**2)
    low, high = box(constants)
    wave_number = np.pi / (high - low)
    decay_rate = 2.0 * 5e-3 * wave_number**2
    time = 2000 * 2e-3
    expected = 0.05 * np.exp(-decay_rate * time)
    assert amplitude == pytest.approx(expected, rel=0.003)


def test_energy_falls_when_the_lid_rests() -> None:
    """Walls at rest do no work: kinetic energy falls from every 25 substeps to the
    next.
    """
    constants = parameters(particles=2500, grid=32, dt=2e-3)
    state = scenario(constants, seed=3, viscosity=1e-3)
    shape, gradient = cells_of_vortex(constants, state)
    low, high = box(constants)
    share = (state.position - low) / (high - low)
    phase = np.pi * share
    envelope = np.sin(phase).prod(axis=1)
    velocity = 0.1 * envelope[:, None] * shape
    moving = with_velocity(state, velocity, 0.0 * gradient)
    solver = loaded(constants, [moving])
    energies = []
    for _ in range(24):
        solver.advance(25)
        velocity = solver.velocity().astype(np.float64)
        energies.append(np.sum(velocity**2))
    assert np.all(np.diff(energies) < 0.0)
    assert energies[-1] < 0.9 * energies[0]


def test_jacobian_stays_near_one() -> None:
    """Away from the lid's corners J stays within 2 % while the lid drives the flow."""
    constants = parameters(particles=2500, grid=32, dt=2e-3)
    walls = (0.0, 0.0, 0.0, 0.1)
    state = scenario(constants, seed=4, walls=walls)
    solver = loaded(constants, [state])
    solver.advance(2000)
    x, y = solver.position()[0].T
    jacobian = solver.jacobian()[0]
    low, high = box(constants)
    reach = 5.0 / constants.grid
    is_at_side = np.abs(x - 0.5) > 0.5 - low - reach
    corner = (y > high - reach) & is_at_side
    compression = jacobian[~corner] - 1.0
    assert np.abs(compression).max() < 0.02
    health = solver.health()[0]
    assert health.finite
    assert health.jacobian_min <= jacobian.min()
    assert health.jacobian_max >= jacobian.max()
    fastest = np.abs(solver.velocity()).max()
    assert fastest <= health.max_speed <= 0.12


# by 90 degrees: left, right <- top, bottom
QUARTER_TURN = [
    [0.0, -1.0],
    [1.0, 0.0],
]
TURNED_WALLS = [3, 2, 0, 1]
# x -> 1 - x: left and right change places
FLIP = [
    [-1.0, 0.0],
    [0.0, 1.0],
]
FLIPPED_WALLS = [1, 0, 2, 3]


@pytest.mark.parametrize(
    "constants",
    [NO_SLIP, FREE_SLIP],
    ids=["no slip", "free slip"],
)
@pytest.mark.parametrize(
    ("turn", "walls_from"),
    [
        (QUARTER_TURN, TURNED_WALLS),
        (FLIP, FLIPPED_WALLS),
    ],
    ids=["turned", "flipped"],
)
def test_no_direction_is_special(
    constants: FullBoxParameters,
    turn: list[list[float]],
    walls_from: list[int],
) -> None:
    """A turned or mirrored box, its moving walls included, evolves into the turned or
    mirrored result.
    """
    matrix = np.array(turn)

    def change(state: InitialState) -> InitialState:
        position = (state.position - 0.5) @ matrix.T + 0.5
        wall_velocity = state.wall_velocity @ matrix.T
        return dataclasses.replace(
            state,
            position=position,
            velocity=state.velocity @ matrix.T,
            affine=matrix @ state.affine @ matrix.T,
            wall_velocity=wall_velocity[walls_from],
        )

    walls = (0.0, 0.0, 0.0, 0.0)
    if constants.no_slip:
        walls = ALL_LIDS
    state = scenario(constants, seed=5, speed=0.2, walls=walls)
    plain = after(constants, [state], 60)
    changed_state = change(state)
    turned = after(constants, [changed_state], 60)
    position = plain["position"][0]
    velocity = plain["velocity"][0]
    last_state = dataclasses.replace(
        state,
        position=position,
        velocity=velocity,
    )
    image = change(last_state)
    turned_position = turned["position"][0]
    turned_velocity = turned["velocity"][0]
    assert_allclose(turned_position, image.position, rtol=0, atol=1e-5)
    assert_allclose(turned_velocity, image.velocity, rtol=0, atol=5e-5)


def test_displaced_particles_stay_in_the_box() -> None:
    """Offsets are added in float32; who would leave stands just inside the wall."""
    state = scenario(NO_SLIP)
    solver = loaded(NO_SLIP, [state])
    before = solver.position()
    step = np.float32(2.0**-20)
    offset = np.full_like(before, step)
    offset[0, 0] = 5.0
    solver.displace(offset)
    moved = solver.position()[0]
    expected = before[0, 1:] + step
    np.testing.assert_array_equal(moved[1:], expected)
    _, high = box(NO_SLIP)
    just_inside = high - 0.01 / NO_SLIP.grid
    assert just_inside < moved[0, 0] < high


def test_sums_hold_every_particle_in_one_place() -> None:
    """All 20,000 particles on one spot at nearly the largest speed: the nodes see
    exactly that speed.
    """
    speed = 0.9 / (INERT.grid * INERT.dt)
    everywhere = np.ones((INERT.particles, 2))
    at_rest = scenario(INERT, viscosity=0.0)
    state = dataclasses.replace(at_rest, position=0.5 * everywhere)
    no_gradient = 0.0 * state.affine
    state = with_velocity(state, speed * everywhere, no_gradient)
    result = after(INERT, [state], 1)
    nodes = result["grid_velocity"][0]
    around_the_spot = nodes[19:22, 19:22]
    assert_allclose(around_the_spot, speed, rtol=1e-6)


@pytest.mark.parametrize(
    ("device", "scenarios"),
    [
        (Device.CPU, 1),
        (Device.PARALLEL, 2),
    ],
)
def test_a_blow_up_is_an_error(device: Device, scenarios: int) -> None:
    """A substep beyond the viscous limit ends in an error that says where, when and
    which bound.
    """
    state = scenario(
        NO_SLIP,
        seed=6,
        speed=0.4,
        walls=ALL_LIDS,
        viscosity=1.0,
    )
    states = [state] * scenarios
    solver = loaded(NO_SLIP, states, device=device)
    with pytest.raises(WorkFailedError) as caught:
        solver.advance(400)
    assert caught.value.where == "scenario 0, substeps 0 to 400"
    assert "CFL" in str(caught.value)
    low, high = box(NO_SLIP)
    position = solver.position()
    assert low < position.min()
    assert position.max() < high


def test_a_blow_up_names_the_scenario_and_leaves_the_others() -> None:
    """Of two scenarios only the second is not finite; the solver can be loaded
    again.
    """
    first = scenario(NO_SLIP, seed=7, speed=0.2)
    second = scenario(NO_SLIP, seed=8, speed=0.2)
    infinite = dataclasses.replace(second, viscosity=np.inf)
    wild = [first, infinite]
    solver = loaded(NO_SLIP, wild, device=Device.PARALLEL)
    with pytest.raises(WorkFailedError) as caught:
        solver.advance(20)
    assert caught.value.where == "scenario 1, substeps 0 to 20"
    is_finite = [health.finite for health in solver.health()]
    assert is_finite == [True, False]
    alone = after(NO_SLIP, [first], 20)
    first_position = solver.position()[:1]
    np.testing.assert_array_equal(first_position, alone["position"])
    solver.load([first, second])
    solver.advance(20)
    for health in solver.health():
        assert health.finite


def test_states_outside_the_bounds_are_refused() -> None:
    """Too fast, of another size, or with walls that cannot move: refused before the
    first substep.
    """
    state = scenario(NO_SLIP)
    walls = np.zeros((4, 2))
    walls[0, 0] = 0.1
    high_speed = state.velocity + 100.0
    fast = dataclasses.replace(state, velocity=high_speed)
    with pytest.raises(WorkFailedError) as caught:
        loaded(NO_SLIP, [fast])
    assert caught.value.where == "scenario 0"
    fewer_positions = state.position[1:]
    one_less = dataclasses.replace(state, position=fewer_positions)
    with pytest.raises(UsageError) as caught:
        loaded(NO_SLIP, [one_less])
    assert caught.value.where == "scenario 0"
    for odd in (
        {"velocity": state.velocity[1:]},
        {"affine": state.velocity},
        {"material": None},
        {"material": state.material + 9},
        {"material": state.material.astype(float)},
        {"position": state.position.astype(str)},
        {"position": state.position + 5.0},
        {"area": 0.0},
        {"area": None},
    ):
        odd_state = dataclasses.replace(state, **odd)
        with pytest.raises(UsageError):
            loaded(NO_SLIP, [odd_state])
    across = dataclasses.replace(state, wall_velocity=walls)
    sliding = scenario(FREE_SLIP, walls=(0, 0, 0, 0.1))
    for constants, moving in ((NO_SLIP, across), (FREE_SLIP, sliding)):
        with pytest.raises(UsageError) as caught:
            loaded(constants, [moving])
        assert str(caught.value.where).startswith("scenario 0, wall_velocity")
