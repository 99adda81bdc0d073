"""Comparing submissions: against hand-worked p-values and both ways of naming them."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
from score_bench import ScoreBench, still, straight

from lagbench.data.registry import load
from lagbench.errors import DataError, UsageError
from lagbench.metrics import differ
from lagbench.references import shipped
from lagbench.scoring.compare import compare, comparison_tables

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


def publish(folder: Path, values: list[float], *, method: str, **changes: Any) -> Path:
    """Write a scores.nc of one metric with these values per scenario."""
    content = {
        "split": "cavity",
        "size": "full",
        "dataset_version": "1.0.0",
        "dataset_sha256": "0" * 64,
        "method": method,
        "predictions_sha256": method,
        "ranking_metric": "mse_avg",
        "ids": range(len(values)),
    } | changes
    path = folder / method / "scores.nc"
    path.parent.mkdir(parents=True)
    dims = ("statistic", "scenario", "frame")
    with netCDF4.Dataset(path, "w") as file:
        file.lagbench_scores = 1
        file.statistics = "attribute_mse"
        for dim, length in zip(dims, (1, len(values), 1), strict=True):
            file.createDimension(dim, length)
        file.createVariable("scenario", "i4", dims[1:2])[:] = content.pop("ids")
        file.createVariable("frame", "i4", dims[2:])[:] = 1
        file.createVariable("value", "f8", dims)[:] = np.reshape(values, (1, -1, 1))
        file.createVariable("measured", "i1", dims)[:] = 1
        file.setncatts(content)
    return path


def publish_seeds(folder: Path, rows: Iterable[Iterable[float]], method: str) -> Path:
    """Write a folder of the seeds of a method and return it."""
    for seed, values in enumerate(rows):
        own_hash = f"{method}{seed}"
        path = publish(
            folder / "raw" / str(seed),
            list(values),
            method=method,
            predictions_sha256=own_hash,
        )
        (folder / own_hash).mkdir()
        path.rename(folder / own_hash / path.name)
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


OTHER_IDS = {"ids": range(100, 106)}
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
    publish(seeds, ONES, **({"method": "a"} | changes))
    for pair in ((seeds, other), (other, seeds)):
        with pytest.raises(UsageError):
            compare(*pair)


def test_shipped_references_stand_beside_scores_of_our_splits(tmp_path: Path) -> None:
    """A submission with the values of a reference is as good as the reference."""
    size = load().size("cavity", "mini")
    references = shipped(size)
    assert references is not None
    assert size.measured is not None
    values = references["persistence"].scores["mse_avg"].values.tolist()
    path = publish(
        tmp_path,
        values,
        method="still",
        size="mini",
        dataset_sha256=size.measured.dataset_sha256,
        ids=size.subsets["test"],
    )
    result = compare(path, "persistence")
    assert result.metrics["mse_avg"].side == "same"
    assert result.second == "persistence"


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


@pytest.mark.parametrize(
    ("first", "second", "side"),
    [
        (ONES, TWOS, "better"),
        (TWOS, ONES, "worse"),
        (ONES, [0.5, 1.5, 1.5, 1.5, 1.5, 1.5], "better?"),  # it may be chance
        (ONES, ONES, "same"),
        # sums in another order differ in the last digits, in all scenarios alike
        (ONES, [1.0 - 1e-13] * 6, "same"),
        ([1.0 - 1e-9] * 6, ONES, "better"),
        # five scenarios cannot reach 5 %
        (ONES[:5], TWOS[:5], "too few"),
        (ONES[:5], ONES[:5], "same"),
    ],
)
def test_a_column_says_which_method_is_better(
    tmp_path: Path, first: list[float], second: list[float], side: str
) -> None:
    a = publish(tmp_path, first, method="a")
    b = publish(tmp_path, second, method="b")
    table, *_ = comparison_tables(compare(a, b))
    assert table.rows[0][1] == side
