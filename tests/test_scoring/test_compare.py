"""Comparing submissions: against hand-worked p-values and both ways of naming them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from score_bench import ScoreBench, half_right, still, straight

from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.metrics import differ
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.compare import compare
from lagbench.scoring.tables import (
    card_tables,
    comparison_lines,
    comparison_tables,
)

Folders = dict[str, Path]

ONES = [1.0] * 6
TWOS = [2.0] * 6


@pytest.fixture(scope="module")
def scored(bench: ScoreBench, tmp_path_factory: pytest.TempPathFactory) -> Folders:
    """Folders of two scored submissions."""
    methods = {
        "still": still,
        "straight": straight,
    }
    folders = {}
    for name, predict in methods.items():
        folder = tmp_path_factory.mktemp(name)
        path = folder / "predictions.nc"
        bench.submit(path, predict, method=name)
        bench.score(path)
        folders[name] = folder
    return folders


def rows_of(values: Sequence[object], undefined: Any = None) -> dict[str, Any]:
    """Return the rows of a scores.json with one metric."""
    if undefined is None:
        undefined = [0] * len(values)
    metric = {"values": values, "undefined": undefined}
    return {"submission": {"mse_avg": metric}}


def publish(folder: Path, values: list[float], *, method: str, **changes: Any) -> Path:
    """Write a scores.json of one metric with these values per scenario."""
    scenarios = list(range(len(values)))
    content = {
        "lagbench_scores": 1,
        "split": "cavity",
        "size": "full",
        "dataset_version": "1.0.0",
        "dataset_sha256": "0" * 64,
        "method": method,
        "predictions_sha256": method,
        "task": {"scenarios": scenarios},
        "ranking_metric": "mse_avg",
        "rows": rows_of(values),
    }
    path = folder / method / "scores.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(content | changes))
    return path


def publish_seeds(
    folder: Path,
    rows: Iterable[Iterable[float]],
    method: str,
    **changes: Any,
) -> Path:
    """Write a folder of the seeds of a method and return it."""
    for seed, values in enumerate(rows):
        own_hash = {"predictions_sha256": f"{method}{seed}"}
        seed_folder = folder / str(seed)
        path = publish(
            seed_folder,
            list(values),
            method=method,
            **(own_hash | changes),
        )
        path.rename(seed_folder / "scores.json")
    return folder


def test_six_wins_of_six_are_significant(tmp_path: Path) -> None:
    """The p-value is 2 / 2^6 = 0.03125."""
    a = publish(tmp_path, [1, 2, 3, 4, 5, 6], method="a")
    b = publish(tmp_path, [2, 3, 4, 5, 6, 8], method="b")
    result = compare(a, b)
    metric = result.metrics["mse_avg"]
    p = metric.test.p
    assert p == pytest.approx(2 / 64)
    assert metric.test.difference == pytest.approx(-7 / 6)
    assert metric.first == pytest.approx(21 / 6)
    assert metric.second == pytest.approx(28 / 6)
    assert result.seeds == (1, 1)
    assert result.verdict.startswith("mse_avg: a is better (p = 0.0312")
    assert compare(b, a).verdict == result.verdict
    assert result.verdict in repr(result)

    table = result.to_dataframe().set_index("metric")
    row = table.loc["mse_avg"]
    assert row["side"] == "better"
    assert row["p"] == pytest.approx(2 / 64)
    assert row["difference"] == pytest.approx(row["first"] - row["second"])
    assert row["low"] < row["difference"] < row["high"]
    assert row["significant"]


def test_a_folder_of_seeds_is_a_method(tmp_path: Path) -> None:
    """The test takes all seeds of both methods; means are over seeds."""
    rng = np.random.default_rng(0)
    a = rng.gamma(9.0, size=(3, 8))
    b = rng.gamma(12.0, size=(2, 8))
    a_folder = publish_seeds(tmp_path / "a", a, "a")
    b_folder = publish_seeds(tmp_path / "b", b, "b")
    result = compare(a_folder, b_folder)
    metric = result.metrics["mse_avg"]
    assert result.seeds == (3, 2)
    assert metric.test.seeds == (3, 2)
    assert metric.first == pytest.approx(a.mean())
    assert metric.test.p == differ(a, b)
    assert result.as_json()["seeds"] == [3, 2]
    assert "3 and 2 seeds" in result.verdict
    assert "weights" not in result.verdict

    # Against one seed the verdict speaks of its weights.
    one_seed = publish_seeds(tmp_path / "c", b[:1], "c")
    assert "weights" in compare(a_folder, one_seed).verdict


OTHER_IDS = {"task": {"scenarios": list(range(100, 106))}}
UNLIKE: list[tuple[dict[str, Any], type[Exception]]] = [
    ({"split": "fluid"}, UsageError),
    ({"size": "mini"}, UsageError),
    ({"dataset_sha256": "1" * 64}, DataError),
    (OTHER_IDS, UsageError),
]


@pytest.mark.parametrize(("changes", "error"), UNLIKE)
def test_other_data_are_not_compared(
    tmp_path: Path, changes: dict[str, Any], error: type[Exception]
) -> None:
    a = publish(tmp_path, ONES, method="a")
    b = publish(tmp_path, ONES, method="b", **changes)
    with pytest.raises(error):
        compare(a, b)


@pytest.mark.parametrize(
    "changes",
    [
        {"predictions_sha256": "a0"},  # one file twice is one training
        {"method": "b", "predictions_sha256": "b"},
        {"predictions_sha256": "b", **OTHER_IDS},
    ],
)
def test_what_is_no_seed_of_a_method_is_refused(
    tmp_path: Path, changes: dict[str, Any]
) -> None:
    """On either side."""
    other = publish(tmp_path, TWOS, method="other")
    seeds = publish_seeds(tmp_path / "seeds", [ONES], "a")
    path = publish(seeds, ONES, method="a")
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    for pair in ((seeds, other), (other, seeds)):
        with pytest.raises(UsageError):
            compare(*pair)


@pytest.mark.slow
def test_folders_files_and_predictions_give_the_same_result(
    bench: ScoreBench, scored: Folders
) -> None:
    """A predictions.nc is scored on the way."""
    first = scored["still"]
    second = scored["straight"]
    by_folder = compare(first, second)
    expected = by_folder.as_json()
    assert by_folder.first == "still"

    by_json = compare(first / "scores.json", second / "scores.json")
    assert by_json.as_json() == expected
    by_netcdf = compare(first / "scores.nc", second / "scores.nc")
    assert by_netcdf.as_json() == expected
    by_predictions = compare(
        first / "predictions.nc",
        second / "predictions.nc",
        root=bench.root,
        registry=bench.registry,
    )
    assert by_predictions.as_json() == expected


def test_the_short_table_leads_with_the_ranking_metric(
    scored: Folders,
) -> None:
    """All metrics come on request, and none that is unknown."""
    result = compare(scored["still"], scored["straight"])
    assert next(iter(result.metrics)) == result.ranking == "vorticity_nrmse"
    short, means = comparison_tables(result)
    whole, _ = comparison_tables(result, every=True)
    assert len(means.rows) == len(short.rows) < len(whole.rows) == len(result.metrics)
    result = compare(scored["still"], scored["straight"], metrics=["mse_end"])
    assert list(result.metrics) == ["vorticity_nrmse", "mse_end"]
    with pytest.raises(UsageError):
        compare(scored["still"], scored["straight"], metrics=["vorticity_rsme"])


@pytest.fixture
def entries(scored: Folders, bench: ScoreBench, tmp_path: Path) -> Path:
    """A leaderboard with one entry, named ``moving``, for the data of the bench."""
    board = tmp_path / "board"
    folder = board / "scores" / bench.size.split / bench.size.name
    folder.mkdir(parents=True)
    (board / "submissions").mkdir()
    scores = scored["straight"] / "scores.nc"
    shutil.copy(scores, folder / "moving.nc")
    return board


@pytest.mark.slow
def test_an_entry_of_the_leaderboard_goes_by_its_name(
    scored: Folders, entries: Path, bench: ScoreBench
) -> None:
    """On the right its name is enough; on the left the data set belongs to it."""
    result = compare(scored["still"], "moving", board=entries)
    assert result.second == "straight"
    metric = result.metrics[result.ranking]
    assert metric.side == "worse"
    name = f"{bench.size.split}/{bench.size.name}/moving"
    swapped = compare(name, scored["still"], board=entries)
    metric = swapped.metrics[swapped.ranking]
    assert metric.side == "better"
    assert compare(name, "moving", board=entries).same_predictions
    with pytest.raises(UsageError):
        compare(f"{name}s", "persistence", board=entries)


WORSE_AND_BETTER = [0.5, 1.5, 1.5, 1.5, 1.5, 1.5]


def side_of(first: Path, second: Path) -> str:
    """Return what the table says of the first method beside the second."""
    result = compare(first, second)
    table, *_ = comparison_tables(result)
    column = table.columns.index(f"{result.first}\nis")
    return table.rows[0][column]


def test_a_column_says_which_method_is_better(tmp_path: Path) -> None:
    """A difference that may be chance has a question mark."""
    a = publish(tmp_path, ONES, method="a")
    b = publish(tmp_path, TWOS, method="b")
    c = publish(tmp_path, WORSE_AND_BETTER, method="c")
    assert side_of(a, b) == "better"
    assert side_of(b, a) == "worse"
    assert side_of(a, c) == "better?"
    d = publish(tmp_path, ONES, method="d")
    assert side_of(a, d) == "same"


def test_rounding_makes_no_method_better(tmp_path: Path) -> None:
    """Sums in another order differ in the last digits, in all scenarios alike."""
    a = publish(tmp_path, ONES, method="a")
    b = publish(tmp_path, [1.0 - 1e-13] * 6, method="b")
    assert side_of(a, b) == "same"
    result = compare(a, b)
    assert result.metrics["mse_avg"].test.difference == 0.0
    assert "no difference" in result.verdict
    c = publish(tmp_path, [1.0 - 1e-9] * 6, method="c")
    assert side_of(a, c) == "worse"


def test_few_scenarios_decide_nothing(tmp_path: Path) -> None:
    """Five scenarios cannot reach 5 %: neither column nor verdict claims anything."""
    a = publish(tmp_path, ONES[:5], method="a")
    b = publish(tmp_path, TWOS[:5], method="b")
    assert side_of(a, b) == "too few"
    result = compare(a, b)
    assert result.verdict.startswith("5 scenarios decide nothing")
    # scenarios in which both have equal values are the same, however few
    c = publish(tmp_path, ONES[:5], method="c")
    assert side_of(a, c) == "same"


def test_the_speedups_of_both_are_shown(tmp_path: Path) -> None:
    """Or the reason why there is none."""
    speedup = {
        "value": 2.5,
        "interval": [1.5, 4.0],
        "at_least": True,
        "classical_seconds": 0.1,
    }
    one = publish(tmp_path, ONES, method="one", speedup=speedup)
    two = publish(tmp_path, TWOS, method="two", why_no_speedup="no cost")
    result = compare(one, two)
    assert result.speedups == (("> 2.5 [1.5, 4]",), ("no cost",))
    assert "speedup of one: > 2.5 [1.5, 4]" in list(comparison_lines(result))


def test_a_reference_is_as_good_as_its_submission(scored: Folders) -> None:
    """A reference's name compares with the row beside the submission."""
    folder = scored["still"]
    other = scored["straight"]
    by_name = compare(folder, "constant-velocity").as_json()
    by_file = compare(folder, other).as_json()
    assert by_name["metrics"] == by_file["metrics"]
    assert by_name["second"] == "constant-velocity"
    assert by_file["second"] == "straight"


