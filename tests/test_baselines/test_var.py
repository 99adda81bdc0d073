"""VAR against statsmodels and closed forms; ridge and truncation at both their ends."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from numpy.typing import NDArray
from simple_models import (
    batch_of,
    info_of,
    rolled,
    rotations,
    share_of_persistence,
)
from statsmodels.tsa.api import VAR as StatsmodelsVAR

from lagbench.baselines.baseline import Batch
from lagbench.baselines.var import BLOCK, VAR, LaggedRows, StableVAR, solve

Array = NDArray[np.float64]
Floats = NDArray[np.float32]


def random_orthogonal(
    rng: np.random.Generator,
    size: int,
) -> Array:
    """Return a random orthogonal matrix."""
    matrix = rng.normal(size=(size, size))
    q, _ = np.linalg.qr(matrix)
    return q


def series(
    frames: int,
    features: int,
    *,
    spread: float = 1.0,
    seed: int = 0,
) -> Floats:
    """Return noise whose features are mixed, shape [frame, feature].

    The singular values of the mixing matrix go from 1 down to `spread`.
    """
    rng = np.random.default_rng(seed)
    left = random_orthogonal(rng, features)
    right = random_orthogonal(rng, features)
    singular_values = np.geomspace(1.0, spread, features)
    noise = rng.normal(size=(frames, features))
    mixed = noise @ (left * singular_values) @ right
    mixed += 0.01 * rng.normal(size=features)
    return np.asarray(mixed, np.float32)


def design_matrix(states: Floats, lags: int) -> Array:
    """Return regressors by hand, shape [row, 1 + lag x feature]."""
    row_count = len(states) - lags
    columns = [np.ones(row_count)]
    for lag in range(1, lags + 1):
        first = lags - lag
        columns.append(states[first : first + row_count])
    return np.column_stack(columns).astype(float)


def least_squares(x: Array, y: Array) -> Array:
    """Return the coefficients by LAPACK."""
    coefficients, *_ = np.linalg.lstsq(x, y, rcond=None)
    return coefficients


def relative_error(value: Array, expected: Array) -> float:
    """Return the norm of a difference over that of the expected value."""
    error = np.linalg.norm(value - expected)
    return float(error / np.linalg.norm(expected))


@pytest.mark.parametrize(
    ("lags", "spread"),
    [
        (1, 1.0),
        (2, 1e-2),
        (1, 1e-4),
        (1, 2e-6),
        (3, 1e-5),
    ],
)
def test_coefficients_are_those_of_statsmodels(lags: int, spread: float) -> None:
    """They agree within 1e-6, up to condition numbers of 1e6."""
    states = series(300, 24, spread=spread)
    rows = LaggedRows([states], lags=lags)
    solution = solve(rows)
    model = StatsmodelsVAR(states.astype(float))
    expected = model.fit(lags, trend="c").params
    x = design_matrix(states, lags)
    condition = np.linalg.cond(x)
    assert condition <= 1e6
    assert relative_error(solution, expected) <= 1e-6


@pytest.mark.parametrize(
    ("frames", "spread", "tolerance"),
    [
        (300, 2e-6, 1e-6),
        (15, 1.0, 1e-10),
    ],
)
def test_the_solution_is_that_of_lapack(
    frames: int,
    spread: float,
    tolerance: float,
) -> None:
    """At condition 5e5 the plain normal equations miss the tolerance.

    With fewer rows than regressors there are many solutions, and LAPACK returns the
    shortest.
    """
    states = series(frames, 24, spread=spread)
    x = design_matrix(states, 1)
    y = states[1:].astype(float)
    expected = least_squares(x, y)
    rows = LaggedRows([states], lags=1)
    solution = solve(rows)
    assert relative_error(solution, expected) < tolerance
    if frames > 24:
        gram = x.T @ x
        normal_equations = np.linalg.solve(gram, x.T @ y)
        assert relative_error(normal_equations, expected) > tolerance


def test_rows_stay_within_scenarios_and_blocks_add_up() -> None:
    """Scenarios longer than a block or too short equal one stacked fit."""
    longer_than_a_block = series(BLOCK + 300, 3, seed=1)
    plain = series(40, 3, seed=2)
    too_short = series(1, 3, seed=3)
    scenarios = [longer_than_a_block, plain, too_short]
    rows = LaggedRows(scenarios, lags=2)

    blocks = [
        design_matrix(longer_than_a_block, 2),
        design_matrix(plain, 2),
    ]
    x = np.concatenate(blocks)
    next_states = [longer_than_a_block[2:], plain[2:]]
    y = np.concatenate(next_states).astype(float)
    assert rows.rows == len(x)
    block_lengths = [len(block) for block, _ in rows]
    assert sum(block_lengths) == len(x)
    assert relative_error(solve(rows), least_squares(x, y)) < 1e-12


def whole(*scenarios: Floats) -> list[Batch]:
    """Return whole scenarios as batches."""
    return [batch_of([scenario]) for scenario in scenarios]


def noisy_orbits(
    scenarios: int,
    *,
    frames: int = 60,
    particles: int = 6,
) -> list[Floats]:
    """Return particles on noisy orbits of changing speed: not exactly linear."""
    rng = np.random.default_rng(5)
    time = np.arange(frames)[:, None]
    orbits = []
    for _ in range(scenarios):
        speed = rng.uniform(0.05, 0.3, particles)
        phase = rng.uniform(0, 2 * np.pi, particles)
        wobble = 0.4 * np.sin(0.2 * time)
        angle = phase + speed * time + wobble
        x = np.cos(angle)
        y = np.sin(angle)
        circle = np.stack([x, y], axis=-1)
        orbit = 0.5 + 0.2 * circle
        noise = rng.normal(0.0, 0.01, orbit.shape)
        noisy = orbit + noise
        orbits.append(noisy.astype(np.float32))
    return orbits


def test_a_linear_motion_is_forecast() -> None:
    """Particles on springs, x(f+1) = 2 cos(w) x(f) - x(f-1), over 30 frames."""
    rng = np.random.default_rng(3)
    shape = (20, 1, 4, 2)
    phase = rng.uniform(0, 2 * np.pi, shape)
    time = np.arange(40)[:, None, None]
    angle = phase + 0.2 * time
    amplitude = rng.uniform(0.05, 0.3, shape)
    position = 0.5 + amplitude * np.cos(angle)
    scenarios = list(position.astype(np.float32))
    model = VAR.build({}, info_of(scenarios))
    model.fit(whole(*scenarios[:19]))
    share = share_of_persistence(model, scenarios[19], frames=30)
    assert share < 1e-6


def test_without_ridge_and_truncation_stable_is_plain() -> None:
    """Least squares on changes is then least squares on states."""
    scenarios = noisy_orbits(4)
    info = info_of(scenarios)
    plain = VAR.build({}, info)
    options = {"rank": 1000, "ridge": 0}
    stable = StableVAR.build(options, info)
    plain.fit(whole(*scenarios))
    report = stable.fit(whole(*scenarios))
    assert report["variance"] == pytest.approx(1.0)
    windows = [scenario[20:22] for scenario in scenarios]
    window = batch_of(windows)
    step = rolled(stable, window, 1)
    plain_step = rolled(plain, window, 1)
    torch.testing.assert_close(step, plain_step, atol=2e-5, rtol=0)


def test_a_heavy_ridge_leaves_persistence() -> None:
    """Every particle then only follows its mean change of place."""
    scenarios = rotations(24)
    model = StableVAR.build({"ridge": 1e9}, info_of(scenarios))
    model.fit(whole(*scenarios))
    first_frames = scenarios[0][:2]
    window = batch_of([first_frames])
    predicted = rolled(model, window, 1)[:, 0]
    step = predicted - window.position[:, -1]
    changes = []
    for positions in scenarios:
        later = positions[1:].astype(float)
        changes.append(np.diff(later, axis=0))
    mean_change = np.concatenate(changes).mean(axis=0)
    assert_allclose(step.numpy(), mean_change, atol=1e-6)


def test_stable_holds_where_plain_diverges() -> None:
    """There are hardly more rows than features: the plain forecast leaves the box."""
    scenarios = noisy_orbits(2, frames=60, particles=25)
    info = info_of(scenarios)
    first_frames = scenarios[0][:2]
    window = batch_of([first_frames])

    def greatest_distance(model: VAR | StableVAR) -> float:
        model.fit(whole(*scenarios))
        path = rolled(model, window, 200)
        from_middle = path - 0.5
        return float(from_middle.abs().max())

    options = {"rank": 8, "ridge": 1.0}
    stable = StableVAR.build(options, info)
    plain = VAR.build({}, info)
    assert greatest_distance(stable) < 5
    assert greatest_distance(plain) > 100


def test_the_directions_are_those_of_the_svd() -> None:
    """The leading subspace of the centred states equals LAPACK's."""
    scenarios = noisy_orbits(4)
    model = StableVAR.build({"rank": 3}, info_of(scenarios))
    model.fit(whole(*scenarios))
    states = [each[:-1] for each in model.states(whole(*scenarios))]
    centred = np.concatenate(states).astype(float)
    centred -= centred.mean(axis=0)
    _, _, right = np.linalg.svd(centred)
    leading = right[:3].T
    overlap = np.linalg.norm(model.directions.numpy().T @ leading, axis=1)
    assert_allclose(overlap, np.ones(3), atol=1e-4)
