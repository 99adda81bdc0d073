"""The table of metrics entry by entry, and the way from frames to scores."""

from __future__ import annotations

import functools
import itertools
import math
import pickle
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from metric_flows import CONFIG, Floats, pairs_of, rollout, scenario_of
from numpy.testing import assert_allclose, assert_array_equal, assert_equal

from lagbench.data.grid import Grid, Placement
from lagbench.data.registry import PluginWarning
from lagbench.errors import (
    UsageError,
    WorkFailedError,
)
from lagbench.metrics import (
    FAMILIES,
    METRICS,
    Direction,
    FramePair,
    Metric,
    Score,
    Tally,
    aggregate,
    available,
    bootstrap_interval,
    measure,
    score,
    select,
    snapshots,
    tally,
)
from lagbench.metrics import table as table_module

ALL = select()
MATERIAL = np.arange(400) // 200  # half liquid, half jelly
KINDS = ("liquid", "jelly")


@functools.cache
def trajectories() -> tuple[Floats, Floats]:
    """Return a truth and a prediction that drifts from it."""
    truth = rollout()
    rng = np.random.default_rng(5)
    noise = rng.standard_normal(truth.shape)
    growth = 0.003 * np.arange(8)[:, None, None]
    return truth, truth + growth * noise


@functools.cache
def pairs() -> list[FramePair]:
    """Return their frame pairs."""
    truth, prediction = trajectories()
    scenario = scenario_of(truth, material=MATERIAL, materials=KINDS)
    return pairs_of(scenario, truth, prediction)


def tallied(*pieces: FramePair) -> Tally:
    """Measure frames, all of the rollout unless told otherwise."""
    return tally(pieces or pairs(), ALL, CONFIG.predicted_frames)


def of_pearson(*values: float) -> Tally:
    """Return a tally of correlations at frames 2, 3, ..."""
    name = "vorticity_pearson"
    numbered = {}
    for frame, value in enumerate(values, start=2):
        numbered[frame] = {name: value}
    return Tally.of([name], list(numbered), numbered)


def same_bits(first: Tally, second: Tally) -> bool:
    """Tell whether two tallies hold the same bytes."""
    pairs = zip(
        (first.total, first.weight, first.undefined),
        (second.total, second.weight, second.undefined),
        strict=True,
    )
    return all(one.tobytes() == other.tobytes() for one, other in pairs)


@given(st.lists(st.integers(0, 6), max_size=4), st.randoms(use_true_random=False))
def test_chunks_in_any_order_give_the_same_bits(
    cuts: list[int], random: object
) -> None:
    """Frames cut anywhere, measured apart and added in any order, add up to the same
    bytes.
    """
    edges = [0, *sorted(cuts), 6]
    chunks = []
    for begin, end in itertools.pairwise(edges):
        chunk = tally(pairs()[begin:end], ALL, CONFIG.predicted_frames)
        chunks.append(chunk)
    random.shuffle(chunks)  # type: ignore[attr-defined]
    total = functools.reduce(Tally.__add__, chunks)
    assert same_bits(total, tallied())


@settings(max_examples=15)
@given(st.randoms(use_true_random=False))
def test_particle_order_changes_nothing(random: object) -> None:
    """Truth and prediction permuted alike have the same scores, but for the rounding of
    sums.
    """
    order = list(range(400))
    random.shuffle(order)  # type: ignore[attr-defined]
    truth, prediction = trajectories()
    scenario = scenario_of(
        truth[:, order],
        material=MATERIAL[order],
        materials=KINDS,
    )
    permuted_pairs = pairs_of(scenario, truth[:, order], prediction[:, order])
    permuted = tallied(*permuted_pairs)
    expected = tallied()
    assert_allclose(permuted.total, expected.total, rtol=1e-9, atol=1e-13)


def test_snapshots_may_be_shared_and_begin_in_the_middle() -> None:
    """The truth's fields serve several predictions; from frame 5 on, given frame 4,
    values are the same.
    """
    truth, prediction = trajectories()
    scenario = scenario_of(truth, material=MATERIAL, materials=KINDS)
    true_snapshots = list(snapshots(scenario, truth[2:]))
    for positions in (prediction, truth):
        sides = zip(
            CONFIG.predicted_frames,
            true_snapshots,
            snapshots(scenario, positions[2:]),
            strict=True,
        )
        shared = []
        for frame, true, predicted in sides:
            shared.append(FramePair(scenario, frame, true, predicted))
        apart = pairs_of(scenario, truth, positions)
        assert same_bits(tallied(*shared), tallied(*apart))
    true, *_ = snapshots(scenario, truth[5:], previous=truth[4])
    predicted, *_ = snapshots(scenario, prediction[5:], previous=prediction[4])
    late = FramePair(scenario, 5, true, predicted)
    assert measure(late, ALL) == measure(pairs()[3], ALL)


