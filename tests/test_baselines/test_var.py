"""VAR against statsmodels and closed forms; ridge and truncation against both their
ends.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from simple_models import batch_of, info_of, rolled, rotations, share_of_persistence
from statsmodels.tsa.api import VAR as StatsmodelsVAR

from lagbench.baselines.var import (
    BLOCK,
    VAR,
    LaggedRows,
    StableVAR,
    principal_directions,
    solve,
)
from lagbench.errors import WorkFailedError
from lagbench.make.generate import GenerationResult
from studies.thesis import var_protocol

Array = NDArray[np.float64]
Floats = NDArray[np.float32]


def series(frames: int, features: int, *, spread: float = 1.0, seed: int = 0) -> Floats:
    """Return a random walk whose features are mixed with singular values down to
    `spread`.
    """
    rng = np.random.default_rng(seed)
    left, right = (
        np.linalg.qr(rng.normal(size=(features, features)))[0] for _ in range(2)
    )
    mixed = (
        rng.normal(size=(frames, features))
        @ (left * np.geomspace(1.0, spread, features))
        @ right
    )
    mixed += 0.01 * rng.normal(size=features)
    return np.asarray(mixed, np.float32)


def design(states: Floats, lags: int) -> Array:
    """Return regressors by hand, shape [row, 1 + lag x feature]."""
    past = [states[lags - lag : len(states) - lag] for lag in range(1, lags + 1)]
    return np.column_stack([np.ones(len(states) - lags), *past]).astype(float)


def relative(found: Array, expected: Array) -> float:
    """Return the norm of a difference over that of what is expected."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize(
    ("lags", "spread"), [(1, 1.0), (2, 1e-2), (1, 1e-4), (1, 2e-6), (3, 1e-5)]
)
def test_coefficients_are_those_of_statsmodels(lags: int, spread: float) -> None:
    """Within 1e-6, up to condition numbers of 1e6; the condition number is NumPy's to
    its tolerance.
    """
    states = series(300, 24, spread=spread)
    found = solve(LaggedRows([states], lags=lags))
    expected = StatsmodelsVAR(states.astype(float)).fit(lags, trend="c").params
    condition = np.linalg.cond(design(states, lags))
    assert condition <= 1e6
    assert relative(found.coefficients, expected) <= 1e-6
    assert found.condition == pytest.approx(condition, rel=2e-3)
    assert found.floor == 0.0
    assert found.rows == 300 - lags


@pytest.mark.parametrize(
    ("frames", "spread", "error"), [(300, 2e-6, 1e-6), (15, 1.0, 1e-10)]
)
def test_the_solution_is_that_of_lapack(
    frames: int, spread: float, error: float
) -> None:
    """At condition 5e5 the normal equations alone miss 1e-6; refined once they hold it.

    With fewer rows than regressors there are many solutions: by singular values the
    shortest.
    """
    states = series(frames, 24, spread=spread)
    x = design(states, 1)
    y = states[1:].astype(float)
    expected = np.linalg.lstsq(x, y, rcond=None)[0]
    found = solve(LaggedRows([states], lags=1))
    assert relative(found.coefficients, expected) < error
    assert found.condition == pytest.approx(np.linalg.cond(x), rel=2e-3)
    if frames > 24:
        assert relative(np.linalg.solve(x.T @ x, x.T @ y), expected) > error


def test_equal_columns_get_a_floor_and_fit_as_well() -> None:
    """A singular matrix is solved all the same: the fit is as good as the best, and it
    is said.
    """
    states = series(200, 12)
    states[:, 5] = states[:, 4]
    found = solve(LaggedRows([states], lags=1))
    x = design(states, 1)
    y = states[1:].astype(float)
    best = np.square(y - x @ np.linalg.lstsq(x, y, rcond=None)[0]).sum()
    assert np.square(y - x @ found.coefficients).sum() == pytest.approx(best, rel=1e-6)
    assert found.condition > 1e6


def test_rows_stay_within_scenarios_and_blocks_add_up() -> None:
    """Scenarios of unequal length, longer than a block or too short, equal one stacked
    fit.
    """
    parts = [
        series(BLOCK + 300, 3, seed=1),
        series(40, 3, seed=2),
        series(1, 3, seed=3),
    ]
    rows = LaggedRows(parts, lags=2)
    x = np.concatenate([design(part, 2) for part in parts[:2]])
    y = np.concatenate([part[2:] for part in parts[:2]]).astype(float)
    assert rows.rows == len(x) == sum(len(block) for block, _ in rows)
    assert (
        relative(solve(rows).coefficients, np.linalg.lstsq(x, y, rcond=None)[0]) < 1e-12
    )


