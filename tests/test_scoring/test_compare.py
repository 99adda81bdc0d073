"""Comparing submissions: against hand-worked p-values and both ways of naming them."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
from score_bench import ScoreBench, half_right, still, straight
from typer.testing import Result

from lagbench.cli import output
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.figures.tables import Table
from lagbench.metrics import differ
from lagbench.scoring.card import digits
from lagbench.scoring.compare import ComparisonResult, compare
from lagbench.scoring.tables import card_tables, comparison_tables, flag_lines


@pytest.fixture(scope="module")
def scored(
    bench: ScoreBench, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Folders of two scored submissions."""
    folders = {}
    for name, predict in {"still": still, "straight": straight}.items():
        folders[name] = tmp_path_factory.mktemp(name)
        bench.score(
            bench.submit(folders[name] / "predictions.nc", predict, method=name)
        )
    return folders


def published(
    folder: Path, values: list[float], *, method: str, **changes: Any
) -> Path:
    """Write a scores.json of one metric with these values per scenario."""
    row = {"mse_avg": {"values": values, "undefined": [0] * len(values)}}
    held = {
        "lagbench_scores": 1,
        "split": "cavity",
        "size": "full",
        "dataset_version": "1.0.0",
    }
    held |= {"dataset_sha256": "0" * 64, "method": method, "predictions_sha256": method}
    held |= {
        "task": {"scenarios": list(range(len(values)))},
        "ranking_metric": "mse_avg",
    }
    held |= {"rows": {"submission": row}}
    path = folder / method / "scores.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(held | changes))
    return path


def seeds_in(
    folder: Path, rows: Iterable[Iterable[float]], method: str, **changes: Any
) -> Path:
    """Write a folder of the seeds of a method; return it."""
    for i, row in enumerate(rows):
        path = published(
            folder / str(i),
            list(row),
            method=method,
            **{"predictions_sha256": f"{method}{i}"} | changes,
        )
        path.rename(folder / str(i) / "scores.json")
    return folder


def test_six_wins_of_six(tmp_path: Path) -> None:
    """Better in all of six scenarios: p = 2 / 2^6 = 0.03125, significant, said in
    words.

    One loss as large as the wins: |sum| of 4 or more in 14 of 64 patterns, p = 0.21875.
    """
    a = published(tmp_path, [1, 2, 3, 4, 5, 6], method="a")
    b = published(tmp_path, [2, 3, 4, 5, 6, 8], method="b")
    result = compare(a, b)
    found = result.metrics["mse_avg"]
    assert found.test.p == pytest.approx(2 / 64)
    assert (found.test.difference, found.first, found.second) == pytest.approx(
        (-7 / 6, 21 / 6, 28 / 6)
    )
    assert result.verdict.startswith(
        "mse_avg: a is better (p = 0.0312, 6 scenarios, one seed each"
    )
    assert compare(b, a).verdict == result.verdict
    assert result.verdict in repr(result)
    assert result.seeds == (1, 1)
    c = published(tmp_path, [1, 1, 1, 1, 1, 3], method="c")
    result = compare(c, published(tmp_path, [2] * 6, method="d"))
    # sums of six signs: 6 once, 4 six times, and their negatives
    assert result.metrics["mse_avg"].test.p == pytest.approx(14 / 64)
    assert "no difference at 5 %" in result.verdict


def test_a_folder_of_seeds_is_a_method(tmp_path: Path) -> None:
    """Three seeds against two: the two-way test over all of them, and means over seeds.

    Against one seed the verdict speaks of its weights.
    """
    rng = np.random.default_rng(0)
    a = rng.gamma(9.0, size=(3, 8))
    b = rng.gamma(12.0, size=(2, 8))
    several = seeds_in(tmp_path / "a", a, "a")
    result = compare(several, seeds_in(tmp_path / "b", b, "b"))
    found = result.metrics["mse_avg"]
    assert result.seeds == found.test.seeds == (3, 2)
    assert found.first == pytest.approx(a.mean())
    assert found.test.p == differ(a, b)
    assert "3 and 2 seeds" in result.verdict
    assert result.as_json()["seeds"] == [3, 2]
    one = compare(several, seeds_in(tmp_path / "c", b[:1], "c"))
    assert ["weights" in verdict for verdict in (result.verdict, one.verdict)] == [
        False,
        True,
    ]


