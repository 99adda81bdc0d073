"""The board as it is collected: numbers against the scorer's, ranks, seeds,
pictures.
"""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from made_up import PLACE, BoardBench, copied, master, noisy
from numpy.typing import NDArray

from lagbench.board.build import (
    CURVE_FRAMES,
    RESIDUAL_BINS,
    build,
    collect,
    curve,
    residuals,
)
from lagbench.board.folder import Folder
from lagbench.board.model import Board, Row
from lagbench.board.ranking import combine
from lagbench.board.show import as_plain, chosen_data_sets, tables
from lagbench.data.registry import Registry
from lagbench.errors import ChecksFailedError, DataError, LagbenchError, UsageError
from lagbench.metrics import METRICS, Score, bootstrap_interval
from lagbench.references.table import REFERENCES
from lagbench.scoring.card import SUBMISSION, ScoreCard, digits
from lagbench.scoring.score_file import read_statistics
from lagbench.scoring.score_file_checks import read_score_file


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
    return bench.data.card(bench.predict(noisy, "again"))


def row_of(board: Board, method: str) -> Row:
    """Return a row of the only tab."""
    return next(row for row in board.tabs[0].rows if row.id == method)


def test_values_are_those_of_the_scorer(board: Board, card: ScoreCard) -> None:
    """Mean, interval, scenarios, undefined frames and frames of interest of every
    metric.
    """
    values = row_of(board, "noisy").values
    assert set(values) == set(card.submission)
    for name, score in card.submission.items():
        held = values[name]
        assert digits(held.mean) == digits(score.mean)
        assert [digits(held.low), digits(held.high)] == [
            digits(bound) for bound in score.interval
        ]
        assert np.array_equal(held.per_scenario, score.values, equal_nan=True)
        assert held.undefined == sum(score.undefined)
        assert math.isnan(held.std)
        for frame, value in held.at.items():
            defined = score.at(frame)[~np.isnan(score.at(frame))]
            assert digits(value) == digits(
                float(np.mean(defined)) if defined.size else math.nan
            )


def test_floors_stand_as_the_scorer_sees_them(board: Board, card: ScoreCard) -> None:
    """Every floor of the scorer is there, with the scores that it has beside any
    submission.
    """
    floors = {floor.name: floor for floor in board.tabs[0].floors}
    assert set(floors) == set(card.scores) - {SUBMISSION}
    assert set(floors) < set(REFERENCES)
    for name, floor in floors.items():
        assert set(floor.values) == set(card.scores[name])
        for metric, score in card.scores[name].items():
            assert digits(floor.values[metric].mean) == digits(score.mean)
            assert floor.values[metric].per_scenario == pytest.approx(
                score.values, rel=1e-6, nan_ok=True
            )


def test_seeds_are_averaged(bench: BoardBench, board: Board) -> None:
    """Mean over seeds per scenario, sample deviation over seeds, interval over both."""
    files = [bench.folder / f"scores/cavity/tiny/damped_{seed}.nc" for seed in (0, 3)]
    first, second = (read_statistics(path).scores() for path in files)
    row = row_of(board, "damped")
    assert [made.seed for made in row.entry.predictions] == [0, 3]
    for name in ("vorticity_rmse", "position_rmse", "energy_error"):
        one = first[name].values
        two = second[name].values
        held = row.values[name]
        assert held.per_scenario == pytest.approx((one + two) / 2.0)
        assert held.mean == pytest.approx((one + two).mean() / 2.0)
        assert held.std == pytest.approx(abs(one.mean() - two.mean()) / math.sqrt(2.0))
        assert (held.low, held.high) == bootstrap_interval(np.stack([one, two]))
    assert row.seed_means == pytest.approx(
        (first["vorticity_nrmse"].mean, second["vorticity_nrmse"].mean)
    )


def test_a_split_that_is_not_known_here(bench: BoardBench) -> None:
    """The entry is named: a package that describes its split is missing."""
    with pytest.raises(DataError) as caught:
        collect(bench.folder, registry=Registry({}, {}))
    assert caught.value.where in {
        str(path) for path in (bench.folder / "submissions").rglob("*.yaml")
    }


