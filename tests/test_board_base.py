"""What a change does to entries of others: found against a git revision, whatever way it is done."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from board_worlds import PLACE, SCORES, BoardBench, copied

from lagbench.board.check import check_board
from lagbench.errors import UsageError

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="no git here")


def git(folder: Path, *words: str) -> str:
    """Run git as somebody without settings of his own."""
    about = ("-c", "user.name=A", "-c", "user.email=a@example.org", "-c", "init.defaultBranch=main")
    command = ["git", *about, "-C", str(folder), *words]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def commit(bench: BoardBench) -> None:
    """Commit all that lies there."""
    git(bench.folder.parent, "add", "-A")
    git(bench.folder.parent, "commit", "-q", "-m", "x", "--allow-empty")


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard in a repository, on a branch that left main."""
    bench = copied(home, tmp_path, without=["flipping"])
    git(tmp_path, "init", "-q")
    (bench.folder / "verified.yaml").write_text("{}\n")
    commit(bench)
    git(tmp_path, "checkout", "-q", "-b", "change")
    return bench


def touched(bench: BoardBench, **options: Any) -> dict[str, str]:
    """Return where and got of what the check against main finds."""
    result = check_board(bench.folder, registry=bench.registry, isolated=False, base="main", **options)
    return {finding.where: finding.got for finding in result.findings if finding.check == "base"}


def new_entry(bench: BoardBench) -> None:
    """Add an entry of one's own."""
    held = yaml.safe_load(bench.entry("noisy").read_text()) | {"method": "mine", "name": "Mine"}
    bench.entry("mine").write_text(yaml.safe_dump(held))
    shutil.copyfile(bench.folder / SCORES / "noisy.nc", bench.folder / SCORES / "mine.nc")


def test_what_only_adds_touches_nobody(own: BoardBench) -> None:
    """A new entry, committed or not, and a page built anew are nobody else's."""
    new_entry(own)
    (own.folder / "index.html").write_text("built anew")
    assert touched(own) == {}
    commit(own)
    assert touched(own) == {}


NOISY, DAMPED = f"{PLACE}/noisy.yaml", f"{SCORES}/damped_3.nc"

CHANGES: dict[str, tuple[Callable[[BoardBench], object], str, str]] = {
    "removed": (lambda b: b.entry("noisy").unlink(), NOISY, "removed"),
    "touched": (lambda b: b.edit("noisy", lambda h: h.update(notes="other")), NOISY, "other notes"),
    "superseded": (
        lambda b: b.edit("noisy", lambda h: h.update(status="superseded", superseded_by="damped")),
        *(NOISY, "superseded_by None -> 'damped'"),
    ),
    "withdrawn": (
        lambda b: b.edit("noisy", lambda h: h.update(status="withdrawn")),
        *(NOISY, "status None -> 'withdrawn'"),
    ),
    "scores changed": (lambda b: (b.folder / DAMPED).write_bytes(b"x"), DAMPED, "changed"),
    "scores removed": (lambda b: (b.folder / DAMPED).unlink(), DAMPED, "removed"),
    "a seed added": (
        lambda b: shutil.copyfile(b.folder / SCORES / "noisy.nc", b.folder / SCORES / "damped_9.nc"),
        *(f"{SCORES}/damped_9.nc", "added"),
    ),
    "made a link": (
        lambda b: (b.entry("noisy").unlink(), b.entry("noisy").symlink_to("damped.yaml")),
        *(NOISY, "link"),
    ),
    "made a bomb": (lambda b: b.entry("noisy").write_text("a: &a [x]\nb: *a\n"), NOISY, "another content"),
    "verified claimed": (
        lambda b: (b.folder / "verified.yaml").write_text(f"{NOISY}: x\n"),
        *("verified.yaml", "changed"),
    ),
    "floors changed": (
        lambda b: (b.folder / "floors/cavity/tiny/persistence.nc").unlink(),
        *("floors/cavity/tiny/persistence.nc", "removed"),
    ),
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_touches_others_is_named(name: str, own: BoardBench) -> None:
    """Each way is found, in the working tree and in a commit, with the file and what became of it."""
    change, where, got = CHANGES[name]
    change(own)
    here = touched(own)
    commit(own)
    for found in (here, touched(own)):
        assert set(found) == {where}
        assert got in found[where]


def test_ones_own_may_be_altered(own: BoardBench) -> None:
    """What the change says is its own is not named, other entries are."""
    own.edit("noisy", lambda held: held.update(notes="other"))
    own.entry("damped").unlink()
    assert set(touched(own, own=["noisy"])) == {f"{PLACE}/damped.yaml"}


def test_the_base_may_have_gone_on(own: BoardBench) -> None:
    """Entries that others added to main since are not missed on a branch that left it before."""
    root = own.folder.parent
    git(root, "checkout", "-q", "main")
    new_entry(own)
    commit(own)
    git(root, "checkout", "-q", "change")
    assert touched(own) == {}


def test_without_git_it_says_so(
    own: BoardBench, home: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """An unknown revision, and a folder outside any repository, are a matter of usage."""
    with pytest.raises(UsageError) as error:
        check_board(own.folder, registry=own.registry, isolated=False, base="nowhere")
    assert "--base" in str(error.value.where)
    outside = copied(home, tmp_path_factory.mktemp("outside"))
    with pytest.raises(UsageError):
        check_board(outside.folder, registry=outside.registry, isolated=False, base="main")


def test_settings_of_a_checkout_run_nothing(own: BoardBench, tmp_path: Path) -> None:
    """A repository's own settings are strangers' too: no program of theirs is started."""
    git(own.folder.parent, "config", "core.fsmonitor", f"touch {tmp_path}/ran; false")
    git(own.folder.parent, "config", "diff.external", f"touch {tmp_path}/ran; false")
    own.edit("noisy", lambda held: held.update(notes="other"))
    assert touched(own)
    assert not (tmp_path / "ran").exists()