def test_a_value_that_saturates_is_read_again(tmp_path: Path) -> None:
    """The greatest of float32, as a file holds it in nine digits, is a little more than
    it is.
    """
    greatest = digits(float(np.finfo(np.float32).max)) or 0.0
    scores = published(tmp_path, [greatest, 1.0, 1.0], method="a")
    other = published(tmp_path, [1.0, 1.0, 1.0], method="b")
    assert compare(scores, other).metrics["mse_avg"].first == pytest.approx(
        greatest / 3
    )


def test_from_a_folder_that_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is no such file there either, and a file that is named whole is read."""
    scores = published(tmp_path, [1.0, 2.0, 3.0], method="a")
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    with pytest.raises(UnreadableFileError) as caught:
        compare("scores.nc", scores)
    assert caught.value.where == "scores.nc"
    assert compare(scores, published(tmp_path, [2.0, 3.0, 5.0], method="b")).metrics


def test_copies_are_no_seeds(tmp_path: Path) -> None:
    """One file three times is one training, and the mean of two methods that of
    neither: both are refused.
    """
    other = published(tmp_path, [2.0] * 6, method="other")
    copies = seeds_in(tmp_path / "copies", [[1.0] * 6] * 3, "a", predictions_sha256="a")
    mixed = seeds_in(tmp_path / "mixed", [[1.0] * 6], "a")
    published(mixed, [1.0] * 6, method="b")
    for folder in (copies, mixed):
        for sides in ((folder, other), (other, folder)):
            with pytest.raises(UsageError) as told:
                compare(*sides)
            assert str(folder) in str(told.value.where)


def test_frames_without_a_value_are_told(tmp_path: Path) -> None:
    """A mean over few frames is no merit: how many were left out stands beside it."""
    row = {"values": [1.0] * 6, "undefined": [0, 0, 0, 0, 12, 7]}
    frozen = published(
        tmp_path, [1.0] * 6, method="a", rows={"submission": {"mse_avg": row}}
    )
    result = compare(frozen, published(tmp_path, [2.0] * 6, method="b"))
    assert result.metrics["mse_avg"].undefined == (19, 0)
    (shown,) = [
        row
        for table in comparison_tables(result)
        if table.title == "means"
        for row in table.rows
    ]
    assert "19 frames undefined" in shown[1]
    assert "undefined" not in shown[2]


@pytest.mark.parametrize(
    ("changes", "kind", "word"),
    [
        ({"split": "fluid"}, UsageError, "split"),
        ({"size": "mini"}, UsageError, "size"),
        ({"dataset_sha256": "1" * 64}, DataError, "dataset_sha256"),
    ],
)
def test_other_data_are_not_compared(
    tmp_path: Path, changes: dict[str, str], kind: type[Exception], word: str
) -> None:
    """Submissions to another split, size or data set are refused, naming what
    differs.
    """
    a = published(tmp_path, [1.0] * 6, method="a")
    b = published(tmp_path, [1.0] * 6, method="b", **changes)
    with pytest.raises(kind, match=f"differ in {word}"):
        compare(a, b)


def test_folders_files_and_predictions_agree(
    bench: ScoreBench, scored: dict[str, Path]
) -> None:
    """A folder, its scores.json, scores.nc and its predictions.nc, scored on the way,
    say the same.

    The short table leads with the ranking metric; all metrics come when asked for.
    """
    still_ = scored["still"]
    straight_ = scored["straight"]
    by_folder = compare(still_, straight_)
    by_file = compare(still_ / "scores.json", straight_ / "scores.json")
    nc = "predictions.nc"
    fresh = compare(
        still_ / nc, straight_ / nc, root=bench.root, registry=bench.registry
    )
    binary = compare(still_ / "scores.nc", straight_ / "scores.nc")
    assert (
        by_folder.as_json() == by_file.as_json() == fresh.as_json() == binary.as_json()
    )
    assert by_folder.first == "still"
    assert compare(still_, still_).verdict == "both hold the same predictions"
    assert next(iter(by_folder.metrics)) == by_folder.ranking
    (short, means), (whole, _) = (
        comparison_tables(by_folder),
        comparison_tables(by_folder, every=True),
    )
    assert short.rows[0][0].split()[0] == "vorticity_nrmse"
    assert (
        len(means.rows) == len(short.rows) < len(whole.rows) == len(by_folder.metrics)
    )


def test_files_of_a_leaderboard(
    scored: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Score files of several seeds go by their common name; the best floor stands in
    each.
    """
    folder = tmp_path / "scores" / "cavity" / "tiny"
    folder.mkdir(parents=True)
    for i, name in enumerate(("still", "straight")):
        path = folder / f"moving_{i}.nc"
        shutil.copy(scored[name] / "scores.nc", path)
        with netCDF4.Dataset(path, "a") as file:
            file.method = "moving"
    monkeypatch.chdir(folder)
    assert compare("moving.nc", "constant-velocity").seeds == (2, 1)
    (folder / "moving_old.nc").write_bytes(b"not a seed")
    result = compare(folder / "moving.nc", "constant-velocity")
    assert result.first == "moving"
    assert result.seeds == (2, 1)
    single = compare(scored["still"] / "scores.nc", "constant-velocity").as_json()[
        "metrics"
    ]
    whole = compare(scored["still"], "constant-velocity").as_json()["metrics"]
    assert single == {name: whole[name] for name in ("vorticity_nrmse",)}
    with netCDF4.Dataset(path, "a") as file:
        file.method = "moving\x1b[2J"  # a terminal would obey
    with pytest.raises(UnreadableFileError) as caught:
        compare(path, "constant-velocity")
    assert caught.value.where == str(path)
    path.write_bytes(path.read_bytes()[:9000])
    with pytest.raises(UnreadableFileError):
        compare(path, "constant-velocity")
    with pytest.raises(UnreadableFileError):  # elsewhere a name stands for itself
        compare(tmp_path / "predictions.nc", "constant-velocity")
    (tmp_path / "linked.nc").symlink_to(scored["still"] / "scores.nc")
    assert compare(tmp_path / "linked.nc", scored["straight"]).first == "still"


