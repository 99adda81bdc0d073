"""Skill against hand-worked ratios, and shipped scores of floors against measured
ones.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.stats
from score_bench import ScoreBench, right, still, straight

from lagbench.data.registry import Measured, Size
from lagbench.errors import DataError, UsageError
from lagbench.metrics import METRICS, Score
from lagbench.references import REFERENCES, references_of, shipped
from lagbench.references.shipped import (
    shipped_path,
    write_shipped,
    write_solver_seconds,
)
from lagbench.references.table import NAIVE
from lagbench.scoring import references as references_of_scoring
from lagbench.scoring import score as scoring
from lagbench.scoring.card import SUBMISSION, ScoreCard
from lagbench.scoring.measure_references import measure_and_ship
from lagbench.scoring.references import (
    differences,
    measurable,
    measure,
    measured_sizes,
    remeasure,
    saved_folder,
)
from lagbench.scoring.score_file import read_statistics
from lagbench.scoring.skill import best_reference, compute_skill
from lagbench.scoring.tables import card_tables


def scored(
    values: list[float], metric: str = "vorticity_rmse", first: int = 0
) -> Score:
    """Return a score with these values over scenarios."""
    ids = tuple(range(first, first + len(values)))
    empty = np.empty((len(values), 0))
    return Score(METRICS[metric], ids, (), empty, np.array(values), (0,) * len(values))


def test_skill_is_one_minus_the_ratio_of_means() -> None:
    """Means 1 and 4: skill 3/4; a perfect score has 1, twice the reference's -1.

    The coarse solver knows the equations: however good, skill is measured against
    references that do not; unknown ones do not count. A scenario that is undefined in
    one of the two is left out of both.
    """
    references = {
        "persistence": scored([6.0, 6.0]),
        "frozen-field": scored([3.0, 5.0]),
    }
    for values, expected in (
        ([0.5, 1.5], 0.75),
        ([0.0, 0.0], 1.0),
        ([6.0, 10.0], -1.0),
    ):
        result = compute_skill([scored(values)], references)
        assert result.reference == "frozen-field"
        assert result.value == expected

    references = {
        "analog": scored([2.0]),
        "coarse-solver": scored([0.1]),
        "unknown": scored([0.1]),
    }
    counting = {name: references[name] for name in NAIVE.intersection(references)}
    assert best_reference(counting) == "analog"

    partial = {"analog": scored([4.0, math.nan])}
    result = compute_skill([scored([1.0, 9.0])], partial)
    assert result.value == 0.75
    assert all(math.isnan(bound) for bound in result.interval)


def test_what_skill_and_its_interval_need() -> None:
    """No reference, an undefined one, a perfect one, or other scenarios: no skill.

    The same holds for a metric of which more is better. A ratio that is 1/2 in every
    scenario is certain; three scenarios have no interval.
    """
    method = scored([1.0, 1.0])
    assert compute_skill([method], {}) is None
    undefined = scored([math.nan] * 2)
    perfect = scored([0.0, 0.0])
    elsewhere = scored([1.0, 1.0], first=7)
    for reference in (undefined, perfect, elsewhere):
        assert compute_skill([method], {"analog": reference}) is None
    pearson = scored([0.5, 0.5], "vorticity_pearson")
    assert compute_skill([pearson], {"analog": pearson}) is None

    base = scored([1.0, 2.0, 5.0, 3.0])
    half = scored([0.5, 1.0, 2.5, 1.5])
    certain = compute_skill([half], {"analog": base})
    assert certain.value == 0.5
    assert certain.interval == (0.5, 0.5)
    short_base = scored([1.0, 2.0, 5.0])
    few = compute_skill([scored([1.0, 1.0, 4.0])], {"analog": short_base})
    assert all(math.isnan(bound) for bound in few.interval)


def test_the_interval_is_that_of_resampled_ratios() -> None:
    """SciPy's percentiles of the ratio, Student's widening aside, of 20 scenarios."""
    rng = np.random.default_rng(3)
    base = rng.gamma(9.0, size=20)
    method = 0.3 * base * rng.gamma(25.0, 0.04, size=20)
    references = {"analog": scored(base.tolist())}
    result = compute_skill([scored(method.tolist())], references)

    def skill_of(a: Any, b: Any, axis: int) -> Any:
        return 1.0 - a.mean(axis=axis) / b.mean(axis=axis)

    bootstrap = scipy.stats.bootstrap(
        (method, base),
        skill_of,
        paired=True,
        method="percentile",
        rng=np.random.default_rng(1),
    )
    student = scipy.stats.t.ppf(0.975, 19) / scipy.stats.norm.ppf(0.975)
    stretch = math.sqrt(20 / 19) * student
    expected = [
        result.value + stretch * (bound - result.value)
        for bound in bootstrap.confidence_interval
    ]
    width = expected[1] - expected[0]
    assert result.interval == pytest.approx(expected, abs=0.1 * width)


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

    perfect = compute_skill([scored([0.0] * 6)], references)
    assert perfect.value == 1.0
    assert perfect.interval == (1.0, 1.0)
    few = compute_skill([scored([0.0] * 3)], {"analog": scored(base[:3])})
    assert few.value == 1.0
    assert all(math.isnan(bound) for bound in few.interval)


def test_seeds_widen_the_interval_of_skill() -> None:
    """Where only seeds scatter, the interval is theirs: Student's, two degrees."""
    base = np.full(12, 4.0)
    ratios = np.array([0.4, 0.5, 0.9])
    seeds = [scored((ratio * base).tolist()) for ratio in ratios]
    references = {"analog": scored(base.tolist())}
    result = compute_skill(seeds, references)
    std = np.std(ratios, ddof=1)
    assert result.value == pytest.approx(0.4)
    assert result.std == pytest.approx(std)

    half_width = std / math.sqrt(3) * scipy.stats.t.ppf(0.975, 2)
    low, high = result.interval
    width = math.log((1.0 - low) / (1.0 - high))  # of the logarithm of the ratio
    assert width == pytest.approx(2 * half_width / 0.6, rel=0.15)
    alone = compute_skill(seeds[:1], references)
    assert alone.interval == pytest.approx((0.6, 0.6))


