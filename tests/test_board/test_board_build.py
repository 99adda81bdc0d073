"""The board as it is collected: numbers against the scorer's, ranks, seeds,
pictures.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
from board_bench import PLACE, BoardBench, copied, master, noisy
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from sample_boards import make_entry

from lagbench.board import build as board_build
from lagbench.board.build import (
    CURVE_FRAMES,
    RESIDUAL_BINS,
    Scope,
    build,
    collect,
    make_curve,
    residual_histograms,
)
from lagbench.board.check import check_board
from lagbench.board.columns import SKILL, value_of
from lagbench.board.entry import Weights
from lagbench.board.folder import Folder
from lagbench.board.gates import gates_failed_by, read_failed_gates
from lagbench.board.model import Board, BoardRow
from lagbench.board.page import PAGES
from lagbench.board.ranking import combine
from lagbench.board.selection import choose_data_sets
from lagbench.board.show import tables, to_plain
from lagbench.board.variants import find_variants
from lagbench.data.registry import PluginWarning, Registry
from lagbench.errors import (
    ChecksFailedError,
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.metrics import METRICS, Score, bootstrap_interval
from lagbench.references.predictor import Kind
from lagbench.references.table import REFERENCES
from lagbench.scoring.card import ScoreCard, digits
from lagbench.scoring.scenario import SUBMISSION
from lagbench.scoring.score_file import read_statistics
from lagbench.scoring.score_file_checks import read_score_file

COMMITTED = Path(__file__).parents[2] / "leaderboard"


@pytest.fixture(scope="module")
def bench(home: Path) -> BoardBench:
    """The shared leaderboard."""
    return master(home)


@pytest.fixture(scope="module")
def board(bench: BoardBench) -> Board:
    """It, collected."""
    return collect(bench.folder, registry=bench.registry)


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy that the test may damage."""
    return copied(home, tmp_path)


@pytest.fixture(scope="module")
def card(bench: BoardBench) -> ScoreCard:
    """The score card of ``noisy``, scored apart from the board."""
    predictions = bench.predict(noisy, "again")
    return bench.data.card(predictions)


def row_of(board: Board, method: str) -> BoardRow:
    """Return a row of the only tab."""
    rows = {row.id: row for row in board.tabs[0].rows}
    return rows[method]


def test_values_are_those_of_the_scorer(board: Board, card: ScoreCard) -> None:
    """Mean, interval, scenarios, undefined frames and frames of interest of every
    metric.
    """
    values = row_of(board, "noisy").values
    assert set(values) == set(card.submission)
    for name, score in card.submission.items():
        value = values[name]
        low, high = score.interval
        assert digits(value.mean) == digits(score.mean)
        assert digits(value.low) == digits(low)
        assert digits(value.high) == digits(high)
        assert_array_equal(value.per_scenario, score.values)
        assert value.undefined == sum(score.undefined)
        assert math.isnan(value.std)
        for frame, mean in value.at.items():
            scenario_values = score.at(frame)
            defined = scenario_values[~np.isnan(scenario_values)]
            expected = math.nan
            if defined.size:
                expected = float(np.mean(defined))
            assert digits(mean) == digits(expected)


def test_references_stand_as_the_scorer_sees_them(
    board: Board, card: ScoreCard
) -> None:
    """Every reference predictor of the scorer is there, with its scores."""
    references = {row.name: row for row in board.tabs[0].references}
    assert set(references) == set(card.scores) - {SUBMISSION}
    assert set(references) < set(REFERENCES)
    for name, reference in references.items():
        scores = card.scores[name]
        assert set(reference.values) == set(scores)
        for metric, score in scores.items():
            value = reference.values[metric]
            expected = pytest.approx(score.values, rel=1e-6, nan_ok=True)
            assert digits(value.mean) == digits(score.mean)
            assert value.per_scenario == expected


def test_references_have_a_skill_beside_the_best_naive_one(board: Board) -> None:
    """It is 1 - score / score of the best naive baseline, which itself has 0."""
    tab = board.tabs[0]
    scores = {row.name: row.values[tab.ranking].mean for row in tab.references}
    kinds = {row.name: row.kind for row in tab.references}
    least = min(scores[name] for name, kind in kinds.items() if kind is Kind.NAIVE)
    for row in tab.references:
        assert row.skill is not None
        expected = 1.0 - scores[row.name] / least
        assert row.skill.mean == pytest.approx(expected, abs=1e-12)
        assert value_of(row, SKILL) == row.skill.mean
    assert min(abs(row.skill.mean) for row in tab.references if row.skill) < 1e-12


