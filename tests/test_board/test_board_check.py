"""The check of a leaderboard's folder finds what it should, names it, and opens nothing
outside.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from functools import reduce
from operator import getitem
from pathlib import Path
from typing import Any

import netCDF4
import pytest
import yaml
from board_bench import (
    PLACE,
    SCORES,
    BoardBench,
    copied,
    master,
    reform,
    scale,
    set_mean,
)

from lagbench.board import folder_checks
from lagbench.board.build import build
from lagbench.board.check import check_board
from lagbench.board.identity import confusable_key
from lagbench.board.issues import CHECKS
from lagbench.data.registry import load
from lagbench.errors import ChecksFailedError

NOISY = f"{SCORES}/noisy.nc"
PREDICTOR = "floors/cavity/tiny/persistence.nc"


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard that the test may damage."""
    return copied(
        home,
        tmp_path,
        without=["flipping", "constant-velocity", "frozen-field", "analog"],
    )


def found(bench: BoardBench, *, page: bool = False) -> list[str]:
    """Return the names of the checks that found something."""
    result = check_board(
        bench.folder,
        registry=bench.registry,
        page=page,
        isolated=False,
    )
    for finding in result.findings:
        assert finding.check in CHECKS
        assert all((finding.what, finding.where, finding.fix))
        assert str(finding).isprintable() or "\n" in str(finding)
        assert len(str(finding)) < 2000
    assert result.exit_code == (1 if result.findings else 0)
    return [finding.check for finding in result.findings]


def test_nothing_is_wrong_with_what_submit_writes(home: Path) -> None:
    """Floors, several seeds and an exploding method pass, in a child process too."""
    bench = master(home)
    result = check_board(bench.folder, registry=bench.registry, page=False)
    assert result.findings == ()
    assert result.entries == 3


def halve(path: Path) -> None:
    """Halve a statistic in a score file."""
    with netCDF4.Dataset(path, "r+") as file:
        scale("vorticity_mse", 0.5)(file)


def link(path: Path, target: Path) -> None:
    """Replace a file by a symbolic link."""
    path.unlink()
    path.symlink_to(target)


def copy_of(bench: BoardBench, method: str, other: str, **changes: Any) -> None:
    """Enter a method once more under another id."""
    held = yaml.safe_load(bench.entry(method).read_text()) | {
        "method": other,
        **changes,
    }
    bench.entry(other).write_text(yaml.safe_dump(held, sort_keys=False))
    shutil.copyfile(
        bench.folder / SCORES / f"{method}.nc", bench.folder / SCORES / f"{other}.nc"
    )


def disguised(bench: BoardBench) -> None:
    """Enter the predictions of another once more, with another hash of them
    everywhere.
    """
    copy_of(bench, "noisy", "other", name="Something else")
    with netCDF4.Dataset(bench.folder / SCORES / "other.nc", "r+") as file:
        file.predictions_sha256 = "1" * 64

    def change(held: dict[str, Any]) -> None:
        held["predictions"][0]["sha256"] = held["score"]["files"][0][
            "predictions_sha256"
        ] = "1" * 64

    bench.edit("other", change)
    bench.rehash("other")


def verify(bench: BoardBench, method: str) -> None:
    """Write a list of verified entries, with scores that nobody has."""
    line = {"scores": ["0" * 64], "lagbench": "0.1.0", "date": "2026-01-31"}
    (bench.folder / "verified.yaml").write_text(
        yaml.safe_dump({f"{PLACE}/{method}.yaml": line})
    )


def superseded(bench: BoardBench, one: str, two: str) -> None:
    """Say that an entry follows another."""
    bench.edit(one, lambda held: held.update(status="superseded", superseded_by=two))


def put(*place: str | int, **changes: object) -> Callable[[BoardBench], object]:
    """Return what writes keys into the entry of noisy, at a place of it."""
    return lambda bench: bench.edit(
        "noisy", lambda held: reduce(getitem, place, held).update(changes)
    )


def text(
    held: str, path: str = f"{PLACE}/noisy.yaml"
) -> Callable[[BoardBench], object]:
    """Return what writes a file of the folder, the entry of noisy unless told
    otherwise.
    """
    return lambda bench: (bench.folder / path).write_text(held)


