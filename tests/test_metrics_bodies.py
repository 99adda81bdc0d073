"""Shape and connectivity of elastic bodies against a search and bodies worked by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metric_flows import Floats, lattice, pair_of
from scipy.optimize import minimize_scalar

from lagbench.metrics import METRICS, FramePair
from lagbench.metrics.bodies import rigid_residual
from lagbench.metrics.frame import Bonds

ALL = ("liquid", "jelly", "snow", "rope")


def turned(points: Floats, angle: float) -> Floats:
    """Rotate points about the origin."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.asarray(points @ np.array([[cos, sin], [-sin, cos]]))


def moved(truth: Floats, prediction: Floats, material: list[int]) -> FramePair:
    """Return a pair of bodies whose frame 0 is the truth itself."""
    still = np.zeros_like(truth)
    return pair_of(truth, still, still, predicted_position=prediction, material=material, materials=ALL)


@settings(deadline=None)
@given(st.floats(-math.pi, math.pi), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_rigid_motion_is_no_error(angle: float, dx: float, dy: float) -> None:
    """A body that is turned and moved keeps its shape."""
    x = 0.2 * lattice(5)
    assert rigid_residual(x, turned(x, angle) + np.array([dx, dy])) < 1e-12


@settings(deadline=None)
@given(st.integers(0, 1000))
def test_the_fit_is_the_best_of_all_angles(seed: int) -> None:
    """No angle found by searching fits better than the closed form."""
    rng = np.random.default_rng(seed)
    t, p = rng.standard_normal((2, 6, 2))
    t, p = t - t.mean(axis=0), p - p.mean(axis=0)

    def residual(angle: float) -> float:
        return math.sqrt(np.mean(np.sum((turned(p, angle) - t) ** 2, axis=1)))

    starts = np.linspace(-math.pi, math.pi, 13)
    best = min(minimize_scalar(residual, bounds=pair).fun for pair in itertools.pairwise(starts))
    assert rigid_residual(t, p) == pytest.approx(best, rel=1e-6)


def test_a_stretched_square_by_hand() -> None:
    """Corners (+-1, +-1) stretched to (+-3, +-1) are off by 2 each, however they are turned."""
    square = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    assert rigid_residual(square, turned(square * [3.0, 1.0], 0.7)) == pytest.approx(2.0)


def test_a_mirrored_body_does_not_fit() -> None:
    """Reflection is not a rigid motion; a point body fits anything of its size."""
    body = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 1.0]])
    assert rigid_residual(body, body * [-1.0, 1.0]) > 0.3
    assert rigid_residual(np.zeros((3, 2)), np.ones((3, 2))) == 0.0


def test_bodies_of_a_scenario_are_judged_apart() -> None:
    """Jelly turned as a whole and rope stretched: only the rope has an error; the mean is half of it."""
    jelly, rope = 0.1 * lattice(4) + 0.2, np.stack([np.linspace(0.5, 0.9, 16), np.full(16, 0.7)], axis=1)
    longer = np.stack([np.linspace(0.4, 1.0, 16), np.full(16, 0.7)], axis=1)
    truth = np.vstack([jelly, rope])
    pair = moved(truth, np.vstack([turned(jelly, 0.3), longer]), [1] * 16 + [3] * 16)
    both, of_jelly, of_rope = (METRICS[f"shape_error{s}"].measure(pair) for s in ("", "_jelly", "_rope"))
    # stretched about its middle by 1/2 of its own half length 0.2, uniform: 0.1 * rms of linspace(-1, 1, 16)
    expected = 0.1 * math.sqrt(np.mean(np.linspace(-1, 1, 16) ** 2))
    assert of_jelly == pytest.approx(0.0, abs=1e-12)
    assert of_rope == pytest.approx(expected)
    assert both == pytest.approx(expected / 2)


def test_connectivity_of_a_chain_by_hand() -> None:
    """Five links of a chain, one torn to 2.5 times its length: 4 of 5 hold; at 2 times all do."""
    chain = np.stack([0.05 * np.arange(6), np.full(6, 0.5)], axis=1)
    bonds = Bonds.within(0.075, chain)
    torn, stretched = chain.copy(), chain.copy()
    torn[3:, 0] += 1.5 * 0.05
    stretched[3:, 0] += 0.99 * 0.05
    assert len(bonds.pairs) == 5
    assert bonds.share_held(chain) == bonds.share_held(stretched) == 1.0
    assert bonds.share_held(torn) == pytest.approx(0.8)


def test_neighbours_are_those_of_brute_force() -> None:
    """The pairs within the radius are all pairs within the radius, once each."""
    x = np.random.default_rng(0).random((60, 2))
    bonds = Bonds.within(0.2, x)
    distance = np.linalg.norm(x[:, None] - x[None], axis=-1)
    expected = {(i, j) for i, j in np.argwhere(distance <= 0.2).tolist() if i < j}
    assert {tuple(sorted(pair)) for pair in bonds.pairs.tolist()} == expected
    assert len(bonds.pairs) == len(expected)


def test_connectivity_speaks_of_prediction_and_truth() -> None:
    """A prediction that scatters the jelly is torn, its truth is not; lone particles have no bonds."""
    truth = 0.2 * lattice(6)
    pair = moved(truth, 4.0 * truth, [1] * 36)
    assert METRICS["connectivity"].measure(pair) == 0.0
    assert METRICS["connectivity_true"].measure(pair) == 1.0
    assert math.isnan(Bonds.within(0.01, truth).share_held(truth))


def test_only_elastic_bodies_have_shapes() -> None:
    """Liquid and snow flow and break: they have no shape to keep."""
    truth = lattice(4)
    pair = moved(truth, truth, [0] * 8 + [2] * 8)
    assert not any(METRICS[name].applies(pair) for name in METRICS if name.startswith(("shape", "connect")))