def test_seeds_by_either_file(scored: dict[str, Path], tmp_path: Path) -> None:
    """A seed counts whose scores.json is lost; what holds no scores is passed over."""
    for i, (name, file) in enumerate(
        (("still", "scores.json"), ("straight", "scores.nc"))
    ):
        (tmp_path / str(i)).mkdir()
        shutil.copy(scored[name] / file, tmp_path / str(i))
    (tmp_path / "notes").mkdir()
    said = json.loads((tmp_path / "0/scores.json").read_text())
    (tmp_path / "0/scores.json").write_text(json.dumps(said | {"method": "straight"}))
    assert compare(tmp_path, "persistence").seeds == (2, 1)
    with pytest.raises(
        UsageError
    ) as caught:  # one seed of both would be compared with itself
        compare(tmp_path, scored["straight"])
    assert str(tmp_path) in str(caught.value.where)


def test_floors_that_are_not_at_hand(scored: dict[str, Path], tmp_path: Path) -> None:
    """A floor goes second; a scores.nc holds the best one; a file that is empty is no
    submission.
    """
    with pytest.raises(UsageError):
        compare("persistence", scored["still"])
    with pytest.raises(UsageError) as caught:
        compare(scored["still"] / "scores.nc", "analog")
    assert caught.value.expected == "analog"
    (tmp_path / "scores.nc").touch()
    with pytest.raises(UnreadableFileError) as damaged:
        compare(tmp_path / "scores.nc", scored["still"])
    assert damaged.value.where == str(tmp_path / "scores.nc")


def test_floors_stand_in_the_scores(scored: dict[str, Path]) -> None:
    """A floor's name compares with the row beside the submission: equal to having
    submitted it.

    A misspelt metric or floor is a usage error with the nearest name.
    """
    by_name = compare(scored["still"], "constant-velocity").as_json()
    by_file = compare(scored["still"], scored["straight"]).as_json()
    assert by_name["metrics"] == by_file["metrics"]
    assert by_name["second"] == "constant-velocity"
    assert by_file["second"] == "straight"
    with pytest.raises(UsageError) as caught:
        compare(scored["still"], scored["straight"], metrics=["vorticity_rsme"])
    assert caught.value.where == "--metric"
    with pytest.raises(UsageError):
        compare(scored["still"], "constant-velocty")
    only: ComparisonResult = compare(
        scored["still"], scored["straight"], metrics=["mse_end"]
    )
    assert list(only.metrics) == ["vorticity_nrmse", "mse_end"]