def test_seeds_are_averaged(bench: BoardBench, board: Board) -> None:
    """Mean over seeds per scenario, sample deviation over seeds, interval over both."""
    folder = bench.folder / "scores/cavity/tiny"
    first = read_statistics(folder / "damped_0.nc").scores()
    second = read_statistics(folder / "damped_3.nc").scores()
    row = row_of(board, "damped")
    assert row.entry.seeds == (0, 3)
    for name in ("vorticity_rmse", "position_rmse", "energy_error"):
        a = first[name].values
        b = second[name].values
        value = row.values[name]
        seeds = np.stack([a, b])
        mean = (a + b) / 2.0
        deviation = abs(a.mean() - b.mean()) / math.sqrt(2.0)
        assert value.per_scenario == pytest.approx(mean)
        assert value.mean == pytest.approx(mean.mean())
        assert value.std == pytest.approx(deviation)
        interval = [value.low, value.high]
        assert_array_equal(interval, bootstrap_interval(seeds))
    ranking = "vorticity_nrmse"
    means = (first[ranking].mean, second[ranking].mean)
    assert row.seed_means == pytest.approx(means)


def test_an_entry_of_an_unknown_split_is_named(bench: BoardBench) -> None:
    """The entry is named: a package that describes its split is missing."""
    nothing_known = Registry({}, {})
    with pytest.raises(DataError) as caught:
        collect(bench.folder, registry=nothing_known)
    entries = (bench.folder / "submissions").rglob("*.yaml")
    assert Path(caught.value.where or "") in entries


def test_few_scenarios_decide_nothing(board: Board) -> None:
    """With two scenarios there is no p-value and no sign; ranks are the order."""
    (tab,) = board.tabs
    assert not tab.decided
    ranked = [row for row in tab.rows if row.rank is not None]
    names = {row.id for row in ranked}
    assert names == {"damped", "noisy", "flipping"}
    ranks = [row.rank for row in ranked]
    assert ranks == [1, 2, 3]
    for row in ranked:
        assert math.isnan(row.p)
        assert not row.tied
    means = [row.values[tab.ranking].mean for row in ranked]
    assert means == sorted(means)


def withdraw(entry: dict[str, Any]) -> None:
    """Withdraw an entry."""
    entry["status"] = "withdrawn"
    entry["reason"] = "leaked"


def supersede(entry: dict[str, Any]) -> None:
    """Let an entry name its successor."""
    entry["status"] = "superseded"
    entry["superseded_by"] = "flipping"


def outdate(entry: dict[str, Any]) -> None:
    """Give an entry the hash of another data set."""
    entry["dataset"]["sha256"] = "0" * 64


def test_withdrawn_superseded_and_outdated_are_not_ranked(own: BoardBench) -> None:
    """They stay on the board, below, and say why; scores of another task are left
    out.
    """
    own.edit("noisy", withdraw)
    own.edit("damped", supersede)
    own.edit("flipping", outdate)
    board = collect(own.folder, registry=own.registry)
    for row in board.tabs[0].rows:
        assert row.rank is None
        assert not row.active
    assert row_of(board, "noisy").entry.reason == "leaked"
    assert not row_of(board, "flipping").current


def test_a_missing_score_file_is_named_with_its_entry(own: BoardBench) -> None:
    """The user gave no path that could be wrong."""
    path = next(own.folder.glob("scores/**/noisy*.nc"))
    path.unlink()
    with pytest.raises(UnreadableFileError, match="score file of an entry") as caught:
        collect(own.folder, registry=own.registry)
    assert caught.value.where == str(path)
    assert "leaderboard check --board" in str(caught.value.fix)


def test_the_truth_is_not_that_of_an_explosion(bench: BoardBench, board: Board) -> None:
    """Maps of truth and prediction share one packing: the tab's truth is the finest."""
    folder = bench.folder / "scores/cavity/tiny"
    coarse = read_score_file(folder / "flipping.nc")
    fine = read_score_file(folder / "noisy.nc")
    assert coarse.precision > 5.0 * fine.precision
    true_vorticity = board.tabs[0].truth.vorticity
    expected = fine.preview.vorticity[0]
    assert_allclose(true_vorticity, expected, atol=fine.precision)


