"""The table of metrics entry by entry, and the way from frames to scores."""

from __future__ import annotations

import functools
import itertools
import math
import pickle
import re
from collections.abc import Callable
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
from lagbench.data.layout import format_ids
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
from lagbench.metrics.metric import FirstFrames, last
from lagbench.metrics.metric import metric as make_metric

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


def bytes_of(tally: Tally) -> list[bytes]:
    """Return the bytes of all arrays of a tally."""
    arrays = (tally.total, tally.weight, tally.undefined)
    return [array.tobytes() for array in arrays]


def same_bits(first: Tally, second: Tally) -> bool:
    """Tell whether two tallies hold the same bytes."""
    return bytes_of(first) == bytes_of(second)


def of_pearson(*values: float) -> Tally:
    """Return a tally of correlations at frames 2, 3, ..."""
    name = "vorticity_pearson"
    numbered = {}
    for frame, value in enumerate(values, start=2):
        numbered[frame] = {name: value}
    return Tally.of([name], list(numbered), numbered)


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


@pytest.mark.parametrize(
    ("name", "other"),
    [
        ("stable_frames", "vorticity_pearson"),
        ("mse_avg", "attribute_mse"),
        ("active_frames", ".values"),
    ],
)
def test_a_number_of_a_rollout_has_no_value_in_single_frames(
    name: str, other: str
) -> None:
    """The message names what has one."""
    scores = aggregate(ALL, {0: tallied()})
    frame = scores[name].frames[-1]
    for call in (scores[name].at, scores[name].interval_at):
        with pytest.raises(UsageError) as caught:
            call(frame)
        assert other in str(caught.value.fix)


@pytest.mark.parametrize("frame", [999, -1, "3", None])
def test_a_frame_that_is_not_predicted_has_no_value(frame: Any) -> None:
    rmse = aggregate(ALL, {0: tallied()})["position_rmse"]
    with pytest.raises(UsageError) as caught:
        rmse.at(frame)
    assert format_ids(rmse.frames) in str(caught.value.expected)


def test_a_wrong_name_of_a_metric_is_a_key_error_with_the_nearest_one() -> None:
    scores = aggregate(ALL, {0: tallied()})
    with pytest.raises(KeyError, match="did you mean 'vorticity_nrmse'"):
        scores["vorticty_nrmse"]
    assert "vorticty_nrmse" not in scores
    assert scores.get("vorticty_nrmse") is None


def test_undefined_frames_are_left_out_and_counted() -> None:
    """Correlations 1, NaN, 0.6: mean 0.8 of two, one undefined; stable for one defined
    frame.

    One good frame, then 89 at rest without a correlation: one stable frame, not 90.
    """
    tallies = {3: of_pearson(1.0, math.nan, 0.6)}
    correlation = score(METRICS["vorticity_pearson"], tallies)
    assert correlation.mean == pytest.approx(0.8)
    assert correlation.undefined == (1,)
    assert math.isnan(correlation.at(3)[0])
    stable = score(METRICS["stable_frames"], tallies)
    assert stable.mean == 1.0

    at_rest = [math.nan] * 89
    tallies = {3: of_pearson(0.99, *at_rest)}
    still = score(METRICS["stable_frames"], tallies)
    assert still.mean == 1.0
    assert still.undefined == (89,)


UNDEFINED = (math.nan, math.nan)


@pytest.mark.parametrize(
    ("values", "mean", "undefined"),
    [
        # scenario 4 has no correlation: the mean is that of scenario 2, in id order
        ({4: UNDEFINED, 2: (0.5, 0.7)}, 0.6, (0, 2)),
        # scenario means 0.6 and 1.0 of two and of one defined frame: 0.8, not (0.5 +
        # 0.7 + 1.0) / 3
        ({0: (0.5, 0.7), 1: (math.nan, 1.0)}, 0.8, (0, 1)),
        ({0: (0.5, 0.7), 1: (0.8, math.nan), 2: UNDEFINED}, 0.7, (0, 1, 2)),
    ],
)
def test_means_over_frames_come_before_those_over_scenarios(
    values: dict[int, tuple[float, float]],
    mean: float,
    undefined: tuple[int, ...],
) -> None:
    """Undefined scenarios are left out; the interval is the bootstrap of the scenarios'
    values.
    """
    tallies = {}
    for scenario, correlations in values.items():
        tallies[scenario] = of_pearson(*correlations)
    correlation = score(METRICS["vorticity_pearson"], tallies)
    assert correlation.scenarios == tuple(sorted(values))
    assert correlation.undefined == undefined
    assert correlation.mean == pytest.approx(mean)
    interval = bootstrap_interval(correlation.values)
    assert_equal(correlation.interval, interval)