def test_nothing_to_fit_is_an_error() -> None:
    """Scenarios as short as the lags, and values that are not finite, are refused."""
    with pytest.raises(WorkFailedError):
        solve(LaggedRows([series(2, 3)], lags=2))
    broken = series(30, 3)
    broken[4, 1] = np.nan
    with pytest.raises(WorkFailedError) as caught:
        solve(LaggedRows([broken], lags=1))
    assert caught.value.where == "rows to fit"


def wandering(scenarios: int, *, frames: int = 60, particles: int = 6) -> list[Floats]:
    """Return particles on noisy orbits about moving centres: enough for a VAR, not
    exactly linear.
    """
    rng = np.random.default_rng(5)
    time = np.arange(frames)[:, None]
    found = []
    for _ in range(scenarios):
        speed = rng.uniform(0.05, 0.3, particles)
        phase = rng.uniform(0, 2 * np.pi, particles)
        angle = phase + speed * time + 0.4 * np.sin(0.2 * time)
        orbit = 0.5 + 0.2 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        found.append((orbit + rng.normal(0.0, 0.01, orbit.shape)).astype(np.float32))
    return found


def test_the_model_fits_what_statsmodels_fits() -> None:
    """The buffer holds statsmodels' parameters of the scenario's standardised
    states.
    """
    scenario = wandering(1, frames=200)[0]
    model = VAR.build({}, info_of([scenario]))
    report = model.fit(iter([scenario]))
    expected = (
        StatsmodelsVAR(model.states(scenario).astype(float)).fit(1, trend="c").params
    )
    assert relative(model.coefficients.numpy(), expected) <= 1e-6
    assert report["rows"] == 198
    assert 1 < report["condition"] < 1e6


def test_a_linear_motion_is_forecast() -> None:
    """Particles on springs, x(f+1) = 2 cos(w) x(f) - x(f-1): 30 frames ahead hardly
    anything is lost.
    """
    rng = np.random.default_rng(3)
    shape = (20, 1, 4, 2)
    angle = rng.uniform(0, 2 * np.pi, shape) + 0.2 * np.arange(40)[:, None, None]
    scenarios = list(
        (0.5 + rng.uniform(0.05, 0.3, shape) * np.cos(angle)).astype(np.float32)
    )
    model = VAR.build({}, info_of(scenarios))
    model.fit(scenarios[:19])
    assert share_of_persistence(model, scenarios[19], frames=30) < 1e-6


def test_lags_count_from_the_latest_frame() -> None:
    """A step of lag 2 is the intercept, A_1 times the last state and A_2 times the one
    before.
    """
    scenario = wandering(1)[0]
    model = VAR.build({"lags": 2}, info_of([scenario]))
    model.coefficients.copy_(
        torch.from_numpy(np.random.default_rng(0).normal(0, 0.1, (49, 24)))
    )
    state = model.start(batch_of([scenario[:5]]))
    before, last = model.states(scenario[:5])[-2:].astype(float)
    expected = np.concatenate([[1.0], last, before]) @ model.coefficients.numpy()
    np.testing.assert_allclose(
        model.next_state(state).flatten().numpy(), expected, atol=1e-5
    )
    repeated = model.start(batch_of([scenario[:2]])).state
    assert repeated.shape == (1, 2, 6, 4)


def test_one_step_of_training_and_of_a_rollout_agree() -> None:
    """The loss terms of a window are the errors of the rollout's first step."""
    scenarios = wandering(3)
    model = VAR.build({}, info_of(scenarios))
    model.fit(scenarios)
    window = scenarios[0][10:13]
    step = rolled(model, batch_of([window[:2]]), 1)[:, 0]
    error = (step - torch.from_numpy(window[2])) / torch.tensor(
        model.info.statistics["position_std"]
    )
    found = float(model(batch_of([window]))["position"])
    assert found == pytest.approx(float(error.square().mean()), rel=1e-3)