def test_pictures_are_those_of_the_scorer(board: Board, card: ScoreCard) -> None:
    """Film and maps come back within half a step of their packing."""
    row = row_of(board, "noisy")
    film_error = np.abs(row.pictures.film - card.preview.film[1])
    assert film_error.max() <= 2.0 / 65534

    vorticity = card.preview.vorticity
    span = np.nanmax(vorticity) - np.nanmin(vorticity)
    map_error = np.abs(row.pictures.vorticity - vorticity[1])
    assert np.nanmax(map_error) <= span / 65534

    predicted_energy = card.submission["energy_predicted"].per_frame
    expected = predicted_energy.mean(axis=0)
    assert row.energy.mean == pytest.approx(expected)
    true_energy = card.submission["energy_true"].per_frame
    expected = true_energy.mean(axis=0)
    assert board.tabs[0].energy.mean == pytest.approx(expected)


def test_residual_histograms(card: ScoreCard) -> None:
    """Shares of predicted minus true vorticity over its own range, as NumPy has
    them.
    """
    truth, prediction = card.preview.vorticity.astype(float)
    histograms = residual_histograms(card.preview)
    differences = prediction - truth
    for histogram, difference in zip(histograms, differences, strict=True):
        residual = difference[~np.isnan(difference)]
        greatest = np.abs(residual).max()
        half_bin = greatest / (RESIDUAL_BINS - 1)
        end = greatest + half_bin
        ends = (-end, end)
        counts, _ = np.histogram(residual, bins=RESIDUAL_BINS, range=ends)
        shares = counts / residual.size
        assert histogram.low == -greatest
        assert histogram.high == greatest
        assert histogram.shares == pytest.approx(shares)


def made_up(per_frame: NDArray[np.float64]) -> Score:
    """Return a score of the ranking metric with given values, shape [scenario,
    frame].
    """
    count, frame_count = per_frame.shape
    frames = range(10, 10 + frame_count)
    return Score(
        metric=METRICS["vorticity_rmse"],
        scenarios=tuple(range(count)),
        frames=tuple(frames),
        per_frame=per_frame,
        values=np.zeros(count),
        undefined=(0,) * count,
    )


def test_curves_keep_the_ends() -> None:
    """At most 120 frames, first and last among them; mean, lowest and highest of the
    scenarios.
    """
    steps = np.arange(598.0)
    per_frame = np.stack([steps, 3.0 * steps])
    per_frame[0, 0] = np.nan
    curve = make_curve(made_up(per_frame))
    assert len(curve.frames) == CURVE_FRAMES
    assert curve.frames[0] == 10
    assert curve.frames[-1] == 607

    chosen_steps = np.array(curve.frames) - 10.0
    mean = 2.0 * chosen_steps
    assert curve.mean[0] == 0.0
    assert curve.mean[1:] == pytest.approx(mean[1:])
    assert curve.low[1:] == pytest.approx(chosen_steps[1:])
    assert curve.high == pytest.approx(3.0 * chosen_steps)


def test_curves_of_sampled_metrics_are_lines() -> None:
    """A metric that is measured at every tenth frame has these frames, and no gaps
    between them.
    """
    every_tenth = range(9, 298, 10)
    per_frame = np.full((2, 298), np.nan)
    per_frame[:, every_tenth] = np.arange(29.0)
    curve = make_curve(made_up(per_frame))
    assert curve.frames == tuple(range(19, 308, 10))
    assert list(curve.mean) == list(range(29))


def test_curves_of_metrics_kept_at_some_sampled_frames_are_lines() -> None:
    """The shipped scores of a reference predictor have a tenth frame here and there."""
    kept = [9, 29, 39, 59, 109]
    per_frame = np.full((1, 148), np.nan)
    per_frame[:, kept] = np.arange(5.0)
    curve = make_curve(made_up(per_frame))
    assert curve.frames == (19, 39, 49, 69, 119)
    assert list(curve.mean) == list(range(5))


