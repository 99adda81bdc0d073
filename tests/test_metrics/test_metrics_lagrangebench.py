"""Errors of LagrangeBench against its own formulas, in walled and periodic boxes.

The formulas are those of ``MetricsComputer`` in its lagrangebench/evaluate/metrics.py,
written with NumPy.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from lagbench.board.ranking import combine
from lagbench.data.box import Box
from lagbench.data.grid import Grid, Placement
from lagbench.metrics import (
    METRICS,
    Scenario,
    TaskConfig,
    aggregate,
    select,
    snapshots,
    tally,
)
from lagbench.metrics.frame import FramePair
from lagbench.scoring.score_file import read_statistics

Floats = NDArray[np.float64]

BOARD = Path(__file__).parents[2] / "leaderboard"

GIVEN = 3
HORIZON = 42
PARTICLES = 50
MASS = 1.0 / PARTICLES


def walks(rng: np.random.Generator, dimension: int) -> Floats:
    """Return random walks without a box, shape [frame, particle, axis]."""
    start = rng.uniform(0.0, 1.0, (1, PARTICLES, dimension))
    steps = rng.normal(0.0, 0.02, (GIVEN + HORIZON - 1, PARTICLES, dimension))
    return np.concatenate([start, start + np.cumsum(steps, axis=0)])


def shortest(way: Floats, *, is_periodic: bool) -> Floats:
    """Return ways between points, across the ends of a periodic box of side 1."""
    if is_periodic:
        return way - np.round(way)
    return way


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("is_periodic", [False, True])
def test_errors_are_those_of_lagrangebench(dimension: int, is_periodic: bool) -> None:
    """Random walks that cross the ends of the box, in two and three dimensions."""
    rng = np.random.default_rng(7)
    true = walks(rng, dimension)
    predicted = true + 0.1 * walks(rng, dimension)
    if is_periodic:
        true = true % 1.0
        predicted = predicted % 1.0

    box = Box.from_bounds([(0.0, 1.0)] * dimension, periodic=[is_periodic] * dimension)
    config = TaskConfig(
        grid=Grid(8, Placement.CELL_CENTRES, box),
        input_frames=GIVEN,
        horizon=HORIZON,
        frames_of_interest=(GIVEN,),
        attribute_std=(0.3,) * dimension + (0.01,) * dimension,
        radius=0.2,
    )
    scenario = Scenario(
        config=config,
        input_positions=true[:GIVEN],
        material=np.zeros(PARTICLES, np.int8),
        particle_mass=MASS,
        area=1.0,
    )
    pairs = []
    for frame, truth, prediction in zip(
        config.predicted_frames,
        snapshots(scenario, true[GIVEN:]),
        snapshots(scenario, predicted[GIVEN:]),
        strict=True,
    ):
        pairs.append(FramePair(scenario, frame, truth, prediction))
    metrics = select(["position_mse_20", "e_kin_mse"])
    statistics = tally(pairs, metrics, config.predicted_frames)
    scores = aggregate(metrics, {0: statistics})

    target_rollout = true[GIVEN:]
    pred_rollout = predicted[GIVEN:]
    gap = shortest(pred_rollout - target_rollout, is_periodic=is_periodic)
    mse_20 = np.mean(gap[:20] ** 2)
    assert_allclose(scores["position_mse_20"].mean, mse_20, rtol=1e-12)

    energies = []
    for rollout in (pred_rollout, target_rollout):
        way = rollout[1::10] - rollout[0:-1:10]
        velocity = shortest(way, is_periodic=is_periodic)
        energies.append(MASS * np.sum(velocity**2, axis=(1, 2)))
    e_kin_pred, e_kin_target = energies
    mse = np.mean((e_kin_pred - e_kin_target) ** 2)
    assert_allclose(scores["e_kin_mse"].mean, mse, rtol=1e-10)


def test_they_are_measured_when_asked_for() -> None:
    """They stand in no table by default; their extra needs no package."""
    by_default = {metric.name for metric in select()}
    with_extra = {metric.name for metric in select(extras=("lagrangebench",))}
    assert with_extra - by_default == {"position_mse_20", "e_kin_mse"}


def test_entries_of_a_leaderboard_do_not_state_them() -> None:
    """Every score file has their statistics, but an entry states what it was scored by.

    The Sinkhorn divergence is stated where it was measured.
    """
    path = BOARD / "scores/curl-noise-3d/mini/neuralmpm_0.nc"
    tallies = read_statistics(path).tallies
    assert "energy_error" in combine([tallies])
    assert "e_kin_mse" not in combine([tallies])
    assert "e_kin_mse" in combine([tallies], names=["e_kin_mse"])
    assert not METRICS["sinkhorn_pot"].is_on_request