def test_two_submissions_of_one_method_are_numbered(tmp_path: Path) -> None:
    a = publish(
        tmp_path / "a",
        [1, 2, 3, 4, 5, 6],
        method="toy",
        predictions_sha256="a",
    )
    b = publish(
        tmp_path / "b",
        [2, 3, 4, 5, 6, 8],
        method="toy",
        predictions_sha256="b",
    )
    result = compare(a, b)
    assert result.first == "toy (1)"
    assert result.second == "toy (2)"
    assert result.namesakes
    assert "toy (1) is better" in result.verdict
    _, means = comparison_tables(result)
    assert means.columns[1:] == ("toy (1)", "toy (2)")


INFINITE = float("inf")


def first_value(value: object) -> dict[str, Any]:
    """Return changes after which the value of the first scenario is another."""
    return {"rows": rows_of([value, *ONES[1:]])}


def scenario_ids(*ids: object) -> dict[str, Any]:
    """Return changes after which the scenarios have other ids."""
    return {"task": {"scenarios": list(ids)}}


ENERGY = {"values": ONES, "undefined": [0] * 6}
MALFORMED: dict[str, dict[str, Any]] = {
    "an infinite value": first_value(INFINITE),
    "ids that descend": scenario_ids(5, 4, 3, 2, 1, 0),
    "no scenarios": {"task": {"scenarios": []}, "rows": rows_of([])},
    "fewer ids than values": scenario_ids(3),
    "an observable that ranks": {
        "ranking_metric": "energy_true",
        "rows": {"submission": {"energy_true": ENERGY}},
    },
    "a name that is no text": {"method": 5},
    "rows in a list": {"rows": [1]},
    "no rows": {"rows": []},
    "a layout of its own": {"lagbench_scores": 2},
}