def test_few_scenarios_decide_nothing(board: Board) -> None:
    """With two scenarios there is no p-value, so no sign, and the tab says so; ranks
    are the order.
    """
    (tab,) = board.tabs
    assert not tab.decided
    ranked = [row for row in tab.rows if row.rank is not None]
    assert {row.id for row in ranked} == {"damped", "noisy", "flipping"}
    assert [row.rank for row in ranked] == [1, 2, 3]
    assert all(math.isnan(row.p) and not row.tied for row in ranked)
    means = [row.values[tab.ranking].mean for row in ranked]
    assert means == sorted(means)


def test_withdrawn_superseded_and_outdated_are_not_ranked(own: BoardBench) -> None:
    """They stay on the board, below, and say why; scores of another task are left
    out.
    """
    own.edit("noisy", lambda held: held.update(status="withdrawn", reason="leaked"))
    own.edit(
        "damped",
        lambda held: held.update(status="superseded", superseded_by="flipping"),
    )
    own.edit("flipping", lambda held: held["dataset"].update(sha256="0" * 64))
    rows = {
        row.id: row for row in collect(own.folder, registry=own.registry).tabs[0].rows
    }
    assert all(row.rank is None for row in rows.values())
    assert not any(row.active for row in rows.values())
    assert rows["noisy"].entry.reason == "leaked"
    assert not rows["flipping"].current


def test_the_truth_is_not_that_of_an_explosion(bench: BoardBench, board: Board) -> None:
    """Maps of truth and prediction share one packing: the tab's truth is the finest."""
    names = ("flipping", "noisy")
    coarse, fine = (
        read_score_file(bench.folder / f"scores/cavity/tiny/{name}.nc") for name in names
    )
    assert coarse.precision > 5.0 * fine.precision
    truth = board.tabs[0].truth.vorticity
    np.testing.assert_allclose(truth, fine.preview.vorticity[0], atol=fine.precision)


def test_pictures_are_those_that_were_taken(board: Board, card: ScoreCard) -> None:
    """Film and maps come back within half a step of their packing; energy is the
    scorer's.
    """
    detail = row_of(board, "noisy")
    assert np.abs(detail.pictures.film - card.preview.film[1]).max() <= 2.0 / 65534
    known = ~np.isnan(card.preview.vorticity[1])
    span = np.nanmax(card.preview.vorticity) - np.nanmin(card.preview.vorticity)
    apart = np.abs(detail.pictures.vorticity - card.preview.vorticity[1])[known]
    assert apart.max() <= span / 65534
    assert detail.energy.mean == pytest.approx(
        card.submission["energy_predicted"].per_frame.mean(axis=0)
    )
    assert board.tabs[0].energy.mean == pytest.approx(
        card.submission["energy_true"].per_frame.mean(axis=0)
    )


def test_residual_histograms(card: ScoreCard) -> None:
    """Shares of predicted minus true vorticity over its own range, against NumPy's
    histogram.
    """
    for found, (truth, prediction) in zip(
        residuals(card.preview),
        np.swapaxes(card.preview.vorticity.astype(float), 0, 1),
        strict=True,
    ):
        r = (prediction - truth)[~np.isnan(truth)]
        end = np.abs(r).max()
        half = end / (RESIDUAL_BINS - 1)
        counts, _ = np.histogram(r, bins=RESIDUAL_BINS, range=(-end - half, end + half))
        assert (found.low, found.high) == (-end, end)
        assert found.shares == pytest.approx(counts / r.size)


def made_up(per_frame: NDArray[np.float64]) -> Score:
    """Return a score of the ranking metric with given values, shape [scenario,
    frame].
    """
    count, frames = per_frame.shape
    return Score(
        metric=METRICS["vorticity_rmse"],
        scenarios=tuple(range(count)),
        frames=tuple(range(10, 10 + frames)),
        per_frame=per_frame,
        values=np.zeros(count),
        undefined=(0,) * count,
    )


def test_curves_keep_the_ends() -> None:
    """At most 120 frames, first and last among them; mean, lowest and highest of the
    scenarios.
    """
    frames = np.stack([np.arange(598.0), 3.0 * np.arange(598.0)])
    frames[0, 0] = np.nan
    found = curve(made_up(frames))
    assert len(found.frames) == CURVE_FRAMES
    assert (found.frames[0], found.frames[-1]) == (10, 607)
    assert found.mean[0] == 0.0
    assert found.low[1:] == pytest.approx(np.array(found.frames[1:]) - 10.0)
    assert found.high == pytest.approx(3.0 * (np.array(found.frames) - 10.0))
    assert found.mean[1:] == pytest.approx(2.0 * (np.array(found.frames[1:]) - 10.0))


