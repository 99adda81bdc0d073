"""The closed-box solver's physics on small boxes, and what it says when it fails."""

from __future__ import annotations

import dataclasses

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
    around_the_spot = nodes[nodes.any(axis=-1)]
    assert len(around_the_spot) == 9
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