@pytest.mark.parametrize("changes", MALFORMED.values(), ids=MALFORMED)
def test_malformed_scores_are_unreadable(
    tmp_path: Path, changes: dict[str, Any]
) -> None:
    """On either side of the comparison."""
    good = publish(tmp_path, ONES, method="good")
    bad = publish(tmp_path, ONES, method="bad")
    content = json.loads(bad.read_text())
    bad.write_text(json.dumps(content | changes))
    with pytest.raises(UnreadableFileError):
        compare(good, bad)
    with pytest.raises(UnreadableFileError):
        compare(bad, good)


def test_rows_without_the_ranking_metric_are_unreadable(tmp_path: Path) -> None:
    path = publish(tmp_path, [1.0], method="a", ranking_metric="vorticity_rmse")
    other = publish(tmp_path, TWOS, method="b")
    with pytest.raises(UnreadableFileError):
        compare(path, other)


@pytest.fixture(scope="module")
def half_right_card(
    bench: ScoreBench, tmp_path_factory: pytest.TempPathFactory
) -> ScoreCard:
    """The scores of a method that is right in half of the frames."""
    folder = tmp_path_factory.mktemp("half-right")
    path = bench.submit(folder / "predictions.nc", half_right)
    return bench.evaluate(path)


def row_name(row: Sequence[str]) -> str:
    """Return the name of the metric that a row begins with."""
    name, *_ = row[0].split()
    return name


def test_tables_show_references_undefined_frames_and_units(
    half_right_card: ScoreCard,
) -> None:
    card = half_right_card
    horizon, at_frames, per_scenario = card_tables(card)
    rows = {row_name(row): row for row in horizon.rows}
    first_names = list(rows)[:2]
    assert first_names == ["skill", card.ranking]
    (reference_column,) = horizon.columns[2:]
    assert reference_column.replace("\n", "") == card.skill.reference
    pearson_row = rows["vorticity_pearson"]
    assert pearson_row[1].endswith("†")
    rmse_row = rows["vorticity_rmse"]
    assert rmse_row[0].endswith("[1/frame]")
    assert at_frames.columns == ("metric", "15", "25")
    scenarios = [row[0] for row in per_scenario.rows]
    assert scenarios == ["3", "4"]