def test_what_has_no_value_at_a_frame() -> None:
    """Numbers of a rollout, and any number at a frame that is not predicted."""
    scores = aggregate(ALL, {0: tallied()})
    calls = [
        (scores["stable_frames"], 7),
        (scores["mse_avg"], 7),
        (scores["position_rmse"], 999),
        (scores["position_rmse"], "3"),
        (scores["position_rmse"], None),
    ]
    for measured, frame in calls:
        with pytest.raises(UsageError):
            measured.at(frame)
        with pytest.raises(UsageError):
            measured.interval_at(frame)


def test_a_frame_at_rest_ends_no_stable_frames_and_adds_none() -> None:
    """One good frame, then 89 without a correlation: one stable frame, not 90."""
    tallies = {3: of_pearson(0.99, *[math.nan] * 89)}
    still = score(METRICS["stable_frames"], tallies)
    assert (still.mean, still.undefined) == (1.0, (89,))


UNDEFINED = (math.nan, math.nan)


@pytest.mark.parametrize(
    ("values", "mean", "undefined"),
    [
        # scenario 4 has no correlation: the mean is that of scenario 2, in id order
        ({4: UNDEFINED, 2: (0.5, 0.7)}, 0.6, (0, 2)),
        # the mean of scenario means, not of frames: (0.5 + 0.7 + 1.0) / 3
        ({0: (0.5, 0.7), 1: (math.nan, 1.0)}, 0.8, (0, 1)),
    ],
)
def test_undefined_frames_and_scenarios_are_left_out_and_counted(
    values: dict[int, tuple[float, float]], mean: float, undefined: tuple[int, ...]
) -> None:
    """The interval is the bootstrap of the scenarios' values."""
    tallies = {scenario: of_pearson(*row) for scenario, row in values.items()}
    correlation = score(METRICS["vorticity_pearson"], tallies)
    assert correlation.scenarios == tuple(sorted(values))
    assert correlation.undefined == undefined
    assert correlation.mean == pytest.approx(mean)
    assert_equal(correlation.interval, bootstrap_interval(correlation.values))


def test_tallies_add() -> None:
    """A worker that counted as lost and comes back adds weight, not error."""
    once = tallied()
    twice = once + once
    for name in twice.names:
        assert_array_equal(twice.series(name), once.series(name))
    with pytest.raises(UsageError):  # other frames
        of_pearson(0.1) + of_pearson(0.1, 0.2)
    with pytest.raises(UsageError):  # a value without a place
        Tally.of(["vorticity_mse"], [2], {3: {"vorticity_mse": 1.0}})


MEASURED = select(known=METRICS)  # Sinkhorn, optional and slow, has tests of its own
STATES = ("liquid", "jelly", "snow", "rope")


@functools.cache
def scores(size: float) -> dict[str, Score]:
    """Score a rollout of all four materials whose error has this size."""
    truth = rollout(frames=54, side=40, speed=0.002)
    rng = np.random.default_rng(7)
    scattered = rng.standard_normal(truth.shape[1:])
    step = truth[1:] - truth[:-1]
    drift = np.array([2e-4, 1e-4])
    expansion = 0.01 * (truth[:-1] - 0.4)
    wrong_step = 0.4 * step + 0.0001 * scattered + drift + expansion
    error = np.zeros_like(truth)
    error[2:] = np.cumsum(wrong_step[1:], axis=0)
    scores_of_boxes: dict[str, Score] = {}
    for placement in Placement:  # no one box is full and has a surface
        task = {
            "materials": STATES,
            "horizon": 52,
            "grid": Grid(20, placement),
            "radius": 0.04,
        }
        material = np.repeat(range(4), 400)
        scenario = scenario_of(truth, material=material, **task)
        pairs = pairs_of(scenario, truth, truth + size * error)
        pieces = tally(pairs, MEASURED, scenario.config.predicted_frames)
        scores_of_box = aggregate(MEASURED, {0: pieces})
        scores_of_boxes = scores_of_box | scores_of_boxes
    return scores_of_boxes


JUDGED = [metric for metric in MEASURED if metric.direction is not Direction.NONE]


@pytest.mark.parametrize("name", [metric.name for metric in JUDGED])
def test_truth_against_itself_is_perfect_and_a_growing_error_a_growing_loss(
    name: str,
) -> None:
    """The truth as its own prediction gets exactly the perfect value: 0 or 1, and no
    frame undefined.

    The loss never falls while the error grows tenfold and more, and rises over all.
    """
    metric = METRICS[name]
    actual = scores(0.0)[name]
    expected = metric.perfect if name != "stable_frames" else 52.0
    assert actual.mean == expected
    assert actual.undefined == (0,)
    losses = []
    for size in (0.0, 0.1, 0.5, 2.5):
        mean = scores(size)[name].mean
        losses.append(metric.loss(mean))
    assert losses == sorted(losses)
    assert losses[-1] > losses[0]


def test_every_metric_has_a_value_but_for_expected_gaps() -> None:
    """No rope and no horizon of ten frames: no error of rope and none of ten frames."""
    everywhere = scores(0.1)
    assert set(everywhere) == {metric.name for metric in MEASURED}
    assert not any(math.isnan(one.mean) for one in everywhere.values())
    assert everywhere["vorticity_mse"].frames == tuple(range(2, 54))
    here = set(aggregate(ALL, {0: tallied()}))
    assert {"position_mse_jelly", "shape_error_jelly", "mse_avg_5"} <= here
    assert not here & {"position_mse_rope", "shape_error_rope", "mse_avg_10"}


