"""Distances of particle clouds against closed forms and an exact assignment."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metric_flows import Floats, pairs_of, rollout, scenario_of
from scipy.optimize import linear_sum_assignment

from lagbench.errors import UsageError
from lagbench.metrics import METRICS, measure, select
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
    assert sliced_wasserstein2(x, shifted) == pytest.approx(math.hypot(dx, dy) / math.sqrt(2), abs=1e-12)


def test_a_scaled_cloud() -> None:
    """Scaled by 1.5 about its middle: order is kept, W2^2 along d is 0.25 mean((r.d)^2)."""
    x = cloud(0)
    r = x - x.mean(axis=0)
    expected = math.sqrt(0.25 * np.mean(np.sum(r**2, axis=1)) / 2)
    assert sliced_wasserstein2(x, x.mean(axis=0) + 1.5 * r) == pytest.approx(expected, rel=1e-12)


@settings(deadline=None)
@given(st.integers(0, 99))
def test_slices_never_exceed_the_exact_distance(seed: int) -> None:
    """In the plane SW2^2 <= W2^2 / 2, W2 from an exact assignment; particle order does not count."""
    x, y = cloud(seed), cloud(seed + 1000)
    cost = np.sum((x[:, None] - y[None]) ** 2, axis=-1)
    rows, columns = linear_sum_assignment(cost)
    sliced = sliced_wasserstein2(x, y)
    assert sliced**2 <= cost[rows, columns].mean() / 2 + 1e-12
    assert sliced == pytest.approx(sliced_wasserstein2(x[::-1], y), rel=1e-12)
    assert sliced_wasserstein2(x, x[::-1]) == pytest.approx(0.0, abs=1e-12)


def test_measured_at_frames_of_interest_and_the_last_only() -> None:
    """Slow metrics are expected gaps elsewhere: frames 3 and 5 and the last, 7."""
    truth = rollout()
    pairs = pairs_of(scenario_of(truth), truth, truth)
    found = [pair.frame for pair in pairs if "sliced_w2" in measure(pair, [METRICS["sliced_w2"]])]
    assert found == [3, 5, 7]


def test_sinkhorn_is_measured_only_when_asked_for() -> None:
    """The optional metric does not enter a scoring by itself."""
    assert "sinkhorn" not in {metric.name for metric in select()}
    assert "sinkhorn" in {metric.name for metric in select(extras=("transport",))}


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
