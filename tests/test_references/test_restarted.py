"""The restarted simulator against closed forms and the simulation that it restarts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from lagbench.data.registry import Size, load
from lagbench.generators.batch import draw_initial_state
from lagbench.generators.constants import solver_constants
from lagbench.generators.solver import build
from lagbench.references.predictor import Given, fitted_velocity
from lagbench.references.restarted import local_fit, predict, resolve

Floats = NDArray[np.float64]

DATA_SETS = [
    (split, size) for split in load().splits for size in load().split(split).sizes
]


def given_of(size: Size, position: Floats, **changes: object) -> Given:
    """Return what given frames of liquid say, at rest walls."""
    frames = size.task.input_frames + size.task.horizon
    given = Given(
        size=size,
        root=Path(),
        position=position,
        material=np.zeros(position.shape[1], np.int8),
        walls=np.zeros((frames, 2 * size.dimension, size.dimension)),
        area=size.box.volume,
        parameters={"viscosity": 0.0},
    )
    return replace(given, **changes)


@pytest.mark.parametrize(("split", "name"), DATA_SETS)
def test_at_refinement_1_it_is_the_solver_of_the_data(split: str, name: str) -> None:
    """Nothing is scaled, and all constants are the solver's own."""
    size = load().size(split, name)
    resolution = resolve(size, 1.0)
    assert resolution.scale == 1.0
    own = solver_constants(size)
    for constant in ("grid", "dt", "density"):
        assert getattr(resolution.constants, constant) == getattr(own, constant)
    corner = np.asarray(size.box.low)
    assert_allclose(resolution.into_solver(corner), corner, atol=1e-15)


@pytest.mark.parametrize(("split", "name"), DATA_SETS)
@pytest.mark.parametrize("refinement", [2.0, 2.0 / 3.0, 0.5, 0.25])
def test_walls_lie_where_the_solver_wants_them(
    split: str, name: str, refinement: float
) -> None:
    """On nodes on a free surface, a whole number of cells apart in a full box."""
    size = load().size(split, name)
    resolution = resolve(size, refinement)
    ends = np.array([size.box.low, size.box.high])
    cells = resolution.into_solver(ends) * resolution.constants.grid
    assert_allclose(np.diff(cells, axis=0)[0], resolution.cells)
    if not size.is_full_box:
        assert_allclose(cells, np.rint(cells), atol=1e-9)
    assert_allclose(resolution.from_solver(resolution.into_solver(ends)), ends)


def test_a_polynomial_in_time_is_found_and_so_is_a_fall() -> None:
    """Velocities are those of the closed forms, in every given frame."""
    cavity = load().size("cavity", "tiny")
    time = np.arange(6) * cavity.frame_interval
    place = 0.3 + 0.1 * time + 0.2 * time**3
    given = given_of(cavity, np.tile(place[:, None, None], (1, 5, 2)))
    for frame in range(6):
        expected = 0.1 + 0.6 * time[frame] ** 2
        assert_allclose(fitted_velocity(given, frame), expected)

    fluid = load().size("fluid", "tiny")
    step = fluid.frame_interval
    gravity = np.array([0.0, -fluid.value("gravity")])
    speed = np.array([0.3, 0.1])
    moved = speed * step + 0.5 * gravity * step**2
    falling = given_of(fluid, np.array([[[0.5, 0.5]], [0.5 + moved]]))
    assert_allclose(fitted_velocity(falling, 0), [speed])
    assert_allclose(fitted_velocity(falling, 1), [speed + gravity * step])


def test_a_linear_field_is_fitted_exactly() -> None:
    """Its value and its gradient, at the particles and between them."""
    size = load().size("cavity", "tiny")
    rng = np.random.default_rng(0)
    position = rng.uniform(0.1, 0.9, (200, 2))
    gradient = np.array([[0.3, -1.0], [2.0, -0.3]])
    velocity = 0.1 + position @ gradient.T
    at = rng.uniform(0.2, 0.8, (50, 2))
    given = given_of(size, position[None])
    value, slope = local_fit(given, position, velocity, at=at)
    assert_allclose(value, 0.1 + at @ gradient.T)
    assert_allclose(slope, np.broadcast_to(gradient, slope.shape), atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("refinement", [2.0, 1.0, 0.5])
def test_a_block_in_flight_keeps_its_parabola(refinement: float) -> None:
    """All particles fall, those that the solver has and those that it has not."""
    size = load().size("fluid", "mini")
    axis = np.arange(25) / 120
    block = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    first = block + np.array([0.4, 0.6])
    fall = np.array([0.0, -size.value("gravity") * size.frame_interval**2])
    frames = np.stack([first, first + 0.5 * fall])
    given = given_of(size, frames, area=(25 / 120) ** 2)
    positions = predict(given, refinement)
    for k, position in zip(range(2, 11), positions, strict=False):
        way = position - first
        assert_allclose(way.mean(axis=0), 0.5 * k**2 * fall, atol=1e-3)


@pytest.mark.slow
def test_the_simulation_goes_on_as_it_would_have() -> None:
    """A restart of tiny data is near the simulation, a frozen flow is not."""
    size = load().size("cavity", "tiny")
    state = draw_initial_state(size, 3)
    solver = build(solver_constants(size), threads=1)
    solver.load([state])
    solver.advance(state.start_frame * size.substeps_per_frame)
    given_frames = size.task.input_frames
    frames = []
    for _ in range(given_frames + 10):
        frames.append(solver.position()[0].astype(np.float64))
        solver.advance(size.substeps_per_frame)
    truth = np.stack(frames)
    count = size.task.input_frames + size.task.horizon
    walls = []
    for frame in range(state.start_frame, state.start_frame + count):
        walls.append(state.walls_towards(frame) * size.frame_interval)
    given = given_of(
        size,
        truth[:given_frames],
        area=state.area,
        walls=np.stack(walls),
        parameters={"viscosity": state.viscosity},
    )
    *_, last = (p for p, _ in zip(predict(given, 1.0), range(10), strict=False))
    moved = np.abs(truth[-1] - given.last).max()
    assert np.abs(last - truth[-1]).max() < 0.05 * moved