DAMAGE: dict[str, Callable[[BoardBench], object]] = {
    "score: edited score": lambda b: b.edit("noisy", set_mean),
    "score: edited score by a millionth": lambda b: b.edit(
        "noisy", lambda h: set_mean(h, 1 - 3e-6)
    ),
    "score: metric removed": lambda b: b.edit(
        "noisy", lambda h: h["score"]["metrics"].pop("mse_avg")
    ),
    "score: metric invented": lambda b: b.edit(
        "noisy",
        lambda h: h["score"]["metrics"].update(
            best=dict(h["score"]["metrics"]["mse_avg"])
        ),
    ),
    "score: data set edited": put("score", dataset_sha256="0" * 64),
    "schema: unknown key": put(lisence="MIT"),
    "schema: scorer named": put("score", scored_by="me"),
    "schema: link that is not http": put(code="javascript:alert(1)"),
    "schema: link with a user": put(code="https://a.org@b.org/"),
    "schema: name of 10 kB": put(name="n" * 10_000),
    "schema: blank name": put(name="\u3164"),
    "schema: path outside": put("predictions", 0, path="../../secret"),
    "schema: number in base 60": text(f"parameters: {':'.join(['59'] * 300)}:1.5\n"),
    "date: date to come": put(date="2999-01-01"),
    "name: look-alike of an entry": put(name="D\u0430MPED"),
    "name: look-alike of a floor": put(name="Persistence"),
    "split: unknown split": lambda b: (
        (b.folder / "submissions/cavty/tiny").mkdir(parents=True),
        put(split="cavty")(b),
    ),
    "version score_file score: old data set": put("dataset", sha256="0" * 64),
    "lifecycle: superseded by nothing": lambda b: superseded(b, "noisy", "none"),
    "lifecycle: superseded by itself": lambda b: superseded(b, "noisy", "noisy"),
    "lifecycle: superseded in a circle": lambda b: (
        superseded(b, "noisy", "damped"),
        superseded(b, "damped", "noisy"),
    ),
    "nothing: notes edited": put(notes="new"),
    "predictions: predictions that are not there": put(
        "predictions", 0, path="predictions/x.nc"
    ),
    "predictions folder: predictions behind a link": lambda b: (
        (b.folder / "x.nc").symlink_to(b.entry("noisy")),
        put("predictions", 0, path="x.nc")(b),
    ),
    "verified: verified without an entry": lambda b: verify(b, "nobody"),
    "verified: verified with other scores": lambda b: verify(b, "noisy"),
    "verified: list that is none": text("- a\n", "verified.yaml"),
    # what may happen to files
    "score_file: edited score file": lambda b: halve(b.folder / NOISY),
    "score: edited score file, hash forged": lambda b: (
        halve(b.folder / SCORES / "damped_3.nc"),
        b.rehash("damped"),
    ),
    "score_file score twin: score file of another method": lambda b: (
        shutil.copyfile(b.folder / SCORES / "damped_0.nc", b.folder / NOISY),
        b.rehash("noisy"),
    ),
    "score_file: score file cut short": lambda b: (
        os.truncate(b.folder / NOISY, (b.folder / NOISY).stat().st_size - 999),
        b.rehash("noisy"),
    ),
    "missing: missing score file": lambda b: (
        b.folder / SCORES / "damped_3.nc"
    ).unlink(),
    "stray: stray score file": lambda b: shutil.copyfile(
        b.folder / NOISY, b.folder / SCORES / "other.nc"
    ),
    "stray: missing entry": lambda b: b.entry("noisy").unlink(),
    "oversize: oversize score file": lambda b: (b.folder / NOISY).write_bytes(
        bytes(1_000_001)
    ),
    "folder missing: score file that is a link": lambda b: link(
        b.folder / NOISY, b.folder / SCORES / "damped_0.nc"
    ),
    "values: negative square": lambda b: reform(
        b, scale("position_mse", -1.0), whole=False
    ),
    "values: correlation above one": lambda b: reform(
        b, scale("vorticity_pearson", 2.0)
    ),
    "values: no error where there is one": lambda b: reform(
        b, scale("vorticity_mse", 0.0)
    ),
    "twin: the same predictions again": lambda b: copy_of(
        b, "noisy", "other", name="Something else"
    ),
    "twin: the same errors again": disguised,
    "folder: entry that is a link": lambda b: link(
        b.entry("noisy"), Path("/etc/passwd")
    ),
    "folder: folder that is a link": lambda b: (
        b.folder / "submissions" / "fluid"
    ).symlink_to("/etc", target_is_directory=True),
    "folder: other files": text("import os", f"{PLACE}/evil.py"),
    "folder: other files beside the page": text("alert(1)", "index.js"),
    "folder: folder of its own": lambda b: (
        (b.folder / "more").mkdir(),
        (b.folder / "more/a.yaml").touch(),
    ),
    "folder: page that is a link": lambda b: (b.folder / "README.md").symlink_to(
        "/etc/passwd"
    ),
    "folder: name that a log would obey": text("a: 1", f"{PLACE}/a\n::warning::x.yaml"),
    "folder stray: entry at another depth": lambda b: b.entry("noisy").rename(
        b.folder / "submissions/noisy.yaml"
    ),
    "readable: entry of 100 MB": lambda b: os.truncate(b.entry("noisy"), 100_000_000),
    "readable: YAML with aliases": text("a: &a [x]\nb: *a\n"),
    "place: place": lambda b: b.entry("noisy").rename(b.folder / PLACE / "other.yaml"),
    "floor: unknown floor": lambda b: shutil.copyfile(
        b.folder / PREDICTOR, b.folder / "floors/cavity/tiny/ceiling.nc"
    ),
    "floor: broken floor": text("CDF", PREDICTOR),
    "floor: floor of another split": lambda b: (
        (b.folder / "floors/fluid/tiny").mkdir(parents=True),
        shutil.copy(b.folder / PREDICTOR, b.folder / "floors/fluid/tiny"),
    ),
}
"""What somebody may write into an entry, then what may happen to files: the checks that
find it, its name.
"""


