"""The speedup of a model over the classical side, and when it was worth its making."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from lagbench.scoring.front import (
    FrontRow,
    NoSpeedup,
    Speedup,
    breakeven,
    classical_hull,
    classical_seconds,
    compute_speedup,
    pays_after_holm,
)

SCENARIOS = 16


def row(kind: str, seconds: float, error: float, *, spread: float = 0.0) -> FrontRow:
    """Return a row whose errors have this mean."""
    generator = np.random.default_rng(0)
    factors = 1.0 + spread * generator.normal(size=(1, SCENARIOS))
    errors = error * factors / factors.mean()
    return FrontRow(name=f"{kind} {seconds}", kind=kind, seconds=seconds, errors=errors)


NAIVE = row("naive", 1e-6, 1.0)
CHEAP = row("classical", 1.0, 0.4)
DEAR = row("calibrated", 16.0, 0.1)
ROWS = (NAIVE, CHEAP, DEAR)


@pytest.mark.parametrize(
    ("error", "seconds", "at_least"),
    [
        (0.4, 1.0, False),
        (0.2, 4.0, False),  # half-way between both in the logarithm
        (0.1, 16.0, False),
        (0.05, 16.0, True),
        (0.7, 1.0, False),
    ],
)
def test_classical_cost_is_that_of_the_hull(
    error: float, seconds: float, at_least: bool
) -> None:
    cost, is_beyond = classical_seconds(ROWS, error)
    assert cost == pytest.approx(seconds)
    assert is_beyond is at_least
    speedup = compute_speedup(row("learned", 2.0, error), ROWS)
    assert speedup.value == pytest.approx(seconds / 2.0)
    assert speedup.at_least is at_least


def test_no_better_than_naive_has_no_speedup() -> None:
    model = row("learned", 0.1, 1.0)
    assert compute_speedup(model, ROWS) is NoSpeedup.NOT_BETTER_THAN_NAIVE


def test_a_model_is_not_measured_against_itself() -> None:
    model = row("hybrid", 1.0, 0.01)
    assert compute_speedup(model, [*ROWS, model]).at_least


@given(
    st.lists(
        st.tuples(st.floats(0.01, 100.0), st.floats(0.001, 1.0)),
        min_size=3,
        max_size=12,
        unique_by=(lambda point: round(point[0], 2), lambda point: round(point[1], 3)),
    )
)
def test_corners_are_those_of_the_convex_hull(
    points: list[tuple[float, float]],
) -> None:
    rows = [row("classical", seconds, error) for seconds, error in points]
    places = np.log(points)
    # with points far to the right and far up it has no other corners
    far = 1e4
    cheapest = places[np.lexsort((places[:, 1], places[:, 0]))[0]]
    best = places[np.argmin(places[:, 1])]
    closed = [*places, [cheapest[0], far], [far, best[1]], [far, far]]
    corners = ConvexHull(closed, qhull_options="QJ").vertices
    found = classical_hull(rows)
    costs = [one.seconds for one in found]
    assert costs == sorted(costs)
    for one in found:
        assert one.seconds <= classical_seconds(rows, one.error)[0] * (1 + 1e-6)
    for i in corners:
        if i < len(points):
            cost, _ = classical_seconds(rows, points[i][1])
            assert cost == pytest.approx(points[i][0], rel=1e-4)


def test_seeds_and_scenarios_widen_the_interval() -> None:
    certain = compute_speedup(row("learned", 2.0, 0.2), ROWS)
    assert certain.interval == pytest.approx((2.0, 2.0))
    assert certain.pays
    scenarios = compute_speedup(row("learned", 2.0, 0.2, spread=0.5), ROWS)
    low, high = scenarios.interval
    assert low < 2.0 < high
    errors = 0.2 * np.array([[0.5], [1.0], [1.5]]) * np.ones((3, SCENARIOS))
    model = FrontRow(name="model", kind="learned", seconds=2.0, errors=errors)
    low, high = compute_speedup(model, ROWS).interval
    assert low < 2.0 < high


@pytest.mark.parametrize(("ratio", "pays"), [(1.4, False), (1.6, True)])
def test_learning_pays_beyond_the_noise_of_costs(ratio: float, pays: bool) -> None:
    speedup = compute_speedup(row("learned", 4.0 / ratio, 0.2), ROWS)
    assert speedup.interval == pytest.approx((ratio, ratio))
    assert speedup.pays is pays


def made_speedup(p: float) -> Speedup:
    return Speedup(
        value=2.0, interval=(1.6, 3.0), p=p, classical_seconds=1.0, at_least=False
    )


def test_data_sets_are_counted_after_holm() -> None:
    speedups = {"a": made_speedup(0.01), "b": made_speedup(0.04)}
    assert pays_after_holm(speedups) == ["a", "b"]
    speedups["c"] = made_speedup(0.045)
    assert pays_after_holm(speedups) == ["a"]


def test_breakeven_is_the_time_to_make_over_the_time_saved() -> None:
    speedup = made_speedup(0.01)
    # saves 1 s in each of 36 frames
    assert breakeven(speedup, seconds_per_frame=1.0, frames=36, hours=2.0) == 200.0
    slow = Speedup(
        value=0.9, interval=(0.5, 1.1), p=0.5, classical_seconds=1.0, at_least=False
    )
    never = breakeven(slow, seconds_per_frame=1.0, frames=36, hours=2.0)
    assert never == math.inf