def test_equal_names_are_told_apart(tmp_path: Path) -> None:
    """Two submissions of one method are numbered; a floor keeps its name, who borrows
    it is numbered.
    """
    a = published(
        tmp_path / "a", [1, 2, 3, 4, 5, 6], method="toy", predictions_sha256="a"
    )
    b = published(
        tmp_path / "b", [2, 3, 4, 5, 6, 8], method="toy", predictions_sha256="b"
    )
    result = compare(a, b)
    assert result.first == "toy (1)"
    assert result.second == "toy (2)"
    assert result.namesakes
    assert "toy (1) is better" in result.verdict
    assert list(comparison_tables(result))[1].columns[1:] == ("toy (1)", "toy (2)")
    rows = json.loads(a.read_text())["rows"]
    borrowed = published(
        tmp_path, [1] * 6, method="floor", rows={**rows, "floor": rows["submission"]}
    )
    result = compare(borrowed, "floor")
    assert result.first == "floor (1)"
    assert result.second == "floor"
    assert not result.namesakes


def row_of(
    values: list[object], undefined: list[object] | None = None
) -> dict[str, object]:
    """Return the rows of a scores.json with one metric."""
    held = {
        "values": values,
        "undefined": [0] * len(values) if undefined is None else undefined,
    }
    return {"submission": {"mse_avg": held}}


MALFORMED: dict[str, dict[str, Any]] = {
    "a number beyond float64": {"rows": row_of([10**400, *[1] * 5])},
    "an infinite value": {"rows": row_of([float("inf"), *[1] * 5])},
    "infinitely many undefined frames": {"rows": row_of([1] * 6, [float("inf")] * 6)},
    "undefined frames of one scenario": {"rows": row_of([1] * 6, [0])},
    "ids that occur twice": {"task": {"scenarios": [28] * 6}},
    "an id that is no integer": {"task": {"scenarios": [0, 1, 2, 3, 4, 5.5]}},
    "booleans as ids": {
        "task": {"scenarios": [False, True]},
        "rows": row_of([1.0, 2.0]),
    },
    "a boolean as value": {"rows": row_of([True, *[1] * 5])},
    "an observable that ranks": {
        "ranking_metric": "energy_true",
        "rows": {
            "submission": {"energy_true": {"values": [1] * 6, "undefined": [0] * 6}}
        },
    },
    "a name that is no text": {"method": 5},
    "a name with an escape": {"method": "\x1b[31m"},
    "rows in a list": {"rows": [1]},
    "no rows": {"rows": []},
    "an id that is text": {"task": {"scenarios": ["a"]}},
    "fewer ids than values": {"task": {"scenarios": [3]}},
    "a layout of its own": {"lagbench_scores": 2},
}


@pytest.mark.parametrize("changes", MALFORMED.values(), ids=MALFORMED)
def test_malformed_scores_are_unreadable(
    tmp_path: Path, changes: dict[str, Any]
) -> None:
    """Whatever is wrong in a scores.json, it is the file that cannot be read, on either
    side.
    """
    good = published(tmp_path, [1.0] * 6, method="good")
    bad = published(tmp_path, [1.0] * 6, method="bad")
    bad.write_text(json.dumps(json.loads(bad.read_text()) | changes))
    for sides in ((good, bad), (bad, good)):
        with pytest.raises(UnreadableFileError):
            compare(*sides)


def test_scores_that_are_not_there(tmp_path: Path) -> None:
    """A folder without any, JSON deeper than Python's stack, rows without the ranking
    metric.
    """
    (tmp_path / "empty").mkdir()
    with pytest.raises(UnreadableFileError) as error:
        compare(published(tmp_path, [1.0] * 6, method="good"), tmp_path / "empty")
    assert error.value.where == str(tmp_path / "empty")
    path = tmp_path / "scores.json"
    path.write_text("[" * 100_000)
    with pytest.raises(UnreadableFileError) as caught:
        compare(path, path)
    assert caught.value.where.endswith("scores.json")
    bare = published(tmp_path, [1.0], method="a", ranking_metric="vorticity_rmse")
    empty = published(
        tmp_path, [1.0] * 6, method="b", rows={**row_of([1] * 6), "persistence": {}}
    )
    for sides in ((bare, bare), (empty, "persistence")):
        with pytest.raises(UnreadableFileError):
            compare(*sides)