def checks_of(name: str) -> set[str]:
    """Return the checks that find a damage."""
    return {*name.partition(":")[0].split()} - {"nothing"}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_found(name: str, own: BoardBench) -> None:
    """Each kind of damage is found by its checks and by no others."""
    DAMAGE[name](own)
    assert set(found(own)) == checks_of(name)


def test_all_checks_have_damage() -> None:
    """No check is without a test; those that need more than the folder have suites of
    their own.
    """
    tested = set().union(*map(checks_of, DAMAGE))
    elsewhere = {"page", "rescored", "base", "measured", "weights", "budget"}
    elsewhere.update({"season", "shift"})
    assert not tested & elsewhere
    assert tested | elsewhere == set(CHECKS)


def test_one_bad_file_hides_nothing(
    own: BoardBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error that nobody thought of, in one entry, leaves the findings on the
    others.
    """
    original = folder_checks.load_plain

    def failing(path: Path) -> Any:
        if path.stem == "damped":
            raise OverflowError("too large")
        return original(path)

    monkeypatch.setattr(folder_checks, "load_plain", failing)
    own.edit("noisy", set_mean)
    assert found(own) == ["readable", "score"]


def test_later_entries_may_supersede_twins(own: BoardBench) -> None:
    """The same predictions under a new name, and a name of old, are well where the old
    entry steps back.
    """
    copy_of(own, "noisy", "new-name")
    assert set(found(own)) == {"twin", "name"}
    superseded(own, "noisy", "new-name")
    assert found(own) == []


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("GNS", "GN\u0405"),
        ("SuperGAT", "\u0405uperG\u0410T"),
        ("MLP 10", "mlp-l0"),
        ("Caf\u00e9", "Cafe"),
        ("\uff27\uff2e\uff33", "GNS"),
        ("\u0391\u0392", "AB"),
    ],
)
def test_names_that_look_alike(one: str, other: str) -> None:
    """Other scripts, wide letters, accents, case, hyphens, and digits like letters."""
    assert confusable_key(one) == confusable_key(other)
    assert confusable_key(one) != confusable_key(f"{other} b")


def test_withdrawn_entries_may_be_old(own: BoardBench) -> None:
    """What is not active need not belong to the data set of today."""
    newer = own.folder.parent / "newer.yaml"
    registry_text = own.data.size.file.read_text()
    newer.write_text(re.sub(r"version: 2\.\d+\.0", "version: 9.0.0", registry_text))
    result = check_board(own.folder, registry=load(newer), isolated=False)
    assert {finding.check for finding in result.findings} == {"version", "floor"}
    assert len(result.findings) == 2 + len(list((own.folder / "floors").rglob("*.nc")))
    for path in own.entry("noisy").parent.glob("*.yaml"):
        held = yaml.safe_load(path.read_text())
        path.write_text(
            yaml.safe_dump(held | {"status": "withdrawn", "reason": "old data"})
        )
    shutil.rmtree(own.folder / "floors")
    assert not check_board(own.folder, registry=load(newer), isolated=False).findings


def test_a_stale_page_is_found(own: BoardBench) -> None:
    """No page, an edited one, a link and a page of other entries are stale; a new build
    mends it.
    """
    assert found(own, page=True) == ["page"]
    page = build(own.folder, registry=own.registry).page
    assert found(own, page=True) == []
    assert build(own.folder, registry=own.registry).written == ()
    data = page.read_bytes()
    page.write_bytes(data.replace(b"noisy", b"nOisy", 1))
    assert found(own, page=True) == ["page"]
    page.unlink()
    page.symlink_to("elsewhere.html")
    assert found(own, page=True) == ["folder"]
    page.unlink()
    page.write_bytes(data)
    own.edit("noisy", lambda held: held.update(notes="new"))
    with pytest.raises(ChecksFailedError) as caught:
        build(own.folder, check=True, registry=own.registry)
    assert caught.value.where.endswith("leaderboard/index.html")
    assert found(own, page=True) == ["page"]
    (own.folder / "schema.json").write_text("{}")
    assert build(own.folder, registry=own.registry).written == (
        page,
        own.folder / "schema.json",
    )
    assert found(own, page=True) == []
