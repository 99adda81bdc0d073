"""Skill against hand-worked ratios; shipped scores of references against measured."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from numpy.testing import assert_allclose
from score_bench import ScoreBench, straight

from lagbench.data.registry import Measured, Size, load
from lagbench.errors import DataError
from lagbench.metrics import METRICS, Score
from lagbench.references import references_of, shipped
from lagbench.references.shipped import (
    shipped_path,
    write_costs,
    write_shipped,
)
from lagbench.references.shipped import solver_seconds as solver_seconds_of
from lagbench.scoring import score as scoring
from lagbench.scoring.front import NoSpeedup, Speedup
from lagbench.scoring.measure_references import measure
from lagbench.scoring.score import measurable, speedup_beside
from lagbench.scoring.skill import compute_skill
from lagbench.scoring.task import SUBMISSION
from lagbench.submission import Header


def scored(
    values: list[float],
    metric: str = "vorticity_rmse",
    first: int = 0,
) -> Score:
    """Return a score with these values over scenarios."""
    count = len(values)
    scenarios = tuple(range(first, first + count))
    no_frames = np.empty((count, 0))
    undefined = (0,) * count
    means = np.array(values)
    return Score(METRICS[metric], scenarios, (), no_frames, means, undefined)


@pytest.mark.parametrize(
    ("values", "skill"),
    [
        ([0.5, 1.5], 0.75),
        ([0.0, 0.0], 1.0),
        ([6.0, 10.0], -1.0),
    ],
)
def test_skill_is_one_minus_the_ratio_of_means(
    values: list[float], skill: float
) -> None:
    """The mean of the best reference is 4."""
    references = {
        "persistence": scored([6.0, 6.0]),
        "frozen-field": scored([3.0, 5.0]),
    }
    result = compute_skill([scored(values)], references)
    assert result.reference == "frozen-field"
    assert result.value == skill


def test_scenarios_that_one_side_lacks_are_left_out() -> None:
    references = {"analog": scored([4.0, math.nan])}
    method = scored([1.0, 9.0])
    result = compute_skill([method], references)
    assert result.value == 0.75
    assert np.isnan(result.interval).all()


@pytest.mark.parametrize(
    "reference",
    [
        scored([math.nan, math.nan]),
        scored([0.0, 0.0]),
        scored([1.0, 1.0], first=7),
    ],
    ids=["undefined", "perfect", "other scenarios"],
)
def test_some_references_give_no_skill(reference: Score) -> None:
    method = scored([1.0, 1.0])
    assert compute_skill([method], {"analog": reference}) is None


@pytest.mark.parametrize("solver_seconds", [1.0, None])
def test_the_cost_of_predictions_is_brought_to_the_machine_of_the_solvers(
    solver_seconds: float | None,
) -> None:
    """`projection-2x` has the speedup 2 where our solver takes twice its time."""
    size = load().size("cavity", "mini")
    references = shipped(size)
    solver = references["projection-2x"]
    seconds = solver_seconds_of(size)
    assert seconds is not None
    header = Header(
        split="cavity",
        size="mini",
        dataset_version=size.version,
        dataset_sha256="0" * 64,
        method="solver",
        scenarios=size.subsets["test"],
        frames=(6,),
        particles=size.particles,
        seconds_per_frame=solver.seconds_per_frame / seconds,
        device=None,
        seed=None,
        parameters=None,
        training=None,
        diverged_at={},
        solver_seconds_per_frame=solver_seconds and 2.0 * solver_seconds,
    )
    score = solver.scores["vorticity_nrmse"]
    speedup = speedup_beside(header, size, score, references)
    if solver_seconds is None:
        assert speedup is NoSpeedup.NO_COST
    else:
        assert isinstance(speedup, Speedup)
        assert speedup.value == pytest.approx(2.0)


def test_the_interval_is_that_of_resampled_ratios() -> None:
    """SciPy's percentiles of the ratio, Student's widening aside, of 20 scenarios."""
    rng = np.random.default_rng(3)
    base = rng.gamma(9.0, size=20)
    ratio = 0.3 * rng.gamma(25.0, 0.04, size=20)
    method = ratio * base
    references = {"analog": scored(base.tolist())}
    score = scored(method.tolist())
    result = compute_skill([score], references)

    def skill_of(a: Any, b: Any, axis: int) -> Any:
        return 1.0 - a.mean(axis=axis) / b.mean(axis=axis)

    bootstrap = scipy.stats.bootstrap(
        (method, base),
        skill_of,
        paired=True,
        method="percentile",
        rng=np.random.default_rng(1),
    )
    student = scipy.stats.t.ppf(0.975, 19)
    normal = scipy.stats.norm.ppf(0.975)
    stretch = math.sqrt(20 / 19) * student / normal
    low, high = bootstrap.confidence_interval
    expected_low = result.value + stretch * (low - result.value)
    expected_high = result.value + stretch * (high - result.value)
    tolerance = 0.1 * (expected_high - expected_low)
    low, high = result.interval
    assert low == pytest.approx(expected_low, abs=tolerance)
    assert high == pytest.approx(expected_high, abs=tolerance)


def test_the_interval_of_skill_stays_below_one() -> None:
    """No ratio of means is negative in any draw of six scenarios.

    A perfect method is certain.
    """
    base = [1.0, 1.1, 0.9, 1.2, 0.8, 1.0]
    references = {"analog": scored(base)}
    wild = scored([0.01, 0.02, 0.01, 9.0, 0.03, 0.02])
    result = compute_skill([wild], references)
    low, high = result.interval
    assert low < result.value < high < 1.0

    perfect = scored([0.0] * 6)
    result = compute_skill([perfect], references)
    assert result.value == 1.0
    assert result.interval == (1.0, 1.0)
    few = scored([0.0] * 3)
    result = compute_skill([few], {"analog": scored(base[:3])})
    assert result.value == 1.0
    assert np.isnan(result.interval).all()


def test_seeds_widen_the_interval_of_skill() -> None:
    """Where only seeds scatter, the interval is theirs: Student's, two degrees."""
    base = np.full(12, 4.0)
    ratios = np.array([0.4, 0.5, 0.9])
    seeds = []
    for ratio in ratios:
        values = ratio * base
        seeds.append(scored(values.tolist()))
    references = {"analog": scored(base.tolist())}
    result = compute_skill(seeds, references)
    std = np.std(ratios, ddof=1)
    assert result.value == pytest.approx(0.4)
    assert result.std == pytest.approx(std)

    student = scipy.stats.t.ppf(0.975, 2)
    half_width = std / math.sqrt(3) * student
    low, high = result.interval
    # of the logarithm of the ratio
    width = math.log((1.0 - low) / (1.0 - high))
    expected = 2 * half_width / 0.6
    assert width == pytest.approx(expected, rel=0.15)
    alone = compute_skill(seeds[:1], references)
    low, high = alone.interval
    assert low == pytest.approx(0.6)
    assert high == pytest.approx(0.6)


