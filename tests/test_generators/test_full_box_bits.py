"""The solver of full boxes against an independent NumPy implementation, bit by bit.

The boxes with an obstacle stand in ``test_obstacle.py`` and ``test_ball.py``.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
from full_box_scenarios import (
    MIXED_BOX,
    MIXED_COUNTS,
    assert_numpy_gives_the_same_bits,
    constants,
    mixed_state,
    stirred,
)
from numpy.typing import NDArray

from lagbench.data.box import Box
from lagbench.generators.full_box import FullBox
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.split import InitialState

# Each module of kernels takes seconds to compile.
pytestmark = pytest.mark.slow

# The solver has 12 cells across a length of 1 here: 1/12 is no number of float32.
SQUARE = Box.from_bounds([(0.0, 1.0), (0.0, 2.0 / 3.0)], periodic=[True, True])
SQUARE_COUNTS = (24, 16)  # particles along each axis: four in a cell
CHANNEL = Box.from_bounds([(0.0, 1.0), (0.125, 0.875)], periodic=[True, False])
CHANNEL_COUNTS = (16, 12)
PERIODIC_CUBE = Box.from_bounds(
    [(0.0, 0.5), (0.25, 0.75), (0.5, 1.0)],
    periodic=[True, True, True],
)
WALLED_CUBE = Box.from_bounds([(0.125, 0.875), (0.125, 0.875), (0.125, 0.875)])
CUBE_COUNTS = (12, 12, 12)  # eight in a cell
FRAMES = 3  # of a program of walls or forces
DRIVEN_SQUARE = constants(
    SQUARE,
    SQUARE_COUNTS,
    grid=12,
    shift=2.0,  # so large that it reaches its bound
    force_layers=2,
    substeps_per_frame=7,
)
NO_FORCE = np.zeros((1, 2, 2))

# Kernels take seconds to compile; two scenarios of the square share theirs.
compiled = functools.cache(FullBox)


def wall_program(box: Box) -> NDArray[np.float64]:
    """Return a program in which all walls slide along both of their axes [length/s].

    The shape is [frame, wall, axis].
    """
    rng = np.random.default_rng(5)
    dimension = box.dimension
    program = 0.6 * (rng.random((FRAMES, 2 * dimension, dimension)) - 0.5)
    for axis in range(dimension):
        both_walls = slice(2 * axis, 2 * axis + 2)
        program[:, both_walls, axis] = 0.0
        if box.periodic[axis]:
            program[:, both_walls] = 0.0
    return program


def force_program() -> NDArray[np.float64]:
    """Return a program that drives two halves apart, shape [frame, layer, axis]."""
    program = np.zeros((FRAMES, 2, 2))
    program[:, 0, 0] = (0.1, 0.3, -0.2)
    program[:, 1, 0] = -program[:, 0, 0]
    return program


@pytest.mark.parametrize(
    ("parameters", "state"),
    [
        pytest.param(
            DRIVEN_SQUARE,
            stirred(SQUARE, SQUARE_COUNTS, drift=0.3, share=0.5, body_force=NO_FORCE),
            id="periodic square, half full",
        ),
        pytest.param(
            DRIVEN_SQUARE,
            stirred(SQUARE, SQUARE_COUNTS, body_force=force_program()),
            id="periodic square, driven halves",
        ),
        pytest.param(
            constants(CHANNEL, CHANNEL_COUNTS, substeps_per_frame=7),
            stirred(CHANNEL, CHANNEL_COUNTS, wall_velocity=wall_program(CHANNEL)),
            id="channel, two programs",
        ),
        pytest.param(
            constants(PERIODIC_CUBE, CUBE_COUNTS, grid=12),
            stirred(PERIODIC_CUBE, CUBE_COUNTS, drift=-0.3),
            id="periodic cube",
        ),
        pytest.param(
            constants(WALLED_CUBE, CUBE_COUNTS, substeps_per_frame=7),
            stirred(WALLED_CUBE, CUBE_COUNTS, wall_velocity=wall_program(WALLED_CUBE)),
            id="cube, six programs",
        ),
        pytest.param(
            constants(MIXED_BOX, MIXED_COUNTS, force_layers=2),
            mixed_state(),
            id="one periodic axis of three, walls and force",
        ),
    ],
)
def test_numpy_gives_the_same_bits(
    parameters: FullBoxParameters, state: InitialState
) -> None:
    """An independent float32 implementation agrees in every bit over 40 substeps, with
    the particles in any order.
    """
    assert_numpy_gives_the_same_bits(compiled(parameters), state, 40)
