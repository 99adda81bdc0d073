"""What lies outside a leaderboard's folder: predictions scored again, and the base of a
change.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import yaml
from board_bench import (
    PLACE,
    SCORES,
    BoardBench,
    copied,
    damped,
    nearer,
    noisy,
    reform,
    scale,
    set_mean,
    still,
)

from lagbench.board import submit as submitting
from lagbench.board.build import collect
from lagbench.board.check import CheckResult, check_board
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.metrics import FramePair
from lagbench.metrics.table import available
from lagbench.scoring import score
from lagbench.scoring.score_file_writer import write_statistics

PREDICTOR = "floors/cavity/tiny/persistence.nc"


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard that the test may damage."""
    return copied(
        home,
        tmp_path,
        without=["flipping", "constant-velocity", "frozen-field", "analog"],
    )


def checked(bench: BoardBench, **options: Any) -> CheckResult:
    """Check in this process."""
    return check_board(
        bench.folder,
        registry=bench.registry,
        isolated=False,
        **options,
    )


def findings_of(bench: BoardBench) -> list[str]:
    """Return the names of the checks that find something without either."""
    return [finding.check for finding in checked(bench).findings]


@pytest.fixture
def predictions(own: BoardBench) -> Path:
    """The predictions of noisy."""
    return own.predict(noisy, "noisy", parameters=5)


def rescored(bench: BoardBench, *paths: Path, **options: Any) -> CheckResult:
    """Check with predictions scored again."""
    return checked(bench, predictions=paths, root=bench.data.root, **options)


def verified(bench: BoardBench) -> set[str]:
    """Return the entries that the board calls verified."""
    board = collect(bench.folder, registry=bench.registry)
    return {row.id for row in board.tabs[0].rows if row.verified}


@pytest.mark.slow
def test_scoring_again_confirms_and_is_recorded(
    own: BoardBench, predictions: Path
) -> None:
    """The entry is named with how close it came; only the list makes it verified, while
    its files stay.
    """
    result = rescored(own, predictions)
    assert not result.findings
    (confirmed,) = result.confirmed
    assert confirmed.entry == Path(PLACE, "noisy.yaml")
    assert confirmed.difference == 0.0
    assert not (own.folder / "verified.yaml").exists()
    result = rescored(own, predictions, recording=True)
    assert result.recorded == (f"{PLACE}/noisy.yaml",)
    assert verified(own) == {"noisy"}
    assert findings_of(own) == []
    before = (own.folder / "verified.yaml").read_bytes()
    rescored(own, predictions, recording=True)
    assert (own.folder / "verified.yaml").read_bytes() == before
    reform(own, scale("vorticity_mse", 0.5))
    assert verified(own) == set()
    assert findings_of(own) == ["verified"]


PACKAGE_METRICS = """
from lagbench.metrics import Direction, Metric

def fail(pair):
    raise ValueError("a word of this machine")

def make_metric(name, statistic):
    return Metric(
        name=name, family="mine", unit="1", direction=Direction.LOWER,
        perfect=0.0, source="here", summary="none", statistic=statistic,
    )

METRICS = (
    make_metric("board_fails", fail),
    make_metric("board_works", lambda pair: 1.0),
)
"""


@pytest.mark.slow
def test_metrics_of_packages_decide_nothing(
    own: BoardBench, predictions: Path, package: Callable[..., Path]
) -> None:
    """An entry has none of them. Whoever scores again may have a package that measures
    more or fails.
    """
    own.submit(predictions, replace=True)
    before = own.state()
    package("metrics", "board_metrics:METRICS", PACKAGE_METRICS)
    assert set(available()) >= {"board_fails", "board_works"}
    assert len(rescored(own, predictions).confirmed) == 1
    own.submit(predictions, replace=True)
    assert own.state() == before


@pytest.mark.slow
def test_metrics_of_packages_in_older_entries_decide_nothing(
    own: BoardBench, predictions: Path
) -> None:
    """Whoever scores again lacks the package of the submitter."""

    def measured_elsewhere(pair: FramePair) -> float:
        return 1.0

    card = score.score(
        predictions,
        root=own.data.root,
        registry=own.registry,
        metrics=measured_elsewhere,
        write=False,
    )
    write_statistics(card, own.folder / SCORES / "noisy.nc")
    own.forge("noisy")

    def add_warning(content: dict[str, Any]) -> None:
        warning = {"name": "metric", "reasons": ["the metric my_fails failed"]}
        (file,) = content["score"]["files"]
        file["warnings"] = [*file.get("warnings", []), warning]

    own.edit("noisy", add_warning)
    result = rescored(own, predictions)
    assert not result.findings
    assert len(result.confirmed) == 1
    # the same predictions by another name, measured otherwise
    twin = own.predict(noisy, "twin")
    with pytest.raises(UsageError):
        own.submit(twin)


