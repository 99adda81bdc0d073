"""Submitting: what is written, what is refused, and that it is all or nothing."""

from __future__ import annotations

import datetime
import functools
import json
import multiprocessing
import os
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_bench import DAY, BoardBench, copied, damped, motion, nearer, noisy, still
from turns import of_this_turn

from lagbench import __version__
from lagbench.board import publish
from lagbench.board import submit as submitting
from lagbench.board.check import check_board
from lagbench.board.entry import Meta
from lagbench.board.entry_file import read_entry, read_meta
from lagbench.data.checksums import file_sha256
from lagbench.errors import (
    ChecksFailedError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.references import references_of
from lagbench.scoring import score as scorer
from lagbench.scoring.score_file_checks import read_score_file
from lagbench.submission import open_predictions
from lagbench.submission.validation import validate


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard."""
    return copied(home, tmp_path)


@pytest.fixture
def predictions(own: BoardBench) -> Path:
    """Predictions of a model that is not on the board yet."""
    labels = {
        "device": "a laptop",
        "seconds_per_frame": 0.25,
        "parameters": 9,
        "training": "train",
    }
    return own.predict(nearer, "my-model", **labels)


@pytest.fixture
def unscored(own: BoardBench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail where anything is scored after the leaderboard was made."""
    monkeypatch.setattr(submitting, "score", pytest.fail)


def well(bench: BoardBench) -> bool:
    """Tell whether the check of the folder finds nothing."""
    return not check_board(
        bench.folder, registry=bench.registry, isolated=False
    ).findings


@pytest.mark.slow
@pytest.mark.usefixtures("as_shipped")
def test_the_entry_says_all_that_is_known(own: BoardBench, predictions: Path) -> None:
    """Labels of the predictions, what the submitter adds, data set, hashes, scores and
    their origin.
    """
    said = {
        "name": "My model",
        "code": "https://a.org/x",
        "solver_seconds_per_frame": 0.5,
    }
    result = own.submit(predictions, **said)
    entry = read_entry(own.entry("my-model"))
    assert entry.name == "My model"
    assert entry.code == "https://a.org/x"
    assert entry.date == DAY
    assert entry.parameters == 9
    assert entry.training == "train"
    assert entry.cost is not None
    cost = {
        "seconds_per_frame": 0.25,
        "device": "a laptop",
        "solver_seconds_per_frame": 0.5,
    }
    assert entry.cost.model_dump() == cost
    (prediction,) = entry.predictions
    with open_predictions(predictions) as opened:
        assert prediction.sha256 == opened.content_sha256()
        assert entry.dataset.sha256 == opened.header.dataset_sha256
    assert prediction.bytes == predictions.stat().st_size
    assert entry.score.lagbench == __version__
    (score_path,) = entry.score_paths
    score_hash = file_sha256(own.folder / score_path)
    assert entry.score.files[0].sha256 == score_hash
    card = own.data.card(predictions)
    mean = card.submission[card.ranking].mean
    assert result.mean == pytest.approx(mean, rel=1e-8)
    names = [path.name for path in result.files]
    assert names == ["my-model.yaml", "my-model.nc"]
    for path in result.files:
        assert path.stat().st_size <= 1_000_000
    assert well(own)
    before = own.state()
    own.submit(predictions, replace=True, **said)
    assert own.state() == before


def test_replacing_leaves_no_score_file_over(own: BoardBench) -> None:
    """Two seeds that become one: the score files of both are gone, the new one is
    there.
    """
    predictions = own.predict(damped, "damped")
    own.submit(predictions, replace=True)
    scores = own.folder / "scores/cavity/tiny"
    names = [path.name for path in scores.glob("damped*")]
    assert names == ["damped.nc"]


def test_predictions_in_the_folder_are_referred_to(own: BoardBench) -> None:
    """A file inside the leaderboard's folder is named by its path there, one elsewhere
    is not.
    """
    inside = own.folder / "predictions" / "mine.nc"
    inside.parent.mkdir()
    own.data.submit(inside, nearer, "inside")
    own.submit(inside)
    (prediction,) = read_entry(own.entry("inside")).predictions
    assert prediction.path == "predictions/mine.nc"
    (prediction,) = read_entry(own.entry("noisy")).predictions
    assert prediction.path is None
    assert well(own)


@pytest.mark.usefixtures("unscored")
def test_a_name_that_no_entry_can_hold(own: BoardBench) -> None:
    """A path inside the folder that the schema refuses is an error before anything is
    scored.
    """
    inside = own.folder / ("p" * 150) / f"{'q' * 100}.nc"
    inside.parent.mkdir()
    own.data.submit(inside, nearer, "inside")
    with pytest.raises(ChecksFailedError):
        own.submit(inside)
    assert not own.entry("inside").exists()


def tree(folder: Path) -> set[str]:
    """Return everything under a folder, hidden files too."""
    names = set()
    for path in folder.rglob("*"):
        names.add(path.relative_to(folder).as_posix())
    return names


def test_predictions_are_submitted_once(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of another entry or seed are refused under any label; one file twice is
    refused before the work.
    """
    first = own.predict(nearer, "first")
    own.submit(first)
    before = tree(own.folder)
    again = own.predict(nearer, "second")
    with pytest.raises(UsageError):
        own.submit(again)
    one_seed = own.predict(still, "third", seed=0)
    same_content = own.predict(still, "third", seed=1)
    with monkeypatch.context() as patch:
        patch.setattr(submitting, "score", pytest.fail)
        for files in (
            (first,),
            (one_seed, same_content),
        ):
            with pytest.raises(UsageError):
                own.submit(*files, method="other", name="Other")
    assert tree(own.folder) == before
    result = own.submit(again, method="first", replace=True)
    assert result.method == "first"


@pytest.mark.usefixtures("unscored")
def test_equal_predictions_of_several_seeds_come_from_one_training(
    own: BoardBench,
) -> None:
    """No entry has them, so none is to be superseded."""
    files = [own.predict(nearer, "new", seed=seed) for seed in range(3)]
    with pytest.raises(UsageError) as caught:
        own.submit(*files)
    assert has_all_parts(caught.value)
    assert caught.value.where == str(files[1])
    assert str(files[0]) in str(caught.value.got)
    assert "supersede" not in str(caught.value)
    assert "train" in str(caught.value.fix)


def test_written_files_are_named_in_the_order_of_the_seeds(own: BoardBench) -> None:
    """The entry comes first."""
    files = [own.predict(shifted(seed), "new", seed=seed) for seed in range(3)]
    result = own.submit(*files)
    names = [path.name for path in result.files[:4]]
    assert names == ["new.yaml", "new_0.nc", "new_1.nc", "new_2.nc"]


def has_all_parts(error: LagbenchError) -> bool:
    """Say whether a message has where, expected, got and fix."""
    parts = (error.where, error.expected, error.got, error.fix)
    return None not in parts


TWO_ADDRESSES = ("https://a.org/1", "https://a.org/2")
Keys = dict[str, Any]


@pytest.mark.usefixtures("unscored")
@pytest.mark.parametrize(
    "keys",
    [
        {"authors": ()},
        {"command": ""},
        {"method": "noisy"},
        {"method": "persistence"},
        {"name": "NO\u0406SY"},
        {"name": "Persistence"},
        {"urls": TWO_ADDRESSES},
        {"date": datetime.date(2999, 1, 1)},
        {"budget": {"track": "converged"}},
    ],
)
def test_refused_before_the_work(
    keys: Keys, own: BoardBench, predictions: Path
) -> None:
    """What is missing, taken, of a day to come or nobody's to say, before anything is
    scored or written.
    """
    before = tree(own.folder)
    with pytest.raises(UsageError) as caught:
        own.submit(predictions, **keys)
    assert tree(own.folder) == before
    (key,) = keys
    if key == "date":
        assert caught.value.where == "date"
    if key == "budget":
        assert caught.value.where == "budget.track"
    assert has_all_parts(caught.value)


@pytest.mark.usefixtures("unscored")
@pytest.mark.parametrize("line", ["parameters: many", "nmae: Mine", "- a list"])
def test_a_wrong_description_is_named_by_its_file(
    line: str, own: BoardBench, predictions: Path, tmp_path: Path
) -> None:
    meta = tmp_path / "meta.yaml"
    meta.write_text(f"{line}\n")
    with pytest.raises(UsageError) as caught:
        read_meta(meta, {})
    assert has_all_parts(caught.value)
    assert str(meta) in str(caught.value.where)


@pytest.mark.parametrize("text", ["a\x07b", "\u2800"])
def test_words_of_predictions_that_cannot_be_shown(own: BoardBench, text: str) -> None:
    """What predictions say of their training may be anything; an entry that cannot hold
    it is refused.
    """
    before = tree(own.folder)
    predictions = own.predict(nearer, "odd", training=text)
    with pytest.raises(LagbenchError):
        own.submit(predictions)
    left = {path for path in tree(own.folder) if "odd" in path}
    assert left <= before


@pytest.mark.usefixtures("unscored")
@pytest.mark.parametrize(
    ("key", "labels"),
    [
        ("cost.device", {"device": "bad\x1b[31m\ndev"}),
        ("cost.device", {"device": "   "}),
        ("cost.seconds_per_frame", {"seconds_per_frame": 1e-9}),
        ("cost.solver_seconds_per_frame", {"solver_seconds_per_frame": 1e300}),
    ],
)
def test_a_cost_of_predictions_that_no_entry_can_hold(
    own: BoardBench, key: str, labels: Keys
) -> None:
    """Valid predictions may state a cost that no entry allows: the error names the key
    before the work.
    """
    good_labels = {
        "device": "a laptop",
        "seconds_per_frame": 0.25,
    }
    path = own.predict(nearer, "odd", **(good_labels | labels))
    with pytest.raises(ChecksFailedError) as caught:
        own.submit(path)
    assert f"{key}: " in str(caught.value.got)


STATED_COST = {"seconds_per_frame": 0.125, "device": "a desktop"}


def test_the_solvers_time_adds_to_a_stated_cost(
    own: BoardBench, predictions: Path
) -> None:
    own.submit(predictions, cost=STATED_COST, solver_seconds_per_frame=0.5)
    entry = read_entry(own.entry("my-model"))
    assert entry.cost is not None
    expected = {**STATED_COST, "solver_seconds_per_frame": 0.5}
    assert entry.cost.model_dump() == expected


@pytest.mark.usefixtures("unscored")
def test_two_times_of_the_solver_are_refused(
    own: BoardBench, predictions: Path
) -> None:
    cost = {**STATED_COST, "solver_seconds_per_frame": 0.25}
    with pytest.raises(UsageError) as caught:
        own.submit(predictions, cost=cost, solver_seconds_per_frame=0.5)
    assert "solver_seconds_per_frame" in str(caught.value.where)
    assert has_all_parts(caught.value)


@pytest.mark.parametrize("keys", [{"kind": "naive"}, {"command": "  "}])
def test_a_description_that_the_board_would_refuse(keys: Keys) -> None:
    """Naive predictors are references; blanks are no command."""
    with pytest.raises(UsageError) as caught:
        read_meta(None, keys)
    (key,) = keys
    assert f"{key}: " in str(caught.value.got)


TRAINED_ON_TEST = "cavity tiny train+test, recipe cavity/tiny, step 6"
TRAINED = "cavity tiny train, recipe cavity/tiny, step 6"


@pytest.mark.parametrize(
    ("kind", "labels", "word"),
    [
        ("classical", {"training": TRAINED}, "classical"),
        ("classical", {"budget": '{"steps": 6}'}, "classical"),
        ("learned", {"training": TRAINED_ON_TEST}, "test"),
        ("learned", {"budget": '{"steps": 6, "best_step": 7}'}, "best_step"),
    ],
)
@pytest.mark.usefixtures("unscored")
def test_a_training_that_cannot_be_is_refused_before_the_scoring(
    own: BoardBench, kind: str, labels: Keys, word: str
) -> None:
    before = tree(own.folder)
    path = own.predict(nearer, "trained", **labels)
    with pytest.raises(UsageError) as caught:
        own.submit(path, kind=kind)
    assert word in str(caught.value.got)
    assert tree(own.folder) == before


def test_one_error_names_all_mistakes_of_an_entry(
    own: BoardBench, predictions: Path
) -> None:
    """A user who corrects all of them can submit."""
    wrong = {
        "name": "NO\u0406SY",
        "urls": TWO_ADDRESSES,
    }
    mended = {
        "name": "Fine",
        "urls": (),
        "method": "fine",
    }
    alone = []
    for key, value in wrong.items():
        with pytest.raises(UsageError) as caught:
            own.submit(predictions, **(mended | {key: value}))
        alone.append(caught.value.what)
    with pytest.raises(UsageError) as together:
        own.submit(predictions, **wrong)
    for what in alone:
        assert what in str(together.value)
    result = own.submit(predictions, **mended)
    assert result.method == "fine"


@pytest.mark.usefixtures("unscored")
def test_files_that_do_not_belong_together(own: BoardBench) -> None:
    """Several files need seeds that differ; a label that is no id needs --method; no
    file is no entry.
    """
    plain = own.predict(still, "plain")
    other = own.predict(noisy, "other")
    same = own.predict(still, "same", seed=4)
    one = own.predict(still, "one", seed=0)
    another = own.predict(noisy, "another", seed=1)
    odd_path = own.folder.parent / "odd.nc"
    odd = own.data.submit(odd_path, still, "My Model!")
    small = own.predict(still, "sized", seed=0, parameters=9)
    large = own.predict(still, "sized", seed=1, parameters=10)
    for files, keys in (
        ((), {}),
        ((small, large), {}),
        ((plain, other), {"method": "both"}),
        ((same, same), {}),
        ((odd,), {}),
        ((one, another), {"method": "both"}),
    ):
        with pytest.raises(UsageError):
            own.submit(*files, **keys)


def test_invalid_predictions_leave_nothing(
    own: BoardBench, predictions: Path, tmp_path: Path
) -> None:
    """A damaged second file: the first is not scored, nothing is written."""
    import h5py

    damaged = tmp_path / "damaged.nc"
    damaged.write_bytes(predictions.read_bytes())
    with h5py.File(damaged, "r+") as file:
        file["position"][0, 0, 0, 0] = float("nan")
    before = tree(own.folder)
    with pytest.raises(ChecksFailedError) as caught:
        own.submit(predictions, damaged)
    assert caught.value.where == "first in scenario 3, frame 6, particle 0, x"
    with pytest.raises(UnreadableFileError):
        own.submit(tmp_path / "none.nc")
    assert tree(own.folder) == before


def test_an_interruption_is_found(
    own: BoardBench, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Score files come first, the entry last: what a kill leaves is a score file
    without an entry.
    """
    before = own.state()
    move = os.replace

    def killed(source: Path, target: Path) -> None:
        if target.suffix == ".yaml":
            raise KeyboardInterrupt
        move(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", killed)
        with pytest.raises(KeyboardInterrupt):
            own.submit(predictions)
    left = "scores/cavity/tiny/my-model.nc"
    state = own.state()
    assert state == before | {left: state[left]}
    result = check_board(own.folder, registry=own.registry, isolated=False)
    checks = [finding.check for finding in result.findings]
    assert checks == ["stray"]
    own.submit(predictions)
    assert well(own)


def test_a_score_file_that_is_too_long_is_not_published(
    own: BoardBench, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than 1 MB: the work failed, and nothing is left behind."""
    monkeypatch.setattr(publish, "MAX_SCORE_BYTES", 1000)
    before = tree(own.folder)
    with pytest.raises(WorkFailedError) as caught:
        own.submit(predictions)
    assert caught.value.where == "cavity tiny"
    assert tree(own.folder) == before


def test_missing_reference_scores_are_added_when_an_entry_is_submitted(
    own: BoardBench, predictions: Path
) -> None:
    """Scores that are missing, or of another data set, are written again, with the same
    bytes for every submitter.
    """
    folder = own.folder / "floors/cavity/tiny"
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert set(before) == {
        f"{reference.name}.nc"
        for reference in references_of(own.data.size)
        if reference.counts and not reference.reads_train
    }
    first = min(before)
    (folder / first).unlink()
    (folder / max(before)).write_bytes(b"something else")
    result = own.submit(predictions)
    last = max(before)
    assert set(result.files) >= {folder / first, folder / last}
    names = {path.name for path in folder.iterdir()}
    assert names == set(before)
    for path in folder.iterdir():
        score_file = read_score_file(path)
        assert score_file.scores.identity["method"] == path.stem
    assert well(own)


def test_leaving_the_box_comes_with_its_share(own: BoardBench) -> None:
    """One particle in 2048, say, that lies outside at all frames but some: the share is
    that of positions.
    """

    def leaving(truth: Any, n: int, h: int) -> Any:
        prediction = np.array(nearer(truth, n, h))
        way_out = np.linspace(0.0, 3.0, h - 1)
        prediction[1:, :3, 0] += way_out[:, None]
        return prediction

    own.submit(own.predict(leaving, "leaving"))
    entry = read_entry(own.entry("leaving"))
    warnings = {warning.name: warning for warning in entry.score.files[0].warnings}
    warning = warnings["in_domain"]
    task = own.data.size.task
    size = own.data.size
    outside = 0
    _, high = size.bounds[0]
    room = high + 1.0 / size.grid
    scenarios = size.subsets["test"]
    for scenario in scenarios:
        truth = motion(size, scenario)
        prediction = leaving(truth, task.input_frames, task.horizon)
        x = prediction.astype(np.float32)[..., 0]
        outside += int((x > room).sum())
    count = len(scenarios) * task.horizon * size.particles
    assert 0.0 < outside < count
    assert warning.share == pytest.approx(outside / count, rel=1e-3)


def test_no_board_is_begun_by_mistake(
    own: BoardBench, predictions: Path, tmp_path: Path
) -> None:
    """A new board needs its option, and a folder without other files. Files of git and
    a README are allowed.
    """
    meta = Meta(authors=("A. Author",), command="make", date=DAY)
    board = tmp_path / "site"
    where = own.where | {"board": board}
    with pytest.raises(UsageError) as caught:
        submitting.submit([predictions], meta, **where)
    assert "--new-board" in str(caught.value.fix)
    assert not board.exists()
    where["new_board"] = True
    result = submitting.submit([predictions], meta, **where)
    assert result.board == board
    shutil.rmtree(board)
    (board / ".git").mkdir(parents=True)
    for name in ("README.md", "index.html"):
        (board / name).write_text("mine")
    with pytest.raises(UsageError) as caught:
        submitting.submit([predictions], meta, **where)
    assert caught.value.where == str(board)
    assert caught.value.got == "'index.html'"
    assert sorted(path.name for path in board.iterdir()) == [
        ".git",
        "README.md",
        "index.html",
    ]
    (board / "index.html").unlink()
    result = submitting.submit([predictions], meta, **where)
    assert result.board == board


def test_what_is_not_given(own: BoardBench) -> None:
    """The date is today's in UTC; seeds timed on different machines have no cost."""
    first = own.predict(
        nearer,
        "mixed",
        seed=0,
        device="one",
        seconds_per_frame=0.25,
    )
    second = own.predict(
        still,
        "mixed",
        seed=1,
        device="two",
        seconds_per_frame=0.25,
    )
    assert own.submit(first, date=None).has_cost
    result = own.submit(first, second, date=None, replace=True)
    assert not result.has_cost
    entry = read_entry(own.entry("mixed"))
    assert entry.cost is None
    today = datetime.datetime.now(datetime.UTC).date()
    assert abs(entry.date - today) <= datetime.timedelta(days=1)


def rounds(few: int, many: int) -> Any:
    """Return the first rounds for every run, and those of this turn for slow ones."""
    slow = pytest.param(of_this_turn(range(many), turns=6), marks=pytest.mark.slow)
    return pytest.mark.parametrize("numbers", [range(few), slow], ids=["few", "many"])


SERVER = multiprocessing.get_context("forkserver")
"""Processes are forks of one without threads: a fork of this one may wait for ever for
a lock that a thread held.
"""
SERVER.set_forkserver_preload([__name__])
REFUSED = 2  # exit code of a process whose submission is refused


def submit_here(bench: BoardBench, path: Path, name: str, add: bool) -> None:
    """Submit in this process, which ends with ``REFUSED`` where that is refused."""
    # For speed, and for kills between the writes: predictions are read here.
    read_here = functools.partial(validate, isolated=False)
    with pytest.MonkeyPatch.context() as patch:
        for module in (submitting, scorer):
            patch.setattr(module, "validate", read_here)
        try:
            bench.submit(path, add=add, method=name)
        except UsageError:
            os._exit(REFUSED)


def begin(bench: BoardBench, path: Path, name: str, *, add: bool) -> Any:
    """Return a process that submits: HDF5 bears no two threads."""
    process = SERVER.Process(target=submit_here, args=(bench, path, name, add))
    with pytest.MonkeyPatch.context() as patch:
        # The server imports this module once for all its forks.
        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
        process.start()
    return process


def finish(processes: Sequence[Any]) -> list[int]:
    """Return the exit codes of processes when they have ended."""
    codes = []
    for process in processes:
        process.join(timeout=60)
        codes.append(process.exitcode)
    return codes


@pytest.mark.slow
@rounds(1, 20)
def test_two_that_add_a_seed_at_once_lose_none(
    own: BoardBench, numbers: Sequence[int]
) -> None:
    """Both seeds are there, or one of the two was refused and says so."""
    for number in numbers:
        name = f"twice-{number}"
        paths = []
        for seed in range(3):
            step = 3 * number + seed
            paths.append(own.predict(shifted(step), name, seed=seed))
        first, *others = paths
        own.submit(first, method=name)
        processes = [begin(own, path, name, add=True) for path in others]
        codes = finish(processes)
        entry = read_entry(own.entry(name))
        assert set(codes) <= {0, REFUSED}
        assert 0 in codes
        assert len(entry.seeds) == 3 - codes.count(REFUSED)
    assert well(own)


@pytest.mark.slow
@rounds(1, 20)
def test_two_that_submit_one_name_at_once(
    own: BoardBench, numbers: Sequence[int]
) -> None:
    """One is there, the other is refused; none is a mixture of both."""
    for number in numbers:
        name = f"race-{number}"
        paths = []
        for side in (0, 1):
            step = 50 + 2 * number + side
            path = own.predict(shifted(step), f"{name}-{side}")
            paths.append(path)
        processes = [begin(own, path, name, add=False) for path in paths]
        codes = finish(processes)
        assert sorted(codes) == [0, REFUSED]
    assert well(own)


def shifted(step: int) -> Any:
    """Return a method whose prediction depends on a number."""

    def predict(truth: Any, n: int, h: int) -> Any:
        frame = np.arange(1, h + 1)[:, None, None]
        shift = 1e-6 * (step + 1) * frame
        return truth[n : n + h] + shift

    return predict


def test_a_killed_submission_is_completed(own: BoardBench, predictions: Path) -> None:
    """After a kill between two moves the next submission moves the rest; a kill before
    the journal leaves nothing. The check finds nothing then.
    """
    before = own.state()
    own.submit(predictions)
    after = own.state()
    new_paths = sorted(after.keys() - before.keys())
    assert len(new_paths) == 2
    for moved_count in (0, 1, 2):
        staging = own.folder / f".submit-{moved_count}"
        staging.mkdir()
        moves = []
        for number, name in enumerate(new_paths):
            if number >= moved_count:
                (own.folder / name).rename(staging / str(number))
            moves.append([str(number), name])
        journal = {"moves": moves, "removed": []}
        (staging / "journal.json").write_text(json.dumps(journal))
        (own.folder / ".submit-cut-short").mkdir()
        with pytest.raises(UsageError):  # it is there: the next one completed it
            own.submit(predictions)
        assert own.state() == after
        assert well(own)


def test_a_journal_of_strangers_leads_nowhere(
    own: BoardBench, predictions: Path
) -> None:
    """Places outside the leaderboard are neither written nor removed."""
    victim = own.folder.parent / "victim.nc"
    victim.write_text("precious")
    staging = own.folder / ".submit-hostile"
    staging.mkdir()
    (staging / "bait").write_text("bad")
    content = {
        "moves": [
            ["bait", "../victim.nc"],
            ["bait", "/etc/x"],
            ["bait", "index.html"],
        ],
        "removed": ["../victim.nc", "scores/../../victim.nc"],
    }
    (staging / "journal.json").write_text(json.dumps(content))
    own.submit(predictions)
    assert victim.read_text() == "precious"
    assert not staging.exists()
    assert well(own)


@pytest.mark.slow
def test_the_next_submission_mends_thirty_kills(own: BoardBench) -> None:
    """A process is killed at another moment each time; then the check is green.

    A third of the thirty at each commit.
    """
    moments = np.random.Generator(np.random.PCG64(30)).uniform(0.02, 1.2, 30)
    for number in of_this_turn(range(30), turns=3):
        name = f"killed-{number}"
        predictions = own.predict(shifted(1000 + number), name)
        process = begin(own, predictions, name, add=False)
        time.sleep(moments[number])
        process.kill()
        process.join(timeout=60)
    own.submit(own.predict(shifted(2000), "the-next"))
    assert well(own)


def test_a_board_may_be_the_root_of_a_repository(own: BoardBench) -> None:
    """What git keeps there is passed over; other strays are named."""
    objects = own.folder / ".git" / "objects"
    objects.mkdir(parents=True)
    (objects / "x").write_text("x")
    (own.folder / ".gitignore").write_text("*.tmp")
    assert well(own)
    (own.folder / "stray.txt").write_text("x")
    result = check_board(own.folder, registry=own.registry, isolated=False)
    (finding,) = result.findings
    assert finding.check == "folder"
    assert "stray.txt" in finding.where
