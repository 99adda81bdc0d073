"""The projection solver as a predictor, against a flow in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from lagbench.data.registry import load
from lagbench.references import REFERENCES, Given
from lagbench.references.projection import cell_counts

SIZE = load().size("curl-noise", "mini")
LOW, HIGH = SIZE.bounds[0]
WAVE = np.pi / (HIGH - LOW)
SPEED = 0.05
VISCOSITY = 7.9e-5


Array = NDArray[np.float64]


def cell_flow(time: float, position: Array) -> Array:
    """Return one slowly decaying roll between free-slip walls [length/s]."""
    x, y = WAVE * (position - LOW).T
    rate = 2.0 * VISCOSITY * WAVE**2
    amplitude = SPEED * np.exp(-rate * time)
    u = np.sin(x) * np.cos(y)
    v = -np.cos(x) * np.sin(y)
    return np.asarray(amplitude * np.stack([u, v], axis=1))


def root_mean_square(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def exact_paths(start: Array, frames: int) -> Array:
    """Return where SciPy's integrator takes particles, shape [frame, particle, 2]."""
    times = np.arange(frames) * SIZE.frame_interval

    def rate(time: float, state: Array) -> Array:
        position = state.reshape(-1, 2)
        return cell_flow(time, position).ravel()

    solution = solve_ivp(
        rate,
        (0.0, times[-1]),
        start.ravel(),
        t_eval=times,
        rtol=1e-9,
        atol=1e-11,
    )
    return solution.y.T.reshape(frames, -1, 2)


def given_roll() -> tuple[Given, Array]:
    """Return the first frames of the roll, and its future."""
    rng = np.random.default_rng(0)
    shape = (SIZE.particles, 2)
    start = rng.uniform(LOW, HIGH, shape)
    task = SIZE.task
    frames = task.input_frames + task.horizon
    paths = exact_paths(start, frames)
    given = Given(
        size=SIZE,
        root=Path(),
        position=paths[: task.input_frames],
        material=np.zeros(len(start), np.int8),
        walls=np.zeros((frames, 4, 2)),
        area=(HIGH - LOW) ** 2,
        parameters={},
    )
    return given, paths[task.input_frames :]


def test_particles_of_a_roll_go_where_the_closed_form_takes_them() -> None:
    """Finer grids come nearer; none is off by more than a few percent of the way."""
    given, future = given_roll()
    way = root_mean_square(future[-1] - given.last)
    errors = []
    for name in ("projection", "projection-2x"):
        positions = REFERENCES[name].predict(given)
        predicted = np.stack(list(positions))
        assert predicted.dtype == np.float32
        assert predicted.shape == future.shape
        error = predicted[-1] - future[-1]
        errors.append(root_mean_square(error))
    assert errors[0] < 0.05 * way
    assert errors[1] < 0.03 * way


def test_the_viscosity_is_the_scenario_s_or_else_the_data_set_s() -> None:
    given, _ = given_roll()
    tiny = load().size("curl-noise", "tiny")
    assert replace(given, size=tiny).viscosity == tiny.task.effective_viscosity
    stated = replace(given, parameters={"viscosity": "0.001"})
    assert stated.viscosity == 0.001


def test_cells_follow_the_score_grid_inside_the_walls() -> None:
    given, _ = given_roll()
    assert cell_counts(given, 1) == (19, 19)
    assert cell_counts(given, 3) == (57, 57)