def test_a_damaged_file_of_a_reference_does_not_end_the_check(
    own: BoardBench, predictions: Path
) -> None:
    """It is reported, and predictions are scored again all the same."""
    (own.folder / PREDICTOR).write_bytes(b"damaged")
    result = rescored(own, predictions)
    assert [finding.check for finding in result.findings] == ["reference"]
    assert len(result.confirmed) == 1


def test_a_method_is_verified_with_all_its_seeds(own: BoardBench) -> None:
    """One of two seeds confirms its score file, not the entry."""
    path = own.predict(
        damped,
        "damped",
        seed=0,
        device="cpu",
        seconds_per_frame=0.25,
    )
    result = rescored(own, path, recording=True)
    (confirmed,) = result.confirmed
    assert confirmed.score_file.name == "damped_0.nc"
    assert result.recorded == ()
    assert result.partly == (f"{PLACE}/damped.yaml",)


def test_scoring_again_finds_what_a_forger_hid(
    own: BoardBench, predictions: Path
) -> None:
    """Statistics halved, hashes and aggregates forged: only the predictions themselves
    show it.
    """
    reform(own, scale("vorticity_mse", 0.5))
    assert findings_of(own) == []
    result = rescored(own, predictions, recording=True)
    (finding,) = result.findings
    assert finding.check == "rescored"
    assert finding.got == "other vorticity_mse"
    assert result.confirmed == ()
    assert result.recorded == ()
    own.entry("noisy").unlink()
    (own.folder / SCORES / "noisy.nc").unlink()
    (finding,) = rescored(own, predictions).findings
    assert finding.check == "rescored"


def test_flags_and_reference_scores_are_compared(
    own: BoardBench, predictions: Path
) -> None:
    """Flags, frozen scenarios and the scores of reference predictors are those of the
    scorer.
    """
    size = own.registry.size("cavity", "tiny")
    scenario = size.subsets["test"][0]

    def change_flags(entry: dict[str, Any]) -> None:
        file = entry["score"]["files"][0]
        file["diverged_at"] = {scenario: 7}
        file["flags"] = [{"name": "physics"}]

    own.edit("noisy", change_flags)
    with netCDF4.Dataset(own.folder / PREDICTOR, "r+") as file:
        file.set_auto_maskandscale(False)
        scale("position_mse", 2.0)(file)
    result = rescored(own, predictions)
    got = [finding.got for finding in result.findings]
    assert got == ["other position_mse", "flags []", "diverged_at {}"]


def test_pictures_and_statistics_are_compared(
    own: BoardBench, predictions: Path
) -> None:
    """A preview that is not of these predictions is found, and so is a statistic that
    is lacking.
    """

    def repaint(file: Any) -> None:
        film = file["preview"]["film"]
        film.set_auto_maskandscale(False)
        predicted = film[1].astype(np.int64)
        brighter = np.clip(predicted + 500, 0, 60_000)
        film[1] = brighter.astype(np.uint16)

    reform(own, repaint)
    (finding,) = rescored(own, predictions).findings
    assert finding.got == "other film pictures"

    path = own.folder / SCORES / "noisy.nc"
    with netCDF4.Dataset(path, "a") as file:
        names = file.statistics.split()
        names[names.index("velocity_mse")] = "made_up"
        file.statistics = " ".join(names)
    own.rehash("noisy")
    differences = []
    result = rescored(own, predictions)
    for finding in result.findings:
        if finding.check == "rescored":
            differences.append(str(finding.got))
    assert "velocity_mse" in differences[0]


