"""The solver of full boxes around a ball, in three dimensions."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import pytest
from full_box_scenarios import assert_numpy_gives_the_same_bits
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from obstacle_flows import constants_around, regular_places

from lagbench.data.box import Box
from lagbench.generators.draws import quantise
from lagbench.generators.full_box import FullBox
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.obstacle import Obstacle, is_inside
from lagbench.generators.split import InitialState

Array = NDArray[np.float64]

pytestmark = pytest.mark.slow

DUCT = Box.from_bounds(
    [(0.0, 1.0), (0.25, 0.75), (0.25, 0.75)], periodic=[True, False, False]
)
GRID = 16
COUNTS = (32, 16, 16)  # particles along each axis: eight in a cell
CENTRE = (0.3, 0.5, 0.5)
RADIUS = 0.13
SPEED = 0.3  # of the stream [length/s]


class Run(NamedTuple):
    """What a run of the stream left behind."""

    nearest: float  # least distance of a particle from the middle of the ball [length]
    position: Array  # [length], shape [particle, axis]
    nodal: Array  # velocity at the nodes [length/s], shape [node along axes, axis]


def duct_state(*, stir: float) -> InitialState:
    """Return a stream around a ball, with random velocities of some width."""
    rng = np.random.default_rng(12)
    lattice = regular_places(DUCT, COUNTS)
    inside = is_inside(lattice, CENTRE, RADIUS)
    fluid = lattice[~inside]
    velocity = stir * (rng.random(fluid.shape) - 0.5)
    velocity[:, 0] += SPEED
    return InitialState(
        position=quantise(fluid),
        velocity=quantise(velocity),
        affine=np.zeros((len(fluid), 3, 3)),
        material=np.zeros(len(fluid), np.int8),
        area=DUCT.volume * len(fluid) / len(lattice),
        viscosity=1e-3,
        obstacle=Obstacle(centre=CENTRE, radius=RADIUS, position=lattice[inside]),
        stream=np.array([SPEED, 0.0, 0.0]),
        wall_velocity=np.zeros((6, 3)),
    )


def constants() -> FullBoxParameters:
    """Return the constants of the duct."""
    return constants_around(duct_state(stir=0.0), DUCT, GRID)


@functools.cache
def serial_solver() -> FullBox:
    """Return the solver of one scenario; its kernels take long to compile."""
    return FullBox(constants())


@functools.cache
def stream_past_the_ball() -> Run:
    """Return what is left after the stream has passed the ball twice."""
    solver = serial_solver()
    solver.load([duct_state(stir=0.0)])
    nearest = np.inf
    for _ in range(18):
        solver.advance(100)
        position = solver.position()[0].astype(np.float64)
        way = position - np.array(CENTRE)
        nearest = min(nearest, float(np.linalg.norm(way, axis=1).min()))
    nodal = solver.grid_velocity()[0].astype(np.float64)
    return Run(nearest, position, nodal)


def test_numpy_gives_the_same_bits() -> None:
    """An independent float32 implementation agrees in every bit over 20 substeps of a
    stirred stream, with the particles in any order.
    """
    assert_numpy_gives_the_same_bits(serial_solver(), duct_state(stir=0.2), 20)


def test_no_particle_enters_the_ball_and_nodes_inside_are_at_rest() -> None:
    """The least distance of a particle stays above the radius."""
    run = stream_past_the_ball()
    assert run.nearest > RADIUS
    places_of_nodes = node_places()
    distance = np.linalg.norm(places_of_nodes - np.array(CENTRE), axis=-1)
    speed = np.abs(run.nodal).max(axis=-1)
    assert speed[distance < RADIUS].max() == 0.0
    beside = (distance > RADIUS) & (np.abs(places_of_nodes[..., 0] - 0.3) < 0.05)
    assert run.nodal[beside][:, 0].max() > SPEED


def test_the_flow_is_that_of_a_round_body() -> None:
    """The duct and the ball look the same with y and z exchanged, and so does the flow:
    the start was exchanged into itself.
    """
    run = stream_past_the_ball()
    exchanged = run.nodal.swapaxes(1, 2)[..., [0, 2, 1]]
    assert_allclose(run.nodal, exchanged, rtol=0, atol=0.02 * SPEED)


def node_places() -> Array:
    """Return where the nodes lie [length], shape [node along axes, axis]."""
    axes = []
    for low, count in zip(DUCT.low, (GRID, GRID // 2, GRID // 2), strict=True):
        axes.append(low + (np.arange(count) + 0.5) / GRID)
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