@pytest.fixture(scope="module")
def measured_references(bench: ScoreBench) -> dict[str, Any]:
    """All floors of it, measured once."""
    return measure(bench.size, bench.root)


def recorded(size: Size, sha256: str = "a" * 64) -> Size:
    """Return a size as if its data set were recorded."""
    statistics = {"position_std": (0.3, 0.3), "velocity_std": (1e-3, 1e-3)}
    hashes = {"dataset_sha256": sha256, "subset_sha256": {}, "scenario_sha256": {}}
    measured = Measured(**hashes, statistics=statistics, twin_floor=())
    return size.model_copy(update={"measured": measured})


def test_shipped_scores_are_the_measured_ones(
    bench: ScoreBench, measured_references: dict[str, Any], tmp_path: Path
) -> None:
    """Written and read again they are equal to five digits, curves to three; another
    data set has none.
    """
    found = measured_references
    assert list(found) == [floor.name for floor in references_of(bench.size)]
    size = recorded(bench.size)
    frames = (15, 25)
    path = write_shipped(
        size, found, dataset_sha256="a" * 64, reported=frames, folder=tmp_path
    )
    held = shipped(size, tmp_path)
    assert differences(held, found) == {}
    for name, floor in found.items():
        for metric, score in floor.scores.items():
            told = held[name].scores[metric]
            assert told.undefined == score.undefined
            if score.metric.per_frame:
                at = [
                    np.nanmean(s.at(25)) if np.isfinite(s.at(25)).any() else 0.0
                    for s in (told, score)
                ]
                assert at[0] == pytest.approx(at[1], rel=1e-3)
    before = found["frozen-field"]
    after = held["frozen-field"]
    last = before.scores["vorticity_pearson"].per_frame[:, -1]
    np.testing.assert_allclose(after.correlation, last, rtol=1e-3)
    curves = [
        side.scores["position_rmse"].per_frame.mean(axis=0) for side in (after, before)
    ]
    np.testing.assert_allclose(*curves, rtol=6e-3)
    assert path == shipped_path(size, tmp_path)
    assert shipped(recorded(bench.size, "b" * 64), tmp_path) is None
    assert shipped(bench.size, tmp_path) is None


def test_one_floor_measured_anew_leaves_the_others(
    bench: ScoreBench, measured_references: dict[str, Any], tmp_path: Path
) -> None:
    """Its scores change; order, the others, its cost and the solver's stay, which one
    run has measured.
    """
    size = recorded(bench.size)
    known = {"dataset_sha256": "a" * 64, "reported": (15,), "folder": tmp_path}
    path = write_shipped(size, measured_references, **known)
    write_solver_seconds(size, 0.5, tmp_path)
    before = json.loads(path.read_text())
    other = replace(
        measured_references["persistence"], name="analog", seconds_per_frame=9.0
    )
    write_shipped(size, {"analog": other}, partial=True, **known)
    after = json.loads(path.read_text())
    assert list(after["floors"]) == list(before["floors"])
    assert (
        after["floors"]["analog"].pop("values")
        == before["floors"]["persistence"]["values"]
    )
    assert (
        after["floors"]["analog"]["seconds_per_frame"]
        == before["floors"]["analog"]["seconds_per_frame"]
    )
    for held in (before, after):
        del held["floors"]["analog"]
    assert after == before
    write_shipped(size, {"analog": other}, **known)
    assert list(json.loads(path.read_text())["floors"]) == ["analog"]
    with pytest.raises(DataError):
        write_shipped(
            recorded(bench.size, "b" * 64), {"analog": other}, partial=True, **known
        )


