"""The projection solver as a predictor, against a flow in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from lagbench.data.registry import load
from lagbench.references import REFERENCES, Given
from lagbench.references.projection import cell_counts

SIZE = load().size("curl-noise", "mini")
LOW, HIGH = SIZE.bounds[0]
WAVE = np.pi / (HIGH - LOW)
SPEED = 0.05
VISCOSITY = 7.9e-5


def cell_flow(time: float, position: np.ndarray) -> np.ndarray:
    """Return one slowly decaying roll between free-slip walls [length/s]."""
    x = WAVE * (position[:, 0] - LOW)
    y = WAVE * (position[:, 1] - LOW)
    amplitude = SPEED * np.exp(-2.0 * VISCOSITY * WAVE**2 * time)
    roll = np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y)], 1)
    return np.asarray(amplitude * roll)


def exact_paths(start: np.ndarray, frames: int) -> np.ndarray:
    """Return where SciPy's integrator takes particles, shape [frame, particle, 2]."""
    times = np.arange(frames) * SIZE.frame_interval

    def rate(time: float, state: np.ndarray) -> np.ndarray:
        return cell_flow(time, state.reshape(-1, 2)).ravel()

    solution = solve_ivp(
        rate,
        (0.0, times[-1]),
        start.ravel(),
        t_eval=times,
        rtol=1e-9,
        atol=1e-11,
    )
    return np.moveaxis(solution.y, 1, 0).reshape(frames, -1, 2)


def given_roll() -> tuple[Given, np.ndarray]:
    """Return the first frames of the roll, and its future."""
    rng = np.random.default_rng(0)
    start = rng.uniform(LOW, HIGH, (SIZE.particles, 2))
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
    way = float(np.sqrt(np.mean((future[-1] - given.last) ** 2)))
    errors = []
    for name in ("projection", "projection-2x"):
        predicted = np.stack(list(REFERENCES[name].predict(given)))
        assert predicted.dtype == np.float32
        assert predicted.shape == future.shape
        errors.append(float(np.sqrt(np.mean((predicted[-1] - future[-1]) ** 2))))
    assert errors[0] < 0.05 * way
    assert errors[1] < 0.03 * way


def test_the_viscosity_is_the_scenario_s_or_else_the_data_set_s() -> None:
    given, _ = given_roll()
    assert given.viscosity == SIZE.task.effective_viscosity
    stated = Given(**{**vars(given), "parameters": {"viscosity": "0.001"}})
    assert stated.viscosity == 0.001


def test_cells_follow_the_score_grid_inside_the_walls() -> None:
    given, _ = given_roll()
    assert cell_counts(given, 1) == (19, 19)
    assert cell_counts(given, 3) == (57, 57)