def test_curves_of_sampled_metrics_are_lines() -> None:
    """A metric that is measured at every tenth frame has these frames, and no gaps
    between them.
    """
    frames = np.full((2, 298), np.nan)
    frames[:, 9::10] = np.arange(29.0)
    found = curve(made_up(frames))
    assert found.frames == tuple(range(19, 308, 10))
    assert list(found.mean) == list(range(29))


def test_undefined_seeds_are_left_out(bench: BoardBench) -> None:
    """A scenario that one seed has no value for takes the other's; none stays
    undefined.
    """
    paths = ("scores/cavity/tiny/noisy.nc", "floors/cavity/tiny/persistence.nc")
    held = [read_statistics(bench.folder / path) for path in paths]
    found = combine(held)["vorticity_pearson"]
    assert np.array_equal(
        found.score.values, held[0].scores()["vorticity_pearson"].values
    )
    assert math.isnan(found.std)


def test_the_order_of_files_does_not_matter(bench: BoardBench, tmp_path: Path) -> None:
    """The same submissions, copied in another order and time, give the same bytes of
    the page.
    """
    pages = []
    for reverse in (False, True):
        target = tmp_path / str(reverse)
        for path in sorted(
            filter(Path.is_file, bench.folder.rglob("*.*")), reverse=reverse
        ):
            copy = target / path.relative_to(bench.folder)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
        pages.append(build(target, registry=bench.registry).page.read_bytes())
    assert pages[0] == pages[1]


def test_an_entry_in_another_place_is_refused(own: BoardBench) -> None:
    """Nothing is collected from a folder with a displaced entry, and no board from no
    folder.
    """
    own.entry("noisy").rename(own.folder / PLACE / "other.yaml")
    with pytest.raises(ChecksFailedError, match="another place"):
        collect(own.folder, registry=own.registry)
    with pytest.raises(UsageError, match="no leaderboard here"):
        collect(own.folder / "nothing", registry=own.registry)


def test_some_data_sets_are_read_alone(board: Board, own: BoardBench) -> None:
    """What was not asked for is not even read; what was is as in the whole board."""
    some = collect(
        own.folder, only=Folder(own.folder).data_sets(), registry=own.registry
    )
    assert as_plain(some) == as_plain(board)
    own.entry("noisy").write_text("no entry")
    nothing = collect(own.folder, only=[("cavity", "mini")], registry=own.registry)
    assert (nothing.tabs, nothing.empty) == ((), (("cavity", "mini"),))
    with pytest.raises(LagbenchError):
        collect(own.folder, only=[("cavity", "tiny")], registry=own.registry)


def test_tables_and_json(board: Board) -> None:
    """The terminal shows ranks, spread, cost, floors and flags; JSON has the same
    numbers.
    """
    (table,) = tables(board, ["position_rmse"])
    assert table.columns[:5] == (
        "rank",
        "method",
        "skill",
        "vorticity_nrmse",
        "position_rmse",
    )
    rows = {row[1]: row for row in table.rows}
    measured = sorted(floor.name for floor in board.tabs[0].floors)
    for name in measured:
        assert (rows[name][0], rows[name][-1]) == ("-", "floor")
    assert rows["damped"][0] == str(row_of(board, "damped").rank)
    assert " ± " in rows["damped"][3]
    assert rows["damped"][5:7] == ("0.5", "4")
    (plain,) = as_plain(board)["tabs"]
    means = {
        row["id"]: row["metrics"]["position_rmse"]["mean"] for row in plain["rows"]
    }
    assert means["damped"] == digits(
        row_of(board, "damped").values["position_rmse"].mean
    )
    assert [floor["id"] for floor in plain["floors"]] == measured
    assert {row["id"]: row["cost"] for row in plain["rows"]}["damped"][
        "speed_up"
    ] == 4.0
    with pytest.raises(UsageError, match="did you mean 'cavity tiny'"):
        chosen_data_sets([("cavity", "tiny")], "cavity", "tyni")
    with pytest.raises(UsageError, match="no metric"):
        list(tables(board, ["position_rmsee"]))


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
    assert chosen_data_sets([], None, None) == ()
    assert build(tmp_path, registry=bench.registry).rows == 0
