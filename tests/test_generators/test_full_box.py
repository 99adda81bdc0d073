"""The solver of full boxes: two or three axes, walled or periodic."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from box_scenarios import ALL_LIDS, NO_SLIP, after, box, scenario
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from reference_full_box import ReferenceFullBox

from lagbench.data.box import Box
from lagbench.errors import UsageError
from lagbench.generators.draws import quantise
from lagbench.generators.full_box import FullBox
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.split import InitialState

# x repeats itself, y and z end at walls; not as long along every axis
MIXED_BOX = Box.from_bounds(
    [(0.0, 1.0), (0.125, 0.875), (0.0, 0.75)],
    periodic=[True, False, False],
)
COUNTS = (16, 12, 12)  # particles along each axis: eight in a cell


def constants(
    box: Box,
    particles: int,
    **changes: float,
) -> FullBoxParameters:
    """Return the constants of a small box."""
    values: dict[str, float] = {
        "grid": 8,
        "dt": 8e-3,
        "density": 1e-4,
        "modulus": 5e-4,
        "velocity_relaxation": 0.01,
        "jacobian_relaxation": 0.1,
        "density_coupling": 0.01,
        "shift": 0.01,
        **changes,
    }
    return FullBoxParameters(
        box=box,
        no_slip=True,
        particles=particles,
        **values,
    )


PARTICLES = int(np.prod(COUNTS))
SOLID = constants(MIXED_BOX, PARTICLES, force_layers=2)


def solid_state() -> InitialState:
    """Return a stirred fluid in the mixed box: two walls move, a force acts."""
    rng = np.random.default_rng(7)
    cell = np.indices(COUNTS).reshape(3, -1).T
    share = rng.random(cell.shape)
    jitter = 0.5 * (share - 0.5)
    low = np.array(MIXED_BOX.low)
    place = (cell + 0.5 + jitter) / COUNTS
    position = low + MIXED_BOX.lengths * place
    velocity = 0.2 * (rng.random(cell.shape) - 0.5)
    walls = np.zeros((6, 3))
    walls[3] = (0.2, 0.0, -0.1)  # top
    walls[4] = (0.0, 0.15, 0.0)  # front
    force = np.zeros((1, 2, 3))
    force[0, 0] = (0.05, 0.0, 0.02)
    force[0, 1] = (-0.05, 0.0, 0.0)
    return InitialState(
        position=quantise(position),
        velocity=quantise(velocity),
        affine=np.zeros((PARTICLES, 3, 3)),
        material=np.zeros(PARTICLES, np.int8),
        area=MIXED_BOX.volume,
        viscosity=1e-3,
        wall_velocity=walls,
        body_force=force,
    )


@functools.cache
def solid_solver() -> FullBox:
    """Return a solver of the mixed box; its kernels take seconds to compile."""
    return FullBox(SOLID)


Arrays = dict[str, NDArray[np.float32]]


def advanced(state: InitialState, substeps: int) -> Arrays:
    """Return position, velocity and J in the solid box after some substeps."""
    solver = solid_solver()
    solver.load([state])
    solver.advance(substeps)
    return {
        "position": solver.position()[0],
        "velocity": solver.velocity()[0],
        "jacobian": solver.jacobian()[0],
    }


@pytest.mark.slow
def test_a_square_with_four_walls_has_the_bits_of_the_fast_solver() -> None:
    """Both formulations agree in every bit while four walls move."""
    low, high = box(NO_SLIP)
    values = dataclasses.asdict(NO_SLIP)
    del values["wall"]
    side = (low, high)
    square = Box.from_bounds([side, side])
    state = scenario(
        NO_SLIP,
        seed=1,
        speed=0.5,
        walls=ALL_LIDS,
        frames=10,
    )
    square_constants = FullBoxParameters(box=square, **values)
    solver = FullBox(square_constants)
    solver.load([state])
    solver.advance(60)
    expected = after(NO_SLIP, [state], 60)
    np.testing.assert_array_equal(solver.position(), expected["position"])
    np.testing.assert_array_equal(solver.velocity(), expected["velocity"])
    np.testing.assert_array_equal(solver.jacobian(), expected["jacobian"])
    solver.close()


@pytest.mark.slow
def test_numpy_agrees_in_three_dimensions_and_in_any_order() -> None:
    """An independent float64 solver agrees; a permutation of particles has the same
    bits.
    """
    state = solid_state()
    result = advanced(state, 30)
    reference = ReferenceFullBox(SOLID, state)
    reference.step(30)
    way = MIXED_BOX.displacement(reference.x, result["position"])
    assert np.abs(way).max() < 2e-6
    change = np.abs(reference.v - state.velocity)
    assert change.max() > 0.05
    velocity = result["velocity"]
    jacobian = result["jacobian"]
    assert_allclose(velocity, reference.v, rtol=0, atol=5e-6)
    assert_allclose(jacobian, reference.j, rtol=0, atol=2e-5)

    rng = np.random.default_rng(3)
    order = rng.permutation(len(state.position))
    shuffled = dataclasses.replace(
        state,
        position=state.position[order],
        velocity=state.velocity[order],
    )
    shuffled_result = advanced(shuffled, 30)
    for name, values in shuffled_result.items():
        expected = result[name][order]
        np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize(
    "wall",
    [0, 2],
    ids=["periodic axis", "along its normal"],
)
def test_walls_that_cannot_move_are_refused(wall: int) -> None:
    """A wall moves along itself only, and a periodic axis has none."""
    walls = np.zeros((6, 3))
    walls[wall, 1] = 0.1
    state = dataclasses.replace(solid_state(), wall_velocity=walls)
    with pytest.raises(UsageError) as caught:
        solid_solver().load([state])
    assert "wall_velocity" in str(caught.value.where)