def test_a_floor_that_a_data_set_lacks_is_not_measured(
    bench: ScoreBench, tmp_path: Path
) -> None:
    """A coarse solver at tiny: nothing is written."""
    with pytest.raises(UsageError):
        measure_and_ship(
            recorded(bench.size), bench.root, folder=tmp_path, names=["coarse-solver"]
        )
    assert not list(tmp_path.iterdir())


def test_a_forged_shipped_score_is_found(
    bench: ScoreBench,
    measured_references: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One value changed by 1 % differs from what is measured again; so does a floor
    that is left out.
    """
    found = {
        name: measured_references[name] for name in ("persistence", "constant-velocity")
    }
    size = recorded(bench.size)
    path = write_shipped(
        size, found, dataset_sha256="a" * 64, reported=(15,), folder=tmp_path
    )
    said = json.loads(path.read_text())
    said["floors"]["persistence"]["values"]["position_rmse"][1] *= 1.01
    del said["floors"]["constant-velocity"]
    path.write_text(json.dumps(said))
    unlike = differences(shipped(size, tmp_path), found)
    assert unlike["persistence"] == ("position_rmse",)
    assert set(unlike["constant-velocity"]) == set(found["constant-velocity"].scores)

    assert [
        size.name for size in measured_sizes(bench.root, registry=bench.registry)
    ] == [bench.size.name]
    held = dict(measured_references)
    monkeypatch.setattr(references_of_scoring, "shipped", lambda size: held)
    assert remeasure(bench.size, bench.root) == (tuple(held), {})
    monkeypatch.setattr(
        references_of_scoring, "measure", lambda *_, **__: measured_references
    )
    still = held["persistence"]
    score = still.scores["position_rmse"]
    forged = {
        **still.scores,
        "position_rmse": replace(score, values=1.01 * score.values),
    }
    held["persistence"] = replace(still, scores=forged)
    assert remeasure(bench.size, bench.root)[1] == {"persistence": ("position_rmse",)}


def test_an_interrupted_measurement_goes_on(
    bench: ScoreBench, copied: Callable[[], Path]
) -> None:
    """What is kept is taken as it is: a file altered on purpose shows in the second
    run.
    """
    size = recorded(bench.size)
    root = copied()
    first = measure(size, root, names=["persistence"], resume=True)
    kept = sorted(saved_folder(size, root).glob("*.npz"))
    assert len(kept) == len(size.subsets["test"])
    with np.load(kept[0]) as held:
        values = dict(held)
    np.savez(kept[0], **{**values, "total": 4.0 * values["total"]})
    again = measure(size, root, names=["persistence"], resume=True)
    fresh = measure(size, root, names=["persistence"])
    one, two, three = (
        m["persistence"].scores["position_mse"].values for m in (first, again, fresh)
    )
    np.testing.assert_allclose(two[0], 4.0 * one[0])
    np.testing.assert_array_equal(one, three)


def test_scoring_takes_what_is_shipped(
    bench: ScoreBench,
    measured_references: dict[str, Any],
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


def test_skill_stands_in_the_card(bench: ScoreBench, tmp_path: Path) -> None:
    """The truth has skill 1; persistence has none above 0; first row and JSON say the
    same.
    """
    perfect = bench.evaluate(bench.submit(tmp_path / "right.nc", right))
    standing: ScoreCard = bench.score(bench.submit(tmp_path / "still.nc", still))
    assert perfect.skill.value == 1.0
    assert standing.skill.value <= 0.0
    said = standing.as_json()["skill"]
    assert said["floor"] == standing.skill.reference
    assert REFERENCES[said["floor"]].counts
    assert said["value"] == pytest.approx(standing.skill.value)
    again = read_statistics(standing.files[1]).skill()
    assert again.reference == standing.skill.reference
    assert again.value == standing.skill.value
    assert next(iter(card_tables(standing))).rows[0][0].startswith("skill")