@pytest.mark.parametrize("holes", [0, 3])
def test_means_of_many_frames_have_the_bits_of_one_at_a_time(holes: int) -> None:
    """However many scenarios are reduced at once; 1201 frames are summed in blocks."""
    rng = np.random.Generator(np.random.PCG64(5))
    values = 10.0 ** rng.uniform(-8, 8, (5, 1201))
    values[0, :holes] = math.nan
    tallies = {}
    means = []
    for scenario, row in enumerate(values):
        tallies[scenario] = of_pearson(*row)
        is_defined = ~np.isnan(row)
        defined = row[is_defined].copy()
        means.append(np.mean(defined))
    correlation = score(METRICS["vorticity_pearson"], tallies)
    assert_array_equal(correlation.values, means)


def test_a_horizon_beyond_the_series_is_undefined() -> None:
    """The mean of the first five of three frames does not exist; of the first two it
    does.
    """
    series = np.arange(3.0)
    assert math.isnan(FirstFrames(5)(series))
    assert FirstFrames(2)(series) == 0.5
    assert FirstFrames(2, last)(series) == 1.0


def test_tallies_add() -> None:
    """A worker that counted as lost and comes back adds weight, not error. Other frames
    or statistics are refused, and so is a value without a place.
    """
    twice = tallied() + tallied()
    once = tallied()
    for name in twice.names:
        assert_array_equal(twice.series(name), once.series(name))
    with pytest.raises(UsageError):
        of_pearson(0.1) + of_pearson(0.1, 0.2)
    values_by_frame = {3: {"vorticity_mse": 1.0}}
    with pytest.raises(UsageError):
        Tally.of(["vorticity_mse"], [2], values_by_frame)


NAMES = sorted(METRICS)
MEASURED = select(known=METRICS)  # Sinkhorn, optional and slow, has tests of its own
LENGTHS = re.compile(
    r"(1|%|nat|frame|(mass(\^2)? )?length(\^[24])?(/frame(\^[24])?)?|1/frame(\^2)?)"
)
SOURCES = re.compile(
    r"Eqs?\. \d|Figs?\. \d|section \d|.* \(?(19|20)\d\d\b|docs/scoring\.md"
)
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


@pytest.mark.parametrize("name", NAMES)
def test_every_metric_has_a_full_description(name: str) -> None:
    """Name, family, unit, direction and source are well formed; the summary is one line
    without a stop.
    """
    metric = METRICS[name]
    assert metric.name == name
    assert re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", name)
    assert metric in FAMILIES[metric.family]
    assert LENGTHS.fullmatch(metric.unit), metric.unit
    assert SOURCES.match(metric.source)
    assert re.fullmatch(r"[A-Z0-9].{7,98}[^.]", metric.summary)
    for needed in metric.of:
        assert needed in METRICS
    if metric.direction is Direction.NONE:
        assert metric.perfect is None


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


def test_the_metrics_of_the_thesis_and_of_the_docs_are_complete() -> None:
    """Every metric of docs/scoring.md has an entry, and this rollout has its value."""
    scores_of_rollout = scores(0.1)
    assert set(scores_of_rollout) == {metric.name for metric in MEASURED}
    for actual in scores_of_rollout.values():
        assert not math.isnan(actual.mean)
    mse = scores_of_rollout["vorticity_mse"]
    assert mse.per_frame.shape == (1, 52)
    assert mse.frames == tuple(range(2, 54))
    expected = set()
    for quantity in ("position", "velocity", "vorticity"):
        expected |= {f"{quantity}_mse", f"{quantity}_mae", f"{quantity}_rmse"}
    for name in ("pearson", "kl", "kl_hist", "kl_hist_abs", "w1"):
        expected.add(f"vorticity_{name}")
    for horizon in (1, 5, 10, 20, 50):
        expected.add(f"mse_avg_{horizon}")
    expected |= {
        "energy_ratio",
        "energy_retention",
        "energy_error",
        "momentum_error",
        "divergence_rms",
        "angular_momentum_error",
        "density_rmse",
        "sliced_w2",
        "sinkhorn_pot",
        "attribute_mse",
        "mse_avg",
        "mse_end",
        "stable_frames",
        "shape_error",
        "connectivity",
    }
    assert expected <= set(METRICS)
    prefix = "vorticity_residual_"
    residual = set()
    for name in METRICS:
        if name.startswith(prefix):
            residual.add(name.removeprefix(prefix))
    assert residual == {
        "mean",
        "std",
        "max",
        "slope",
        "p05",
        "p25",
        "p50",
        "p75",
        "p95",
    }
    # Expected gaps are no scores: the rollout of the tallies has no rope, and no
    # horizon of ten frames.
    actual = aggregate(ALL, {0: tallied()})
    assert {"position_mse_jelly", "shape_error_jelly", "mse_avg_5"} <= set(actual)
    assert not {
        "position_mse_rope",
        "shape_error_rope",
        "position_mse_snow",
        "mse_avg_10",
    } & set(actual)


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


