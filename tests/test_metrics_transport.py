"""Distances of particle clouds against closed forms and an exact assignment."""

from __future__ import annotations

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metric_flows import Floats, pairs_of, rollout, scenario_of
from scipy.optimize import linear_sum_assignment

from lagbench.data.grid import Grid, Placement
from lagbench.errors import UsageError
from lagbench.metrics import METRICS, aggregate, measure, select, tally
from lagbench.metrics.transport import sinkhorn_divergence, sliced_wasserstein2


def cloud(seed: int, particles: int = 40) -> Floats:
    """Draw particles in the unit box."""
    return np.random.default_rng(seed).random((particles, 2))


@settings(deadline=None)
@given(
    st.integers(0, 99),
    st.floats(-0.5, 0.5, allow_subnormal=False),
    st.floats(-0.5, 0.5, allow_subnormal=False),
)
def test_a_shift_is_told_by_its_length(seed: int, dx: float, dy: float) -> None:
    """Shifted by s: every projection moves by s.d, and the mean of its square is |s|^2 / 2."""
    x = cloud(seed)
    shifted = x + np.array([dx, dy])
    assert sliced_wasserstein2(x, shifted) == pytest.approx(math.hypot(dx, dy) / math.sqrt(2), abs=1e-6)


def test_a_scaled_cloud() -> None:
    """Scaled by 1.5 about its middle: order is kept, W2^2 along d is 0.25 mean((r.d)^2)."""
    x = cloud(0)
    r = x - x.mean(axis=0)
    expected = math.sqrt(0.25 * np.mean(np.sum(r**2, axis=1)) / 2)
    assert sliced_wasserstein2(x, x.mean(axis=0) + 1.5 * r) == pytest.approx(expected, rel=1e-5)


@settings(deadline=None)
@given(st.integers(0, 99))
def test_slices_never_exceed_the_exact_distance(seed: int) -> None:
    """In the plane SW2^2 <= W2^2 / 2, W2 from an exact assignment; particle order does not count."""
    x, y = cloud(seed), cloud(seed + 1000)
    cost = np.sum((x[:, None] - y[None]) ** 2, axis=-1)
    rows, columns = linear_sum_assignment(cost)
    sliced = sliced_wasserstein2(x, y)
    assert sliced**2 <= cost[rows, columns].mean() / 2 + 1e-7
    assert sliced == sliced_wasserstein2(x[::-1], y)
    assert sliced_wasserstein2(x, x[::-1]) == 0.0


def test_measured_at_frames_of_interest_and_the_last_only() -> None:
    """Expected gaps elsewhere: frames 3 and 5 and the last, 7, are measured; of a full box only that."""
    truth = rollout()
    for placement, frames in {Placement.NODES: [3, 5, 7], Placement.CELL_CENTRES: [7]}.items():
        pairs = pairs_of(scenario_of(truth, grid=Grid(10, placement)), truth, truth)
        found = [pair.frame for pair in pairs if "sliced_w2" in measure(pair, [METRICS["sliced_w2"]])]
        assert found == frames


def cloud_score(shift: Floats, *, active: int | None, frames: int = 33) -> tuple[list[int], float]:
    """Return the frames at which ``cloud_distance`` is measured, and its mean, for shifted materials."""
    truth = rollout(frames=frames)
    material = np.repeat([0, 2], [100, 300])
    guess = truth + shift[material // 2]
    scenario = scenario_of(
        truth,
        material=material,
        horizon=frames - 2,
        materials=("liquid", "snow"),
        grid=Grid(10, Placement.NODES),
    )
    scenario = replace(scenario, active_frames=active)
    metrics, pairs = [METRICS["cloud_distance"], METRICS["active_frames"]], pairs_of(scenario, truth, guess)
    found = aggregate(metrics, {0: tally(pairs, metrics, scenario.setting.predicted_frames)})
    seen = [p.frame for p in pairs if "cloud_distance" in measure(p, metrics)]
    assert found["active_frames"].mean == (frames - 2 if active is None else active)
    return seen, found["cloud_distance"].mean


def test_cloud_distance_weighs_materials_by_their_share() -> None:
    """A quarter shifted by 0.4, the rest by 0.2: (0.25 * 0.4 + 0.75 * 0.2) / sqrt(2)."""
    _, distance = cloud_score(np.array([[0.4, 0.0], [0.0, 0.2]]), active=None)
    assert distance == pytest.approx((0.25 * 0.4 + 0.75 * 0.2) / math.sqrt(2), rel=1e-5)


@pytest.mark.parametrize(
    ("active", "frames"), [(None, [11, 21, 31]), (30, [11, 21, 31]), (29, [11, 21]), (9, [10]), (1, [2])]
)
def test_cloud_distance_stops_where_the_truth_rests(active: int | None, frames: list[int]) -> None:
    """Predicted frames 10, 20, ... (numbers 11, 21, ...) up to the last active one, else that one."""
    assert cloud_score(np.zeros((2, 2)), active=active)[0] == frames


def test_cloud_distance_asks_for_materials_not_for_particles() -> None:
    """Particles that swap places cost nothing, materials that swap places do."""
    truth = rollout(frames=12)
    material = np.arange(400) % 2
    scenario = scenario_of(
        truth, material=material, horizon=10, materials=("liquid", "jelly"), grid=Grid(10, Placement.NODES)
    )

    def distance(order: Floats) -> float:
        return METRICS["cloud_distance"].measure(pairs_of(scenario, truth, truth[:, order])[9])

    rng = np.random.default_rng(0)
    within = np.empty(400, np.intp)
    for kind in (0, 1):
        members = np.flatnonzero(material == kind)
        within[members] = rng.permutation(members)
    assert distance(within) == 0.0
    assert distance(np.arange(400) ^ 1) > 0.01


def test_sinkhorn_is_measured_only_when_asked_for() -> None:
    """The optional metric does not enter a scoring by itself."""
    assert "sinkhorn_pot" not in {metric.name for metric in select()}
    assert "sinkhorn_pot" in {metric.name for metric in select(extras=("transport",))}


def test_sinkhorn_without_its_package_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    """A missing POT is a usage error with the command that installs it."""
    monkeypatch.setitem(sys.modules, "ot", None)
    with pytest.raises(UsageError, match=r"pip install 'lagbench\[transport\]'"):
        sinkhorn_divergence(cloud(0), cloud(1))


def test_sinkhorn_of_a_shift() -> None:
    """Entropic transport debiased by its own terms leaves |s|^2 for a shift by s, 0 for none."""
    pytest.importorskip("ot")
    x = cloud(0)
    assert sinkhorn_divergence(x, x) == 0.0
    near, far = sinkhorn_divergence(x, x + 0.1), sinkhorn_divergence(x, x + 0.2)
    assert [near, far] == pytest.approx([0.02, 0.08], rel=1e-3)