def test_curves_of_metrics_of_every_frame_keep_their_gaps() -> None:
    """A frame without a value is a gap."""
    per_frame = np.ones((2, 50))
    per_frame[:, 20:30] = np.nan
    curve = make_curve(made_up(per_frame))
    assert len(curve.frames) == 50
    assert np.isnan(curve.mean).sum() == 10


def test_undefined_seeds_are_left_out(bench: BoardBench) -> None:
    """A scenario that one seed has no value for takes the other's; none stays
    undefined.
    """
    name = "vorticity_pearson"
    defined = read_statistics(bench.folder / "scores/cavity/tiny/noisy.nc")
    undefined = read_statistics(bench.folder / "floors/cavity/tiny/persistence.nc")
    combined = combine([defined.tallies, undefined.tallies])
    expected = defined.scores()[name].values
    assert_array_equal(combined[name].score.values, expected)
    assert math.isnan(combined[name].std)


def test_the_order_of_files_does_not_matter(bench: BoardBench, tmp_path: Path) -> None:
    """The same submissions, copied in another order and time, give the same bytes of
    the page.
    """
    files = [path for path in bench.folder.rglob("*.*") if path.is_file()]
    files.sort()
    pages = []
    for ordered_files in (files, files[::-1]):
        target = tmp_path / str(len(pages))
        for path in ordered_files:
            copy = target / path.relative_to(bench.folder)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
        result = build(target, registry=bench.registry)
        pages.append(result.page.read_bytes())
    assert pages[0] == pages[1]


def test_less_is_formed_to_the_same_numbers(bench: BoardBench, board: Board) -> None:
    """A board of some metrics without pictures has the ranks and values of the whole
    one.
    """
    scope = Scope(
        metrics=("position_rmse",),
        intervals=(),
        has_pictures=False,
    )
    small = collect(bench.folder, registry=bench.registry, scope=scope)
    for row, whole in zip(small.tabs[0].rows, board.tabs[0].rows, strict=True):
        assert row.values.keys() == {"vorticity_nrmse", "position_rmse"}
        for metric, value in row.values.items():
            assert value.mean == whole.values[metric].mean
        assert math.isnan(row.values["position_rmse"].low)
        assert row.losses.tolist() == whole.losses.tolist()
        assert row.pictures is None
        assert row.rank == whole.rank


def test_variants_follow_from_names() -> None:
    """A name that continues another one of the same authors with a comma or a word is
    that of a variant.
    """
    gns = make_entry("GNS", 0, "cavity", "mini", None)
    entries = []
    for name in (
        "GNS",
        "GNS, wide",
        "GNS without noise",
        "GNS2",
        "GNS + MLP",
        "GNS, wide, 2",
    ):
        method = re.sub("[^a-z0-9]+", "-", name.lower())
        entry = gns.model_copy(update={"name": name, "method": method})
        entries.append(entry)
    of_others = {"authors": ("Z.",), "method": "theirs"}
    stranger = entries[1].model_copy(update=of_others)
    variants = find_variants([*entries, stranger], entries)
    assert variants == {
        "gns-wide": "gns",
        "gns-without-noise": "gns",
        "gns-wide-2": "gns",
    }


TWO_SPLITS = ("poiseuille", "decaying-vortices")


@pytest.fixture
def two_splits(tmp_path: Path) -> Path:
    """A copy of the data sets of two splits of the committed leaderboard."""
    board = tmp_path / "board"
    for folder in ("submissions", "scores", "weights"):
        for split in TWO_SPLITS:
            shutil.copytree(COMMITTED / folder / split, board / folder / split)
    return board