@make_metric(unit="1", source="none")
def decorated(pair: FramePair) -> float:
    """One."""
    return 1.0


def of_function(pair: FramePair) -> float:
    """Two."""
    return 2.0


OF_FUNCTION = replace(OTHERS, name="of_function", of=(), statistic=of_function)


def test_a_metric_can_be_pickled(monkeypatch: pytest.MonkeyPatch) -> None:
    """One of lagbench or of an installed package comes back as the same object.

    So does a decorated function of a script. One of a plain function comes back equal.
    """
    with_entry_point(monkeypatch, f"{__name__}:LISTED")
    for named in (*METRICS.values(), *LISTED, decorated):
        assert pickle.loads(pickle.dumps(named)) is named
    assert pickle.loads(pickle.dumps(OF_FUNCTION)) == OF_FUNCTION


def test_a_pickled_metric_whose_package_is_missing_is_a_usage_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        with_entry_point(patch, f"{__name__}:LISTED")
        pickled = pickle.dumps(LISTED[0])
    with pytest.raises(UsageError) as caught:
        pickle.loads(pickled)
    assert caught.value.got == "'listed'"


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


def test_selection_brings_what_a_metric_follows_from() -> None:
    """RMSE needs MSE, the energy ratio both energies; unknown names list the nearest.

    Neither a statistic nor a source of one, or a target without a value, is a mistake.
    """
    names = {metric.name for metric in select(["vorticity_rmse", "energy_ratio"])}
    assert names == {
        "vorticity_mse",
        "vorticity_rmse",
        "energy_predicted",
        "energy_true",
        "energy_ratio",
    }
    with pytest.raises(UsageError):
        select(["vorticity_rmsee"])
    for changes in (
        {"statistic": None, "of": ()},
        {"direction": Direction.TARGET, "perfect": None},
        {"direction": "sideways"},
        {"of": "vorticity_mse"},
        {"of": 5},
        {"name": "My metric", "of": ()},
        {"name": "", "of": ()},
        {"name": "skill", "of": ()},
        {"name": "Ω", "of": ()},
    ):
        with pytest.raises(UsageError):
            replace(OTHERS, **changes)
    # as a package may write it
    in_words = replace(OTHERS, direction="higher")
    assert in_words.direction is Direction.HIGHER


def test_a_metric_that_fails_is_named() -> None:
    """The statistic, its condition and the series over frames."""

    def fail(*_: object) -> float:
        raise ZeroDivisionError

    for what in ("statistic", "defined"):
        with pytest.raises(WorkFailedError, match="enstrophy_error"):
            replace(OTHERS, **{what: fail}).measure(pairs()[0])
    with pytest.raises(WorkFailedError, match="enstrophy_error"):
        replace(OTHERS, series=fail).per_frame_from(np.ones(3))
    with pytest.raises(WorkFailedError, match="shape"):
        replace(OTHERS, series=np.sum).per_frame_from(np.ones(3))


@pytest.mark.parametrize(
    "read",
    [
        lambda pair: pair.truth.position,
        lambda pair: pair.prediction.velocity,
        lambda pair: pair.truth.fields.velocity,
        lambda pair: pair.predicted_vorticity,
    ],
)
def test_a_metric_cannot_change_what_other_metrics_read(
    read: Callable[[FramePair], Floats],
) -> None:
    """A function that writes in place is an error of its metric."""

    def move(pair: FramePair) -> float:
        values = read(pair)
        values -= 1.0
        return float(values.mean())

    pair = pairs()[0]
    before = read(pair).copy()
    with pytest.raises(WorkFailedError, match="read-only"):
        replace(OTHERS, statistic=move).measure(pair)
    assert np.array_equal(read(pair), before)
