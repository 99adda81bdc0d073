"""Tallies and scores: chunking, particle order, undefined frames, scenario means."""

from __future__ import annotations

import functools
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metric_flows import SETTING, Floats, pairs_of, rollout, scenario_of
from numpy.testing import assert_allclose

from lagbench.errors import UsageError
from lagbench.metrics import (
    METRICS,
    FramePair,
    Tally,
    aggregate,
    bootstrap_interval,
    measure,
    score,
    select,
    snapshots,
    tally,
)
from lagbench.metrics.metric import FirstFrames, last

ALL = select()
MATERIAL = np.arange(400) // 200  # half liquid, half jelly
KINDS = ("liquid", "jelly")


@functools.cache
def trajectories() -> tuple[Floats, Floats]:
    """Return a truth and a prediction that drifts from it."""
    truth = rollout()
    noise = np.random.default_rng(5).standard_normal(truth.shape)
    return truth, truth + 0.003 * np.arange(8)[:, None, None] * noise


@functools.cache
def pairs() -> list[FramePair]:
    """Return their frame pairs."""
    truth, prediction = trajectories()
    return pairs_of(scenario_of(truth, material=MATERIAL, materials=KINDS), truth, prediction)


def whole() -> Tally:
    """Measure all frames in one go."""
    return tally(pairs(), ALL, SETTING.predicted_frames)


def same_bits(one: Tally, two: Tally) -> bool:
    """Tell whether two tallies hold the same bytes."""
    return all(
        getattr(one, name).tobytes() == getattr(two, name).tobytes()
        for name in ("total", "weight", "undefined")
    )


@given(st.lists(st.integers(0, 6), max_size=4), st.randoms(use_true_random=False))
def test_chunks_in_any_order_give_the_same_bits(cuts: list[int], random: object) -> None:
    """Frames cut anywhere, measured apart and added in any order, add up to the same bytes."""
    edges = [0, *sorted(cuts), 6]
    chunks = [tally(pairs()[a:b], ALL, SETTING.predicted_frames) for a, b in itertools.pairwise(edges)]
    random.shuffle(chunks)  # type: ignore[attr-defined]
    assert same_bits(functools.reduce(Tally.__add__, chunks), whole())


@settings(deadline=None, max_examples=15)
@given(st.randoms(use_true_random=False))
def test_particle_order_changes_nothing(random: object) -> None:
    """Truth and prediction permuted alike have the same scores, but for the rounding of sums."""
    order = list(range(400))
    random.shuffle(order)  # type: ignore[attr-defined]
    truth, prediction = (x[:, order] for x in trajectories())
    scenario = scenario_of(truth, material=MATERIAL[order], materials=KINDS)
    permuted = tally(pairs_of(scenario, truth, prediction), ALL, SETTING.predicted_frames)
    assert_allclose(permuted.total, whole().total, rtol=1e-9, atol=1e-13)


def test_a_worker_may_start_in_the_middle() -> None:
    """Snapshots from frame 5 on, given the positions of frame 4, are those of the whole rollout."""
    truth, prediction = trajectories()
    scenario = scenario_of(truth, material=MATERIAL, materials=KINDS)
    sides = (snapshots(scenario, x[5:], previous=x[4]) for x in (truth, prediction))
    late = [FramePair(scenario, f, t, p) for f, t, p in zip(range(5, 8), *sides, strict=True)]
    assert measure(late[0], ALL) == measure(pairs()[3], ALL)


def test_truth_snapshots_serve_several_predictions() -> None:
    """Sharing the truth's fields between predictions changes no value."""
    truth, prediction = trajectories()
    scenario = scenario_of(truth, material=MATERIAL, materials=KINDS)
    true = list(snapshots(scenario, truth[2:]))
    for positions in (prediction, truth):
        shared = [
            FramePair(scenario, f, t, p)
            for f, t, p in zip(
                SETTING.predicted_frames, true, snapshots(scenario, positions[2:]), strict=True
            )
        ]
        alone = pairs_of(scenario, truth, positions)
        assert same_bits(
            tally(shared, ALL, SETTING.predicted_frames), tally(alone, ALL, SETTING.predicted_frames)
        )