References = dict[str, Any]


@pytest.fixture(scope="module")
def measured_references(bench: ScoreBench) -> References:
    """All references of the data set, measured once."""
    return measure(bench.size, bench.root)


SHA256 = "a" * 64
OTHER_SHA256 = "b" * 64


def record(size: Size, sha256: str = SHA256) -> Size:
    """Return a size as if its data set were recorded."""
    statistics = {
        "position_std": (0.3, 0.3),
        "velocity_std": (1e-3, 1e-3),
    }
    measured = Measured(
        dataset_sha256=sha256,
        subset_sha256={},
        scenario_sha256={},
        statistics=statistics,
        twin_floor=(),
    )
    return size.model_copy(update={"measured": measured})


def mean_at(score: Score, frame: int) -> float:
    """Return the mean over scenarios at a frame, or 0 where all are undefined."""
    values = score.at(frame)
    if not np.isfinite(values).any():
        return 0.0
    return float(np.nanmean(values))


def mean_curve(score: Score) -> Any:
    """Return the mean over scenarios in each frame."""
    return score.per_frame.mean(axis=0)


@pytest.mark.slow
def test_shipped_scores_are_the_measured_ones(
    bench: ScoreBench, measured_references: References, tmp_path: Path
) -> None:
    """Written and read again, values are equal to five digits, curves to three."""
    names = [reference.name for reference in references_of(bench.size)]
    assert list(measured_references) == names
    size = record(bench.size)
    path = write_shipped(
        size,
        measured_references,
        dataset_sha256=SHA256,
        reported=(15, 25),
        folder=tmp_path,
    )
    assert path == shipped_path(size, tmp_path)
    from_file = shipped(size, tmp_path)
    for name, reference in measured_references.items():
        for metric, expected in reference.scores.items():
            score = from_file[name].scores[metric]
            assert score.undefined == expected.undefined
            assert_allclose(score.values, expected.values, rtol=1e-4, atol=1e-12)
            if expected.metric.per_frame:
                mean = mean_at(score, 25)
                expected_mean = mean_at(expected, 25)
                assert mean == pytest.approx(expected_mean, rel=1e-3)

    frozen = from_file["frozen-field"]
    expected_scores = measured_references["frozen-field"].scores
    correlation = expected_scores["vorticity_pearson"].per_frame[:, -1]
    assert_allclose(frozen.correlation, correlation, rtol=1e-3)
    curve = mean_curve(frozen.scores["position_rmse"])
    expected_curve = mean_curve(expected_scores["position_rmse"])
    assert_allclose(curve, expected_curve, rtol=6e-3)