def test_broken_predictions_are_opened_in_the_child_only(
    own: BoardBench,
    predictions: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The child finds every fault of the file before this process opens it; other
    issues remain.
    """
    cut = tmp_path / "cut.nc"
    content = predictions.read_bytes()
    cut.write_bytes(content[:-9999])
    own.edit("damped", set_mean)
    for module in (score, submitting):
        monkeypatch.setattr(module, "open_predictions", pytest.fail)
    result = rescored(own, cut)
    first, second = result.findings
    assert first.check == "score"
    assert second.check == "rescored"
    assert second.where == str(cut)
    with pytest.raises(UnreadableFileError):
        own.submit(cut, method="cut")


def git(folder: Path, *words: str) -> str:
    """Run git as somebody without settings of his own."""
    about = (
        *("-c", "user.name=A"),
        *("-c", "user.email=a@example.org"),
        *("-c", "init.defaultBranch=main"),
    )
    command = ["git", *about, "-C", str(folder), *words]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    return result.stdout


def commit(bench: BoardBench) -> None:
    """Commit all that lies there."""
    folder = bench.folder.parent
    git(folder, "add", "-A")
    git(folder, "commit", "-q", "-m", "x", "--allow-empty")


@pytest.fixture
def branch(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard in a repository, on a branch that left main."""
    if shutil.which("git") is None:
        pytest.skip("no git here")
    bench = copied(home, tmp_path, without=["flipping"])
    git(tmp_path, "init", "-q")
    (bench.folder / "verified.yaml").write_text("{}\n")
    commit(bench)
    git(tmp_path, "checkout", "-q", "-b", "change")
    return bench


def touched(bench: BoardBench, **options: Any) -> dict[str, str]:
    """Return where and got of what the check against main finds."""
    result = checked(bench, base="main", **options)
    places = {}
    for finding in result.findings:
        if finding.check == "base":
            places[finding.where] = finding.got
    return places


def new_entry(bench: BoardBench) -> None:
    """Add an entry of one's own."""
    entry = yaml.safe_load(bench.entry("noisy").read_text())
    entry["method"] = "mine"
    entry["name"] = "Mine"
    bench.entry("mine").write_text(yaml.safe_dump(entry))
    scores = bench.folder / SCORES
    shutil.copyfile(scores / "noisy.nc", scores / "mine.nc")


def test_what_only_adds_touches_nobody(branch: BoardBench) -> None:
    """A new entry, committed or not, and a page built anew are nobody else's; nor is
    what main got since.
    """
    new_entry(branch)
    (branch.folder / "index.html").write_text("built anew")
    assert touched(branch) == {}
    commit(branch)
    assert touched(branch) == {}
    folder = branch.folder.parent
    git(folder, "branch", "-f", "main", "change")
    git(folder, "reset", "-q", "--hard", "main~1")
    assert touched(branch) == {}


NOISY = f"{PLACE}/noisy.yaml"
DAMPED = f"{SCORES}/damped_3.nc"
LISTED = "verified.yaml"


Change = Callable[[BoardBench], object]


def said(**keys: str) -> Change:
    """Return what writes keys into the entry of noisy."""
    return lambda bench: bench.edit("noisy", lambda entry: entry.update(keys))


def removed(path: str) -> Change:
    """Return what removes a file of the folder."""
    return lambda bench: (bench.folder / path).unlink()


def written(path: str, content: str) -> Change:
    """Return what writes a file of the folder."""
    return lambda bench: (bench.folder / path).write_text(content)


def add_seed(bench: BoardBench) -> None:
    """Add the scores of a seed to another's."""
    scores = bench.folder / SCORES
    shutil.copyfile(scores / "noisy.nc", scores / "damped_9.nc")


def make_link(bench: BoardBench) -> None:
    """Put a link in the place of an entry."""
    path = bench.entry("noisy")
    path.unlink()
    path.symlink_to("damped.yaml")


CHANGES: dict[str, tuple[Change, str, str]] = {
    "removed": (
        removed(NOISY),
        NOISY,
        "removed",
    ),
    "touched": (
        said(notes="other"),
        NOISY,
        "other notes",
    ),
    "superseded": (
        said(status="superseded", superseded_by="damped"),
        NOISY,
        "superseded_by None -> 'damped'",
    ),
    "withdrawn": (
        said(status="withdrawn"),
        NOISY,
        "status None -> 'withdrawn'",
    ),
    "scores changed": (
        written(DAMPED, "x"),
        DAMPED,
        "changed",
    ),
    "scores removed": (
        removed(DAMPED),
        DAMPED,
        "removed",
    ),
    "a seed added": (
        add_seed,
        f"{SCORES}/damped_9.nc",
        "added",
    ),
    "made a link": (
        make_link,
        NOISY,
        "link",
    ),
    "made a bomb": (
        written(NOISY, "a: &a [x]\nb: *a\n"),
        NOISY,
        "another content",
    ),
    "verified claimed": (
        written(LISTED, f"{NOISY}: x\n"),
        LISTED,
        "changed",
    ),
    "reference scores changed": (
        removed(PREDICTOR),
        PREDICTOR,
        "removed",
    ),
    "gates claimed": (
        written("gates.json", '{"weights": []}'),
        "gates.json",
        "added",
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_touches_others_is_named(name: str, branch: BoardBench) -> None:
    """Each way is found, in the working tree and in a commit, with the file and what
    became of it.
    """
    change, where, got = CHANGES[name]
    change(branch)
    in_working_tree = touched(branch)
    commit(branch)
    in_commit = touched(branch)
    for places in (in_working_tree, in_commit):
        assert places.keys() == {where}
        assert got in places[where]


def test_ones_own_may_be_altered(branch: BoardBench, tmp_path: Path) -> None:
    """What the change says is its own is not named, other entries are.

    A repository's own settings are strangers' too: no program of theirs is started.
    """
    trace = tmp_path / "ran"
    for setting in ("core.fsmonitor", "diff.external"):
        git(branch.folder.parent, "config", setting, f"touch {trace}; false")
    change = said(notes="other")
    change(branch)
    branch.entry("damped").unlink()
    places = touched(branch, own=["noisy"])
    assert places.keys() == {f"{PLACE}/damped.yaml"}
    assert not trace.exists()


@pytest.mark.slow
def test_a_verified_entry_may_be_replaced(branch: BoardBench) -> None:
    """Its line goes with it: that is one's own to remove, and nothing else of the
    list.
    """
    other = branch.predict(nearer, "other")
    listed = branch.folder / "verified.yaml"
    branch.submit(other)
    own = branch.predict(noisy, "noisy", parameters=5)
    result = rescored(branch, own, other, recording=True)
    assert len(result.recorded) == 2
    commit(branch)
    both = listed.read_bytes()
    branch.submit(own, replace=True)
    assert listed.read_bytes() == both  # its scores are those of before
    worse = branch.predict(still, "noisy")
    submission = branch.submit(worse, replace=True)
    assert listed in submission.files

    def places_of(*own: str) -> set[tuple[str, str]]:
        places = set()
        for finding in checked(branch, own=own, base="HEAD").findings:
            places.add((finding.check, str(finding.where)))
        return places

    list_is_touched = ("base", "verified.yaml")
    assert places_of("noisy") == set()
    assert list_is_touched in places_of()
    left = listed.read_text()
    assert "other" in left
    listed.write_text(left.replace("lagbench: ", "lagbench: 9"))
    assert list_is_touched in places_of("noisy")
    listed.write_bytes(both + b"# all others too\n")
    assert list_is_touched in places_of("noisy")


@pytest.mark.slow
def test_the_entry_comes_last(own: BoardBench, monkeypatch: pytest.MonkeyPatch) -> None:
    """After its scores and the list of the verified, whatever the method is called."""
    first = own.predict(nearer, "new")
    about = {"method": "verified", "name": "Verified"}
    own.submit(first, **about)
    rescored(own, first, recording=True)
    moved = []
    move = os.replace

    def note(source: Path, target: Path) -> None:
        name = os.path.relpath(target, own.folder)
        moved.append(name)
        move(source, target)

    second = own.predict(still, "new")
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", note)
        own.submit(second, replace=True, **about)
    ours = []
    for name in moved:
        if "verified" in name and ".submit-" not in name:
            ours.append(name)
    assert ours == [
        "scores/cavity/tiny/verified.nc",
        "verified.yaml",
        f"{PLACE}/verified.yaml",
    ]
    assert (own.folder / "verified.yaml").read_text() == "{}\n"
    assert findings_of(own) == []


def test_without_git_it_says_so(
    branch: BoardBench, home: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """An unknown revision, and a folder outside any repository, are a matter of
    usage.
    """
    with pytest.raises(UsageError) as caught:
        checked(branch, base="nowhere")
    assert "--base" in str(caught.value.where)
    outside = copied(home, tmp_path_factory.mktemp("outside"))
    with pytest.raises(UsageError):
        checked(outside, base="main")
