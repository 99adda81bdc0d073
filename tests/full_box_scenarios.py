"""Small scenarios of full boxes, and their solver beside that in NumPy."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from obstacle_flows import regular_places
from reference_full_box import ReferenceFullBox

from lagbench.data.box import Box
from lagbench.generators.draws import quantise
from lagbench.generators.full_box import FullBox
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.split import InitialState

Arrays = dict[str, NDArray[np.float32]]

# x repeats itself, y and z end at walls; not as long along every axis
MIXED_BOX = Box.from_bounds(
    [(0.0, 1.0), (0.125, 0.875), (0.0, 0.75)],
    periodic=[True, False, False],
)
MIXED_COUNTS = (16, 12, 12)  # particles along each axis: eight in a cell


def constants(
    box: Box,
    counts: Sequence[int],
    *,
    no_slip: bool = True,
    **changes: float,
) -> FullBoxParameters:
    """Return the constants of a small box.

    Args:
        box: the box.
        counts: particles along each axis.
        no_slip: whether its walls hold the fluid.
        changes: constants that differ from those of the other boxes.
    """
    values: dict[str, Any] = {
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
        no_slip=no_slip,
        particles=int(np.prod(counts)),
        **values,
    )


def stirred(
    box: Box,
    counts: Sequence[int],
    *,
    drift: float = 0.0,
    share: float = 1.0,
    wall_velocity: NDArray[np.float64] | None = None,
    body_force: NDArray[np.float64] | None = None,
) -> InitialState:
    """Return a box of fluid with random velocities; a particle lies in each of two
    opposite corners.

    Args:
        box: the box.
        counts: particles along each axis.
        drift: mean velocity along every axis [length/s].
        share: volume of the fluid at rest density, over that of the box [1].
        wall_velocity: that of an initial state; without it walls stand still.
        body_force: that of an initial state.
    """
    rng = np.random.default_rng(7)
    dimension = box.dimension
    lattice = regular_places(box, counts)
    spacing = box.lengths / np.array(counts)
    jitter = 0.5 * (rng.random(lattice.shape) - 0.5)
    position = quantise(lattice + spacing * jitter)
    position[0] = box.low
    # the last number before the end; in cells it is rounded to the end
    upper_corner = np.array(box.high, np.float32)
    position[1] = np.nextafter(upper_corner, np.float32(0.0))
    velocity = drift + 0.5 * (rng.random(lattice.shape) - 0.5)
    slope = rng.random((len(lattice), dimension, dimension)) - 0.5
    if wall_velocity is None:
        wall_velocity = np.zeros((2 * dimension, dimension))
    return InitialState(
        position=position,
        velocity=quantise(velocity),
        affine=quantise(slope),
        material=np.zeros(len(lattice), np.int8),
        area=share * box.volume,
        viscosity=1e-3,
        wall_velocity=wall_velocity,
        body_force=body_force,
    )


def mixed_state() -> InitialState:
    """Return a fluid in the mixed box: two walls move, a force acts."""
    walls = np.zeros((6, 3))
    walls[3] = (0.2, 0.0, -0.1)  # top
    walls[4] = (0.0, 0.15, 0.0)  # front
    force = np.zeros((1, 2, 3))
    force[0, 0] = (0.05, 0.0, 0.02)
    force[0, 1] = (-0.05, 0.0, 0.0)
    return stirred(MIXED_BOX, MIXED_COUNTS, wall_velocity=walls, body_force=force)


def advanced(solver: FullBox, state: InitialState, substeps: int) -> Arrays:
    """Return positions, velocities and J after some substeps."""
    solver.load([state])
    solver.advance(substeps)
    return arrays(solver)


def arrays(solver: FullBox) -> Arrays:
    """Return positions, velocities and J of the only scenario."""
    return {
        "position": solver.position()[0],
        "velocity": solver.velocity()[0],
        "jacobian": solver.jacobian()[0],
    }


def assert_numpy_gives_the_same_bits(
    solver: FullBox, state: InitialState, substeps: int
) -> None:
    """Compare a solver with that in NumPy, and again with shuffled particles.

    Compared are the first two substeps, one by one, and the last.
    """
    solver.load([state])
    reference = ReferenceFullBox(solver.parameters, state)
    fluid = slice(0, len(state.position))
    for count in (1, 1, substeps - 2):
        solver.advance(count)
        reference.step(count)
        expected = {
            "position": reference.x[fluid],
            "velocity": reference.v[fluid],
            "jacobian": reference.j[fluid],
        }
        for name, values in arrays(solver).items():
            assert expected[name].dtype == np.float32
            np.testing.assert_array_equal(values, expected[name], err_msg=name)
    change = expected["velocity"] - state.velocity
    assert np.abs(change).max() > 0.05

    rng = np.random.default_rng(3)
    order = rng.permutation(len(state.position))
    shuffled_arrays = advanced(solver, shuffled(state, order), substeps)
    for name, values in shuffled_arrays.items():
        np.testing.assert_array_equal(values, expected[name][order], err_msg=name)


def shuffled(state: InitialState, order: NDArray[np.int64]) -> InitialState:
    """Return a state with particles in another order, those of an obstacle too."""
    obstacle = state.obstacle
    if obstacle is not None:
        reversed_position = obstacle.position[::-1]
        obstacle = dataclasses.replace(obstacle, position=reversed_position)
    return dataclasses.replace(
        state,
        position=state.position[order],
        velocity=state.velocity[order],
        affine=state.affine[order],
        obstacle=obstacle,
    )