def of_pearson(*values: float) -> Tally:
    """Return a tally of correlations at frames 2, 3, ..."""
    frames = range(2, 2 + len(values))
    return Tally.of(
        ["vorticity_pearson"],
        frames,
        {f: {"vorticity_pearson": v} for f, v in zip(frames, values, strict=True)},
    )


def test_undefined_frames_are_left_out_and_counted() -> None:
    """Correlations 1, NaN, 0.6: mean 0.8 of two, one undefined; stable for one defined frame."""
    tallies = {3: of_pearson(1.0, math.nan, 0.6)}
    found = score(METRICS["vorticity_pearson"], tallies)
    stable = score(METRICS["stable_frames"], tallies)
    assert found is not None
    assert stable is not None
    assert found.mean == pytest.approx(0.8)
    assert found.undefined == (1,)
    assert math.isnan(found.at(3)[0])
    assert stable.mean == 1.0


def test_standing_still_is_not_stable() -> None:
    """One good frame, then 89 at rest without a correlation: one stable frame, not 90."""
    stable = score(METRICS["stable_frames"], {3: of_pearson(0.99, *[math.nan] * 89)})
    assert stable is not None
    assert stable.mean == 1.0
    assert stable.undefined == (89,)


def test_a_scenario_without_a_defined_frame_is_left_out() -> None:
    """Scenario 4 has no correlation: the mean is that of scenario 2, in id order."""
    found = score(METRICS["vorticity_pearson"], {4: of_pearson(math.nan, math.nan), 2: of_pearson(0.5, 0.7)})
    assert found is not None
    assert found.scenarios == (2, 4)
    assert found.undefined == (0, 2)
    assert found.mean == pytest.approx(0.6)


def test_what_a_split_does_not_have_is_not_listed() -> None:
    """Expected gaps are no scores: no rope here, and no horizon of ten frames."""
    found = aggregate(ALL, {0: whole()})
    assert {"position_mse_jelly", "shape_error_jelly", "mse_avg_5"} <= set(found)
    assert not {"position_mse_rope", "shape_error_rope", "position_mse_snow", "mse_avg_10"} & set(found)


def test_the_mean_over_frames_comes_before_that_over_scenarios() -> None:
    """Scenario means 0.6 and 1.0 of two and of one defined frame: 0.8, not (0.5 + 0.7 + 1.0) / 3."""
    found = score(METRICS["vorticity_pearson"], {0: of_pearson(0.5, 0.7), 1: of_pearson(math.nan, 1.0)})
    assert found is not None
    assert found.mean == pytest.approx(0.8)


def test_the_interval_of_a_score_is_that_of_its_scenario_values() -> None:
    """Scenario means 0.6, 0.8 and an undefined one: the bootstrap sees the two values."""
    values = ((0.5, 0.7), (0.8, math.nan), (math.nan, math.nan))
    found = score(METRICS["vorticity_pearson"], {i: of_pearson(*v) for i, v in enumerate(values)})
    assert found is not None
    assert found.interval == bootstrap_interval([0.6, 0.8])


def test_a_horizon_beyond_the_series_is_undefined() -> None:
    """The mean of the first five of three frames does not exist; of the first two it does."""
    assert math.isnan(FirstFrames(5)(np.arange(3.0)))
    assert FirstFrames(2)(np.arange(3.0)) == 0.5
    assert FirstFrames(2, last)(np.arange(3.0)) == 1.0


def test_a_frame_measured_twice_keeps_its_value() -> None:
    """A worker that was taken for lost and comes back adds weight, not error."""
    twice = whole() + whole()
    for name in whole().names:
        np.testing.assert_array_equal(twice.series(name), whole().series(name))


def test_tallies_of_different_things_do_not_add() -> None:
    """Other frames or statistics are refused, and so is a value without a place."""
    with pytest.raises(UsageError, match="do not add"):
        of_pearson(0.1) + of_pearson(0.1, 0.2)
    with pytest.raises(UsageError, match="no place"):
        Tally.of(["vorticity_mse"], [2], {3: {"vorticity_mse": 1.0}})