OTHERS = Metric(
    name="enstrophy_error",
    family="vorticity",
    unit="1/frame^2",
    direction=Direction.LOWER,
    perfect=0.0,
    source="elsewhere",
    summary="a metric of another package",
    statistic=lambda pair: 1.0,
)
LISTED = [replace(OTHERS, name="listed", of=())]  # its statistic has no name
CLASHING = (replace(OTHERS, name="vorticity_mse", of=()),)
NO_METRIC = ("vorticity",)
NUMBER = 3
ROOTLESS = (replace(OTHERS, statistic=None, of=("velocity_mse", "nothing_known")),)


def with_entry_point(monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    """Pretend that another package registers an object."""
    point = EntryPoint(name="others", value=value, group=table_module.GROUP)
    monkeypatch.setattr(table_module, "list_entry_points", lambda group: [point])


def test_our_metrics_are_registered_as_those_of_others_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each family stands in the entry-point group, and loading it gives the same
    objects.

    A single metric of another package behind an entry point is scored like ours.
    """
    families = {}
    for point in entry_points(group="lagbench.metrics"):
        if point.value.startswith("lagbench."):
            families[point.name] = point.load()
    assert families == dict(FAMILIES)
    all_metrics = available()
    for name, metric in METRICS.items():
        assert all_metrics[name] is metric
    with_entry_point(monkeypatch, f"{__name__}:OTHERS")
    assert available()["enstrophy_error"] is OTHERS
    metrics = select(["enstrophy_error"])
    pieces = tally(pairs(), metrics, CONFIG.predicted_frames)
    scores = aggregate(metrics, {0: pieces})
    assert scores["enstrophy_error"].mean == 1.0


@pytest.mark.parametrize(
    "name",
    [
        "CLASHING",
        "NO_METRIC",
        "NUMBER",
        "ROOTLESS",
    ],
)
def test_a_bad_entry_point_is_left_out(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str
) -> None:
    """A name in use, no metric, or one of statistics that nothing measures: one warning
    names the package, and the other metrics are there. So it is with a module that
    would end the program, with exit code 0 and nothing done.
    """
    (tmp_path / "leaving.py").write_text("raise SystemExit")
    monkeypatch.syspath_prepend(tmp_path)
    value = name if ":" in name else f"{__name__}:{name}"
    with_entry_point(monkeypatch, value)
    package = value.partition(":")[0].split(".")[0]
    with pytest.warns(PluginWarning, match=f"package {package} ") as warnings:
        metrics = available()
    assert len(warnings) == 1
    assert value in str(warnings[0].message)
    assert metrics == dict(METRICS)


def of_function(pair: FramePair) -> float:
    """Two."""
    return 2.0


def test_a_metric_can_be_pickled(monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed one is the same object, or an error where its package is missing."""
    plain = replace(OTHERS, name="of_function", of=(), statistic=of_function)
    assert pickle.loads(pickle.dumps(plain)) == plain
    with monkeypatch.context() as patch:
        with_entry_point(patch, f"{__name__}:LISTED")
        for named in (*METRICS.values(), *LISTED):
            assert pickle.loads(pickle.dumps(named)) is named
        pickled = pickle.dumps(LISTED[0])
    with pytest.raises(UsageError, match="'listed'"):
        pickle.loads(pickled)


def test_selection_brings_what_a_metric_follows_from() -> None:
    """RMSE needs MSE, the energy ratio both energies."""
    assert {metric.name for metric in select(["vorticity_rmse", "energy_ratio"])} == {
        "vorticity_mse",
        "vorticity_rmse",
        "energy_predicted",
        "energy_true",
        "energy_ratio",
    }
    with pytest.raises(UsageError, match="vorticity_rmse"):
        select(["vorticity_rmsee"])


@pytest.mark.parametrize(
    "changes",
    [
        {"statistic": None, "of": ()},
        {"of": "vorticity_mse"},
        {"name": "My metric", "of": ()},
        {"name": "", "of": ()},
        {"name": "skill", "of": ()},
        {"name": "Ω", "of": ()},
    ],
)
def test_an_incomplete_metric_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        replace(OTHERS, **changes)


def moves(pair: FramePair) -> float:
    """Write into what other metrics read."""
    values = pair.prediction.velocity
    values -= 1.0
    return 0.0


def divides(*_: object) -> Any:
    """Fail."""
    return 1 / 0


@pytest.mark.parametrize(
    "broken",
    [
        {"statistic": divides},
        {"defined": divides},
        {"series": divides},
        {"series": np.sum},  # of another shape
        {"statistic": moves},
    ],
)
def test_a_metric_that_fails_is_named(broken: dict[str, Any]) -> None:
    metric = replace(OTHERS, **broken)
    with pytest.raises(WorkFailedError, match="enstrophy_error"):
        aggregate([metric], {0: tally(pairs(), [metric], CONFIG.predicted_frames)})