def test_without_ridge_and_truncation_stable_is_plain() -> None:
    """All directions and no ridge: least squares on changes is least squares on
    states.
    """
    scenarios = wandering(4)
    info = info_of(scenarios)
    plain = VAR.build({}, info)
    stable = StableVAR.build({"rank": 1000, "ridge": 0}, info)
    plain.fit(scenarios)
    report = stable.fit(scenarios)
    assert report["variance"] == pytest.approx(1.0)
    given = batch_of([x[20:22] for x in scenarios])
    torch.testing.assert_close(
        rolled(stable, given, 1), rolled(plain, given, 1), atol=2e-5, rtol=0
    )


def test_a_heavy_ridge_leaves_persistence() -> None:
    """Then every particle only follows the mean change of its place.

    With a light one a rotation is learned, by two directions of position and two of
    velocity.
    """
    scenarios = rotations(24)
    light = StableVAR.build({"rank": 6, "ridge": 1e-3}, info_of(scenarios))
    light.fit(scenarios)
    assert (
        share_of_persistence(light, rotations(30)[-1], frames=20) < 0.1
    )  # from a new angle
    model = StableVAR.build({"ridge": 1e9}, info_of(scenarios))
    model.fit(scenarios)
    given = batch_of([scenarios[0][:2]])
    step = rolled(model, given, 1)[:, 0] - given.position[:, -1]
    rows = np.concatenate([np.diff(x[1:].astype(float), axis=0) for x in scenarios])
    np.testing.assert_allclose(step.numpy(), rows.mean(axis=0), atol=1e-6)


def test_stable_holds_where_plain_diverges() -> None:
    """With hardly more rows than features the plain forecast leaves the box behind, the
    stable does not.
    """
    scenarios = wandering(2, frames=60, particles=25)
    info = info_of(scenarios)
    far = []
    for model in (
        VAR.build({}, info),
        StableVAR.build({"rank": 8, "ridge": 1.0}, info),
    ):
        model.fit(scenarios)
        far.append(
            float((rolled(model, batch_of([scenarios[0][:2]]), 200) - 0.5).abs().max())
        )
    assert far[1] < 5 < 100 < far[0]


def test_principal_directions_are_those_of_the_svd() -> None:
    """Leading eigenvalues and the subspace of a decaying spectrum equal LAPACK's."""
    x = series(400, 60, spread=1e-4).astype(float)
    found, values = principal_directions(lambda: np.array_split(x, 3), 60, rank=10)
    _, singular, right = np.linalg.svd(x)
    np.testing.assert_allclose(values, singular[:10] ** 2, rtol=1e-9)
    np.testing.assert_allclose(np.abs(found.T @ right[:10].T), np.eye(10), atol=1e-6)


def test_a_forecast_grows_by_its_eigenvalue() -> None:
    """z(f) = 2 z(f-1) grows by 2 per frame; its errors against 0 are 4^f / 2, and
    infinite past overflow.
    """
    coefficients = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 0.5]])
    last = np.array([[1.0, 0.0]], np.float32)
    errors, growth = var_protocol.forecast_errors(
        coefficients, last, np.zeros((30, 2), np.float32)
    )
    frames = np.arange(1, 31)
    np.testing.assert_allclose(errors, 4.0**frames / 2)
    assert growth == pytest.approx(2.0)
    errors, _ = var_protocol.forecast_errors(
        coefficients, last, np.zeros((600, 2), np.float32)
    )
    assert np.isinf(errors[-1])


def test_the_protocol_of_the_thesis_runs(
    generated: GenerationResult,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """On a tiny data set: 70 % of all frames fitted, 15 % forecast, thesis and ours
    side by side.
    """
    where: list[str | Path] = [
        "--split",
        generated.split,
        "--size",
        generated.size,
        "--root",
        generated.root,
    ]
    monkeypatch.setattr(sys, "argv", ["var_protocol", *map(str, where), "--json"])
    assert var_protocol.main() == 0
    found = json.loads(capsys.readouterr().out)
    assert found["features"] == 4 * 506
    assert found["frames"] == 91
    assert found["forecast_frames"] == 19
    assert found["fit_mse"] < 1e-9  # fewer frames than features: every one is met
    ours = {
        **found,
        "mse_at": {int(frame): value for frame, value in found["mse_at"].items()},
    }
    assert "| 3.5e+18 |" in var_protocol.result_markdown(
        var_protocol.ProtocolResult(**ours)
    )
