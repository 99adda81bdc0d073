"""The leaderboard's folder: entries, submissions, checks, rows and the page."""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from board_bench import (
    PLACE,
    SCORES,
    BoardBench,
    copied,
    damped,
    master,
    still,
)
from command_line import CliRunner

from lagbench.board.check import check_board
from lagbench.board.collect import _rank, collect
from lagbench.board.entry import Entry, Weights, entry_bytes, read_entry, validate
from lagbench.board.folder import Folder
from lagbench.board.gates import EARLY_ERROR, with_early_gate
from lagbench.board.page import build, cost_chart, render, write_picture
from lagbench.board.rows import Board, Row, Tab, Value
from lagbench.board.show import to_plain
from lagbench.board.verified import VERIFICATIONS, Level
from lagbench.cli.program import app
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import ChecksFailedError, UsageError
from lagbench.references.predictor import Kind
from lagbench.scoring.front import Speedup, compute_speedup

Content = dict[str, Any]
HOSTILE = "<script>alert(1)</script><img src=http://example.com/x>"


@pytest.fixture(scope="module")
def bench(home: Path) -> BoardBench:
    """The leaderboard that tests share; none of them changes it."""
    return master(home)


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard that the test may damage."""
    return copied(home, tmp_path)


@pytest.fixture(scope="module")
def board(bench: BoardBench) -> Board:
    """The content of the shared leaderboard."""
    return collect(bench.folder, registry=bench.registry)


@pytest.fixture(scope="module")
def tab(board: Board) -> Tab:
    """Its only data set."""
    (tab,) = board.tabs
    return tab


def put(**keys: object) -> Callable[[Content], object]:
    """Return a change that sets keys of an entry."""
    return lambda content: content.update(keys)


def test_an_entry_is_written_as_it_was_read(bench: BoardBench) -> None:
    for path in Folder(bench.folder).entries():
        whole_path = bench.folder / path
        assert entry_bytes(read_entry(whole_path)) == whole_path.read_bytes()


@pytest.mark.parametrize(
    "change",
    [
        put(unknown=1),
        put(authors=[]),
        put(kind="naive"),
        put(date="9999-01-01"),
        put(code="javascript:alert(1)"),
        put(code='https://example.org/"onclick=x'),
        put(name="a\nb"),
        put(notes="\x1b[2J"),
        put(split="../cavity"),
        put(parameters=-1),
        lambda content: content.pop("command"),
        lambda content: content["predictions"][0].update(
            weights={"path": "../x.onnx", "sha256": 64 * "0"}
        ),
        lambda content: content["predictions"].reverse(),
        lambda content: content["score"]["metrics"]["mse_avg"].update(mean=math.inf),
    ],
)
def test_an_entry_that_does_not_fit_is_refused(
    change: Callable[[Content], object], bench: BoardBench
) -> None:
    content = read_yaml(bench.entry("damped"))
    validate(Entry, content, "as it was")
    change(content)
    with pytest.raises(ChecksFailedError):
        validate(Entry, content, "changed")


def test_a_submission_has_the_scores_of_the_scorer(bench: BoardBench) -> None:
    entry = read_entry(bench.entry("noisy"))
    path = bench.folder.parent / "noisy.nc"
    card = bench.data.card(path)
    assert entry.predictions[0].sha256 == card.predictions_sha256
    for name, score in card.submission.items():
        stated = entry.score.metrics[name].mean
        expected = math.nan if stated is None else stated
        assert score.mean == pytest.approx(expected, rel=1e-6, nan_ok=True)
    assert read_entry(bench.entry("damped")).seeds == (0, 3)


def test_an_entry_is_replaced_only_on_request(own: BoardBench) -> None:
    """Then files that it no longer has go."""
    path = own.predict(still, "damped", seed=0)
    before = own.state()
    with pytest.raises(UsageError, match="--replace"):
        own.submit(path)
    assert own.state() == before
    own.submit(path, replace=True)
    names = [file.name for file in sorted((own.folder / SCORES).glob("damped*"))]
    assert names == ["damped.nc"]
    assert check_board(own.folder, registry=own.registry).exit_code == 0


@pytest.mark.parametrize(
    ("seeds", "keys"),
    [
        ([0, 0], {}),
        ([0], {"method": "persistence"}),
        ([0], {"authors": ()}),
        ([0], {"command": ""}),
    ],
)
def test_what_is_no_entry_is_refused_before_the_scoring(
    seeds: list[int], keys: dict[str, Any], own: BoardBench, tmp_path: Path
) -> None:
    paths = []
    for number, seed in enumerate(seeds):
        path = tmp_path / f"{number}.nc"
        paths.append(own.data.submit(path, damped, "other", seed=seed))
    before = own.state()
    with pytest.raises(UsageError):
        own.submit(*paths, **keys)
    assert own.state() == before


def damage_score_file(own: BoardBench) -> None:
    path = own.folder / SCORES / "noisy.nc"
    path.write_bytes(path.read_bytes()[:-1])


def exchange_score_files(own: BoardBench) -> None:
    """The hashes follow, so that only the identity of the scores tells."""
    shutil.copy(own.folder / SCORES / "noisy.nc", own.folder / SCORES / "flipping.nc")
    own.rehash("flipping")


def state_better_scores(content: Content) -> None:
    content["score"]["metrics"]["vorticity_rmse"]["mean"] *= 0.9


def record_nothing(own: BoardBench) -> None:
    line = "{scores: ['" + 64 * "0" + "'], lagbench: 0.1.0, date: 2026-01-01}"
    (own.folder / "verified.yaml").write_text(f"{PLACE}/noisy.yaml: {line}\n")


DAMAGE: dict[str, Callable[[BoardBench], object]] = {
    "noisy.nc": damage_score_file,
    "flipping.nc": exchange_score_files,
    "noisy.yaml": lambda own: own.edit("noisy", state_better_scores),
    "flipping.yaml": lambda own: own.entry("flipping").write_text("a: ["),
    "damped.yaml": lambda own: own.edit("damped", put(split="fluid")),
    "stray.nc": lambda own: shutil.copy(
        own.folder / SCORES / "noisy.nc", own.folder / SCORES / "stray.nc"
    ),
    "notes.txt": lambda own: (own.folder / "notes.txt").write_text(""),
    "link": lambda own: (own.folder / "link").symlink_to("/"),
    "verified.yaml": record_nothing,
    "gates.json": lambda own: (own.folder / "gates.json").write_text("{"),
    "shift.yaml": lambda own: (own.folder / "shift.yaml").write_text("a: 1"),
}


@pytest.mark.parametrize("place", DAMAGE)
def test_damage_is_found_where_it_is(place: str, own: BoardBench) -> None:
    assert check_board(own.folder, registry=own.registry).findings == ()
    DAMAGE[place](own)
    findings = check_board(own.folder, registry=own.registry).findings
    assert any(place in finding for finding in findings)


def test_predictions_scored_again_are_recorded(
    own: BoardBench, bench: BoardBench
) -> None:
    """Until the scores of the entry change; other predictions are of no entry."""
    check = {"registry": own.registry, "root": own.data.root}
    paths = [bench.folder.parent / f"damped_{seed}.nc" for seed in (0, 3)]
    result = check_board(own.folder, predictions=paths, recording=True, **check)
    assert result.findings == ()
    name = f"{PLACE}/damped.yaml"
    assert result.recorded == (name,)
    assert VERIFICATIONS.read(Folder(own.folder))[name].level is Level.SCORED_AGAIN

    own.submit(own.predict(still, "damped", seed=0), replace=True)
    assert name not in VERIFICATIONS.read(Folder(own.folder))
    assert check_board(own.folder, predictions=paths[:1], **check).exit_code == 1


def test_rows_stand_in_the_order_of_the_ranking_metric(tab: Tab) -> None:
    means = [row.score.mean for row in tab.rows]
    assert means == sorted(means)
    assert [row.rank for row in tab.rows] == [1, 2, 3]


def test_entries_closer_than_the_truth_error_share_a_rank(tab: Tab) -> None:
    entries = [row for row in tab.rows if row.entry is not None]
    gap = entries[1].score.mean - entries[0].score.mean
    for truth_error, ranks in ((0.9 * gap, [1, 2]), (1.1 * gap, [1, 1])):
        ranked = _rank(entries[:2], truth_error)
        assert [row.rank for row in ranked] == ranks


def with_classical_side(tab: Tab) -> Tab:
    """Return a tab whose rows all have a cost; all but one are solvers."""
    rows = []
    for row in tab.rows:
        kind = row.kind if row.id == "damped" else Kind.CLASSICAL
        rows.append(replace(row, seconds=0.1, kind=kind))
    return replace(tab, rows=tuple(rows))


def test_a_speedup_is_that_of_the_front(tab: Tab) -> None:
    """With a cost; without one there is a reason."""
    timed = with_classical_side(tab)
    front = {row.name: row for row in timed.front_rows}
    for row in timed.rows:
        assert front[row.id].error == pytest.approx(row.score.mean)
    speedup = compute_speedup(front["damped"], timed.front_rows)
    assert isinstance(speedup, Speedup)
    assert speedup.value == pytest.approx(1.0)
    assert all(row.speedup or row.why_no_speedup for row in tab.rows if row.entry)


def test_the_chart_has_the_rows_and_the_hull(tab: Tab) -> None:
    timed = with_classical_side(tab)
    chart = cost_chart(timed, is_large=True)
    points = {point["method"]: point for point in chart["data"]["values"]}
    for row in timed.rows:
        assert points[row.name]["error"] == pytest.approx(row.score.mean, rel=1e-5)
        assert points[row.name]["ms"] == pytest.approx(100.0)
    hull = chart["layer"][0]["data"]["values"]
    corners = [(point["ms"], point["error"]) for point in hull[1:-1]]
    assert corners == [(1e3 * one.seconds, one.error) for one in timed.hull]


def test_pictures_are_written(board: Board, tmp_path: Path) -> None:
    for name, start in (("a.svg", b"<svg"), ("a.png", b"\x89PNG")):
        write_picture(board, tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)


def test_texts_of_strangers_are_no_markup(board: Board, tab: Tab) -> None:
    rows = []
    for row in tab.rows:
        if row.entry is not None:
            entry = row.entry.model_copy(update={"name": HOSTILE, "notes": HOSTILE})
            row = replace(row, entry=entry, name=HOSTILE)
        rows.append(row)
    page = render(replace(board, tabs=(replace(tab, rows=tuple(rows)),)))
    assert "alert(1)" in page
    own_part = page.split('<script type="application/json"')[0]
    assert "<script>alert" not in page
    assert "<img" not in own_part
    charts = re.search(r'id="charts">(.*?)</script>', page, re.DOTALL)
    assert charts is not None
    assert HOSTILE in json.dumps(json.loads(charts[1]))


def test_the_page_asks_nothing_of_the_network_and_is_written_once(
    own: BoardBench,
) -> None:
    result = build(own.folder, registry=own.registry)
    page = result.page.read_text("utf-8")
    assert result.bytes < 3_000_000
    assert "default-src 'none'" in page
    own_part = page.split('<script type="application/json"')[0]
    assert not re.findall(r"<(?:script|link|img|iframe)[^>]*(?:src|href)=", own_part)
    own.edit("noisy", put(name="another name"))
    with pytest.raises(ChecksFailedError):
        build(own.folder, check=True, registry=own.registry)


def test_entries_of_other_data_have_no_rows(own: BoardBench) -> None:
    own.edit(
        "flipping",
        lambda content: content["dataset"].update(version="1.0.0", sha256=64 * "1"),
    )
    (tab,) = collect(own.folder, registry=own.registry).tabs
    assert {row.id for row in tab.rows} == {"damped", "noisy"}


def test_json_has_the_numbers_of_the_rows(board: Board, tab: Tab) -> None:
    (plain,) = to_plain(board)["tabs"]
    by_id = {row["id"]: row for row in plain["rows"] + plain["references"]}
    assert set(by_id) == {row.id for row in tab.rows}
    for row in tab.rows:
        value = by_id[row.id]["metrics"][tab.ranking]
        assert value["mean"] == pytest.approx(row.score.mean, rel=1e-8)
    json.dumps(plain, allow_nan=False)


@pytest.mark.parametrize(
    ("arguments", "exit_code"),
    [
        (["show", "cavity", "--size", "mini"], 2),
        (["show", "--metric", "none"], 2),
        (["reproduce"], 2),
        (["reproduce", "cavity/tiny/none"], 2),
        (["reproduce", "cavity/tiny/damped"], 2),
        (["check", "--record"], 2),
        (["picture", "-o", "front.txt"], 2),
    ],
)
def test_commands_refuse_what_is_not_there(
    arguments: list[str], exit_code: int, bench: BoardBench
) -> None:
    words = ["leaderboard", *arguments, "--board", str(bench.folder)]
    assert CliRunner().invoke(app, words).exit_code == exit_code


@pytest.mark.parametrize(
    ("error", "expected"), [(0.3, ()), (0.301, ("twenty_frames",))]
)
def test_a_graph_network_has_at_most_three_times_the_early_error_of_neuralmpm(
    error: float, expected: tuple[str, ...], tab: Tab
) -> None:
    some = next(row for row in tab.rows if row.entry is not None)
    assert some.entry is not None
    weights = Weights(path="weights/cavity/tiny/gns_0.safetensors", sha256=64 * "0")
    (first, *_) = some.entry.predictions
    prediction = first.model_copy(update={"weights": weights})
    entry = some.entry.model_copy(update={"predictions": (prediction,)})

    def row(name: str, error: float) -> Row:
        return replace(
            some, id=name, entry=entry, metrics={EARLY_ERROR: Value(mean=error)}
        )

    rows = [row("neuralmpm", 0.1), row("gns", error)]
    judged = with_early_gate(rows, [weights.sha256])
    assert [one.failed_gates for one in judged] == [(), expected]