@pytest.mark.slow
def test_one_reference_measured_anew_leaves_the_others(
    bench: ScoreBench, measured_references: References, tmp_path: Path
) -> None:
    """Its scores change; the order, the others and all costs stay.

    One run has measured all costs, and that of the solver.
    """
    size = record(bench.size)
    options: dict[str, Any] = {
        "dataset_sha256": SHA256,
        "reported": (15,),
        "folder": tmp_path,
    }
    path = write_shipped(size, measured_references, **options)
    write_costs(size, {}, solver=0.5, folder=tmp_path)
    before = json.loads(path.read_text())
    analog = replace(
        measured_references["persistence"], name="analog", seconds_per_frame=9.0
    )
    write_shipped(size, {"analog": analog}, partial=True, **options)
    after = json.loads(path.read_text())

    assert list(after["floors"]) == list(before["floors"])
    analog_before = before["floors"].pop("analog")
    analog_after = after["floors"].pop("analog")
    persistence = before["floors"]["persistence"]
    assert analog_after["values"] == persistence["values"]
    cost_key = "seconds_per_frame"
    assert analog_after[cost_key] == analog_before[cost_key]
    assert after == before

    with pytest.raises(DataError):
        write_shipped(
            record(bench.size, OTHER_SHA256),
            {"analog": analog},
            partial=True,
            **options,
        )


@pytest.mark.slow
def test_scoring_takes_what_is_shipped(
    bench: ScoreBench,
    measured_references: References,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With shipped scores only the submission is measured, and the card is equal.

    Without them only the references that count are measured.
    """
    names = measurable(bench.size, bench.root)
    counting = {name: measured_references[name] for name in names}
    path = bench.submit(tmp_path / "predictions.nc", straight)
    measured = bench.evaluate(path)
    monkeypatch.setattr(scoring, "shipped", lambda size: counting)
    card = bench.evaluate(path)
    assert list(card.tallies) == [SUBMISSION]
    assert set(measured.tallies) == {SUBMISSION, *names}
    assert card.as_json() == measured.as_json()
