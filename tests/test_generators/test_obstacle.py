"""The solver of full boxes around an obstacle, with a fringe that damps the wake."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from full_box_scenarios import advanced, assert_numpy_gives_the_same_bits
from obstacle_flows import constants_around, regular_places

from lagbench.data.box import Box
from lagbench.errors import UsageError
from lagbench.generators.draws import quantise
from lagbench.generators.full_box import FullBox
from lagbench.generators.full_box_parameters import FullBoxParameters
from lagbench.generators.obstacle import Obstacle, is_inside
from lagbench.generators.split import Device, InitialState

# Each module of kernels takes seconds to compile.
pytestmark = pytest.mark.slow

CHANNEL = Box.from_bounds([(0.0, 1.0), (0.25, 0.75)], periodic=[True, False])
GRID = 16
COUNTS = (32, 16)  # particles along each axis: four in a cell
RADIUS = 0.13
SPEED = 0.3  # of the stream [length/s]


def channel_state(centre: tuple[float, float] = (0.3, 0.5)) -> InitialState:
    """Return a stirred stream around a disc."""
    rng = np.random.default_rng(11)
    lattice = regular_places(CHANNEL, COUNTS)
    inside = is_inside(lattice, centre, RADIUS)
    fluid = lattice[~inside]
    jitter = 0.004 * (rng.random(fluid.shape) - 0.5)
    velocity = 0.2 * (rng.random(fluid.shape) - 0.5)
    velocity[:, 0] += SPEED
    return InitialState(
        position=quantise(fluid + jitter),
        velocity=quantise(velocity),
        affine=np.zeros((len(fluid), 2, 2)),
        material=np.zeros(len(fluid), np.int8),
        area=CHANNEL.volume * len(fluid) / len(lattice),
        viscosity=1e-3,
        obstacle=Obstacle(centre=centre, radius=RADIUS, position=lattice[inside]),
        stream=np.array([SPEED, 0.0]),
    )


def constants() -> FullBoxParameters:
    """Return the constants of the channel."""
    return constants_around(channel_state(), CHANNEL, GRID)


@functools.cache
def serial_solver() -> FullBox:
    """Return the solver of one scenario; its kernels take seconds to compile."""
    return FullBox(constants())


def test_numpy_gives_the_same_bits() -> None:
    """An independent float32 implementation agrees in every bit over 40 substeps, with
    the particles in any order.
    """
    assert_numpy_gives_the_same_bits(serial_solver(), channel_state(), 40)


def test_scenarios_side_by_side_have_the_bits_of_each_alone() -> None:
    """Two discs at different places, in parallel threads."""
    states = [channel_state(), channel_state((0.3 + 1.0 / 32.0, 0.5 - 1.0 / 32.0))]
    solver = FullBox(constants(), device=Device.PARALLEL, scenarios=2, threads=2)
    solver.load(states)
    solver.advance(25)
    for index, state in enumerate(states):
        alone = advanced(serial_solver(), state, 25)
        np.testing.assert_array_equal(solver.position()[index], alone["position"])
        np.testing.assert_array_equal(solver.velocity()[index], alone["velocity"])
        np.testing.assert_array_equal(solver.jacobian()[index], alone["jacobian"])
    healths = solver.health()
    assert [health.finite for health in healths] == [True, True]
    solver.close()
    serial_solver.cache_clear()


def test_no_particle_enters_the_disc() -> None:
    """After the stream has passed the disc several times, all particles lie outside,
    and the fluid in front of it stands still.
    """
    state = channel_state()
    assert state.obstacle is not None
    solver = serial_solver()
    solver.load([state])
    nearest = np.inf
    for _ in range(20):
        solver.advance(100)
        way = solver.position()[0].astype(np.float64) - state.obstacle.centre
        nearest = min(nearest, float(np.linalg.norm(way, axis=1).min()))
    assert nearest > RADIUS
    nodal = solver.grid_velocity()[0]
    column = (np.arange(GRID) + 0.5) / GRID
    row = 0.25 + (np.arange(GRID // 2) + 0.5) / GRID
    x, y = np.meshgrid(column, row, indexing="ij")
    distance = np.hypot(x - 0.3, y - 0.5)
    assert np.abs(nodal[distance < RADIUS]).max() == 0.0
    # free stream between the disc and the walls
    assert nodal[..., 0].max() > SPEED


def test_the_fringe_damps_the_wake_and_keeps_the_stream() -> None:
    """Behind the fringe the velocity across the stream is small, and the speed is that
    of the stream within 10 %.
    """
    solver = serial_solver()
    solver.load([channel_state()])
    solver.advance(1500)
    across = []
    along = []
    for _ in range(10):
        solver.advance(100)
        nodal = solver.grid_velocity()[0].astype(np.float64)
        across.append(np.abs(nodal[..., 1]).max(axis=1))
        along.append(nodal[..., 0].mean(axis=1))
    height = np.mean(across, axis=0)
    behind_disc = height[8:11].max()
    fringe_middle = height[14]
    assert behind_disc > 0.05
    assert fringe_middle < 0.3 * behind_disc
    assert np.mean(along) == pytest.approx(SPEED, rel=0.1)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"obstacle": None}, "obstacle"),
        ({"stream": None}, "stream"),
        ({"stream": np.zeros(3)}, "stream"),
        ({"stream": [SPEED, 0.0, 0.0]}, "stream"),
        ({"stream": np.array(["fast", "slow"])}, "stream"),
    ],
)
def test_what_does_not_fit_the_solver_is_refused(
    change: dict[str, object], where: str
) -> None:
    """The obstacle has as many particles as the solver has room for; a fringe has a
    stream.
    """
    state = dataclasses.replace(channel_state(), **change)  # type: ignore[arg-type]
    with pytest.raises(UsageError) as caught:
        serial_solver().load([state])
    assert where in str(caught.value.where)


def misplaced(**changes: object) -> InitialState:
    """Return the channel with another obstacle of as many particles."""
    state = channel_state()
    assert state.obstacle is not None
    obstacle = dataclasses.replace(state.obstacle, **changes)  # type: ignore[arg-type]
    return dataclasses.replace(state, obstacle=obstacle)


@pytest.mark.parametrize(
    "changes",
    [{"centre": (0.05, 0.25)}, {"radius": 0.3}, {"radius": 0.01}],
)
def test_an_obstacle_lies_within_the_box(changes: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        serial_solver().load([misplaced(**changes)])