def test_tables_show_floors_undefined_and_units(
    bench: ScoreBench, tmp_path: Path
) -> None:
    """The tables hold floors beside the submission, intervals, undefined frames, frames
    of interest.
    """
    card = bench.evaluate(bench.submit(tmp_path / "predictions.nc", half_right))
    horizon, at_frames, per_scenario = card_tables(card)
    rows = {row[0].split()[0]: row for row in horizon.rows}
    assert list(rows)[:2] == ["skill", card.ranking]
    assert [column.replace("\n", "") for column in horizon.columns[2:]] == [
        card.skill.reference
    ]
    assert rows["vorticity_pearson"][1].endswith("†")
    assert rows["vorticity_rmse"][0].endswith("[1/frame]")
    assert at_frames.columns == ("metric", "15", "25")
    assert [row[0] for row in per_scenario.rows] == ["3", "4"]
    every, *_ = card_tables(card, every=True, floors=True)
    assert [row[0].split()[0] for row in every.rows] == ["skill", *card.submission]
    assert len(every.columns) == len(card.scores) + 1
    lines = list(flag_lines(card))
    assert any(line.startswith("flag copy_suspect: raised") for line in lines)
    assert any("2 scenarios: no p-value" in line for line in lines)
    assert any("vorticity_pearson 20" in line for line in lines)


def test_wide_tables_come_in_blocks() -> None:
    """Every block fits and repeats what a row is; side by side they hold every cell
    once.
    """
    columns = ("row", *(f"column-{i}" for i in range(20)))
    rows = tuple(
        (f"row {j}", *(f"{i}.{j} [0.25, 0.75]" for i in range(20))) for j in range(3)
    )
    blocks = list(output.split_table(Table("wide", columns, rows), 80))
    assert len(blocks) > 1
    for block in blocks:
        widths = [
            max(map(len, column))
            for column in zip(block.columns, *block.rows, strict=True)
        ]
        assert sum(widths) + 3 * len(widths) <= 80
        assert [row[0] for row in block.rows] == ["row 0", "row 1", "row 2"]
    assert sum((block.columns[1:] for block in blocks), ()) == columns[1:]
    assert sum((block.rows[1][1:] for block in blocks), ()) == rows[1][1:]


def test_metrics_that_cannot_be_loaded(
    run: Callable[..., Result], tmp_path: Path, package: Callable[..., Path]
) -> None:
    """Metrics that cannot be imported: the entry point is named, not the file of
    scores.
    """
    package("metrics", "broken_metric:METRICS", "raise KeyError('mine')\n")
    scores = published(tmp_path, [1.0] * 6, method="a")
    result = run("compare", scores, scores)
    assert result.exit_code == 2
    assert "broken_metric:METRICS" in result.stderr


def test_pipes_and_devices_are_refused_at_once(tmp_path: Path) -> None:
    """A FIFO that nobody writes to, a device that never ends, a file too long, by any
    name.
    """
    os.mkfifo(tmp_path / "fifo.json")
    (tmp_path / "zero.json").symlink_to("/dev/zero")
    with (tmp_path / "long.json").open("wb") as stream:
        stream.truncate(1 << 40)
    for name in ("fifo.json", "zero.json", "long.json", "x" * 300, "y" * 300 + ".json"):
        with pytest.raises(UnreadableFileError) as caught:
            compare(tmp_path / name, tmp_path / name)
        assert caught.value.where == str(tmp_path / name)


@pytest.mark.parametrize(
    ("predict", "row", "word"), [(straight, 0, "better"), (still, 1, "worse")]
)
def test_how_much_better_is_said(
    bench: ScoreBench, tmp_path: Path, predict: Any, row: int, word: str
) -> None:
    """The printed number is the size of the difference, and the word its sign."""
    card = bench.evaluate(bench.submit(tmp_path / "predictions.nc", predict))
    lines = [line for line in flag_lines(card) if line.startswith("against ")]
    assert lines[0].endswith("is the same") is (predict is still)  # persistence
    line = lines[row]
    found = re.search(rf"{word} by ([\d.e-]+) \(2 scenarios: no p-value\)", line)
    assert found, line
    against = card.against(list(card.scores)[1 + row])
    assert float(found[1]) == pytest.approx(abs(against.difference), rel=1e-3)
    assert (against.difference < 0.0) == (word == "better")