@pytest.mark.slow
def test_workers_form_the_same_page(
    two_splits: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tabs of worker processes give the bytes of those that are formed here."""
    here = build(two_splits)
    page_of_here = here.page.read_bytes()
    here.page.unlink()
    started = []
    monkeypatch.setattr(board_build, "FEWEST_FOR_WORKERS", 1)
    monkeypatch.setattr(board_build, "available_cores", lambda: started.append(2) or 2)
    by_workers = build(two_splits)
    assert started
    data_sets = list(two_splits.glob("submissions/*/*"))
    assert by_workers.tabs == len(data_sets)
    assert by_workers.page.read_bytes() == page_of_here


@pytest.fixture
def two_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Boards of any size are formed by two workers."""
    monkeypatch.setattr(board_build, "FEWEST_FOR_WORKERS", 1)
    monkeypatch.setattr(board_build, "available_cores", lambda: 2)


@pytest.mark.slow
@pytest.mark.usefixtures("two_workers")
def test_a_worker_names_a_damaged_score_file(two_splits: Path) -> None:
    """An error in a worker process is that of this process."""
    damaged = next(two_splits.glob("scores/poiseuille/*/*.nc"))
    damaged.write_bytes(damaged.read_bytes()[:5000])
    with pytest.raises(UnreadableFileError) as caught:
        build(two_splits)
    assert caught.value.where == str(damaged)
    assert not (two_splits / "index.html").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("two_workers")
def test_workers_name_a_broken_package_once(
    two_splits: Path, package: Callable[..., Path]
) -> None:
    package("metrics", "broken_metric:METRICS", "raise KeyError('mine')\n")
    with warnings.catch_warnings(record=True, action="default") as caught:
        build(two_splits)
    (warning,) = caught
    assert warning.category is PluginWarning
    assert "mine adds no metric" in str(warning.message)


@pytest.mark.slow
@pytest.mark.usefixtures("two_workers")
def test_a_lost_worker_is_no_finding_of_the_check(
    two_splits: Path, package: Callable[..., Path]
) -> None:
    """Where the machine fails, nothing is known of the page."""
    build(two_splits)
    deadly = f"import os\nif os.getpid() != {os.getpid()}:\n    os._exit(9)\n"
    package("metrics", "deadly_metric:METRICS", f"{deadly}METRICS = ()\n")
    with pytest.raises(WorkFailedError, match="died"):
        check_board(two_splits, page=True, isolated=False)


def test_an_entry_in_another_place_is_refused(own: BoardBench) -> None:
    """Nothing is collected from a folder with a displaced entry, and no board from no
    folder.
    """
    elsewhere = own.folder / PLACE / "other.yaml"
    own.entry("noisy").rename(elsewhere)
    with pytest.raises(ChecksFailedError) as caught:
        collect(own.folder, registry=own.registry)
    assert caught.value.where == "submissions/cavity/tiny/other.yaml"
    with pytest.raises(UsageError) as caught:
        collect(own.folder / "nothing", registry=own.registry)
    assert caught.value.where.endswith("leaderboard/nothing")


def test_only_the_chosen_data_sets_are_read(board: Board, own: BoardBench) -> None:
    """The files of other data sets are not read; the chosen ones are as in the whole
    board.
    """

    def collect_only(*data_sets: tuple[str, str]) -> Board:
        return collect(own.folder, only=data_sets, registry=own.registry)

    known = Folder(own.folder).data_sets()
    assert to_plain(collect_only(*known)) == to_plain(board)
    own.entry("noisy").write_text("no entry")
    nothing = collect_only(("cavity", "mini"))
    assert nothing.tabs == ()
    assert nothing.empty == (("cavity", "mini"),)
    with pytest.raises(LagbenchError):
        collect_only(("cavity", "tiny"))


def test_tables_show_ranks_spread_cost_and_flags(board: Board) -> None:
    """Reference predictors stand there without a rank."""
    (table,) = tables(board, ["position_rmse"])
    assert table.columns[:5] == (
        "rank",
        "method",
        "skill",
        "score",
        "position_rmse",
    )
    rows = {row[1]: row for row in table.rows}
    for reference in board.tabs[0].references:
        row = rows[reference.name]
        assert row[0] == "-"
        assert row[-1] == reference.kind
    damped = rows["damped"]
    rank = row_of(board, "damped").rank
    assert damped[0] == str(rank)
    assert damped[5] == "0.5*"  # stated in the entry, and measured by nobody
    for row in table.rows:
        assert "\n" not in row[-1]
    (wide,) = tables(board, wide=True)
    wide_rows = {row[1]: row for row in wide.rows}
    score = wide_rows["damped"][3]
    assert " ± " in score


def test_json_has_the_numbers_of_the_board(board: Board) -> None:
    """Digits are those of scores.json."""
    (plain,) = to_plain(board)["tabs"]
    rows = {row["id"]: row for row in plain["rows"]}
    damped = rows["damped"]
    value = row_of(board, "damped").values["position_rmse"]
    metric = damped["metrics"]["position_rmse"]
    assert metric["mean"] == digits(value.mean)
    assert damped["cost"]["speed_up"] == 4.0
    names = sorted(reference.name for reference in board.tabs[0].references)
    references = sorted(reference["id"] for reference in plain["references"])
    assert references == names
    assert damped["shared_with"] == []


def test_unknown_names_are_refused(board: Board) -> None:
    """The nearest known name is in the message."""
    with pytest.raises(UsageError) as caught:
        choose_data_sets([("cavity", "tiny")], "cavity", "tyni", board=Path("b"))
    assert "cavity tiny" in str(caught.value.fix)
    with pytest.raises(UsageError) as caught:
        list(tables(board, ["position_rmsee"]))
    assert caught.value.where == "--metric"


def test_boards_without_an_entry_are_named(
    bench: BoardBench, board: Board, tmp_path: Path
) -> None:
    """Every size with scenarios enough to rank is a tab or is named; an empty folder
    has no tab.
    """
    assert ("cavity", "mini") in board.empty
    assert ("cavity", "tiny") not in board.empty
    (tmp_path / "submissions").mkdir()
    empty = collect(tmp_path, registry=bench.registry)
    assert empty.tabs == ()
    assert set(board.empty) <= set(empty.empty)
    assert choose_data_sets([], None, None, board=Path("b")) == ()
    result = build(tmp_path, registry=bench.registry)
    assert result.rows == 0


def test_the_page_links_to_the_documentation_where_that_has_an_address(
    tmp_path: Path,
) -> None:
    """Without an address the page links only to files beside it, and the build prints
    no message.
    """
    (tmp_path / "submissions").mkdir()
    result = build(tmp_path, documentation="https://example.org/docs/")
    page = result.page.read_text("utf-8")
    for label, name in PAGES.items():
        link = f'<a href="https://example.org/docs/{name}.html">{label}</a>'
        assert link in page
    build(tmp_path, documentation="https://example.org/docs/", check=True)

    build(tmp_path, documentation="")
    page = result.page.read_text("utf-8")
    for label in PAGES:
        assert f">{label}</a>" not in page
    with pytest.raises(ChecksFailedError):
        build(tmp_path, documentation="https://example.org/docs/", check=True)


@pytest.mark.parametrize("value", [-1.0, math.nan])
def test_impossible_scores_name_their_file(own: BoardBench, value: float) -> None:
    """Negative errors, or none at all, stop the page, which names the file."""
    path = own.folder / "scores/cavity/tiny/noisy.nc"
    with netCDF4.Dataset(path, "a") as file:
        file.set_auto_maskandscale(False)
        file["value"][:] = value
    with pytest.raises(UnreadableFileError) as caught:
        collect(own.folder, registry=own.registry)
    assert caught.value.where == str(path)
    assert "leaderboard check" in str(caught.value.fix)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_impossible_range_of_a_histogram_names_its_file(
    own: BoardBench, value: float
) -> None:
    """Neither an endless axis nor shares without an axis reach the page."""
    path = own.folder / "scores/cavity/tiny/noisy.nc"
    with netCDF4.Dataset(path, "a") as file:
        file["preview/histogram_range"][0, 1] = value
    with pytest.raises(UnreadableFileError) as caught:
        collect(own.folder, registry=own.registry)
    assert caught.value.where == str(path)


def test_weights_that_fail_a_gate_are_marked(tmp_path: Path) -> None:
    """They are found by the hash of the weights; a broken list is named."""
    sha256 = "a" * 64
    weights = Weights(path="x", sha256=sha256)
    entry = make_entry("GNS", 1, "cavity", "mini", None)
    prediction = entry.predictions[0].model_copy(update={"weights": weights})
    with_weights = entry.model_copy(update={"predictions": (prediction,)})
    path = tmp_path / "gates.json"
    row = {"weights_sha256": sha256, "failed": ["one_step"]}
    path.write_text(json.dumps({"weights": [row]}))
    failed = read_failed_gates(Folder(tmp_path))
    assert gates_failed_by(with_weights, failed) == ("one_step",)
    assert gates_failed_by(entry, failed) == ()
    text = {**row, "failed": "one_step"}
    for damaged in ({}, {"weights": {}}, {"weights": [text]}):
        path.write_text(json.dumps(damaged))
        with pytest.raises(UnreadableFileError):
            read_failed_gates(Folder(tmp_path))
