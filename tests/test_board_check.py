"""The check of a leaderboard's folder finds what it should, names it, and opens nothing outside."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import netCDF4
import pytest
import yaml
from board_bench import PLACE, BoardBench, copied, in_process, master
from report_bench import noisy

from lagbench.board.build import build
from lagbench.board.check import CHECKS, check_board
from lagbench.board.entry import Entry
from lagbench.board.seeds import combine, summarise
from lagbench.board.stored import read_stored
from lagbench.data.registry import load
from lagbench.errors import ChecksFailedError

SCORES = "scores/cavity/tiny"


@pytest.fixture
def own(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard that the test may damage."""
    return copied(tmp_path_factory, tmp_path, without=["constant-velocity", "flipping"])


def found(bench: BoardBench, *, page: bool = False) -> list[str]:
    """Return the names of the checks that found something."""
    result = check_board(bench.folder, registry=bench.registry, page=page, isolated=False)
    for finding in result.findings:
        assert finding.check in CHECKS
        assert finding.what
        assert finding.where
        assert finding.fix
        assert str(finding).isprintable() or "\n" in str(finding)
        assert len(str(finding)) < 2000
    assert result.exit_code == (1 if result.findings else 0)
    return [finding.check for finding in result.findings]


def test_nothing_is_wrong_with_what_submit_writes(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Floors, several seeds and an exploding method pass, in a child process too."""
    bench = master(tmp_path_factory)
    result = check_board(bench.folder, registry=bench.registry, page=False)
    assert (result.findings, result.entries) == ((), 5)


def set_mean(held: dict[str, Any], factor: float = 0.9) -> None:
    """Better the ranking metric of an entry."""
    held["score"]["metrics"]["vorticity_rmse"]["mean"] *= factor


def invent(held: dict[str, Any]) -> None:
    """Add a metric that the score files do not have."""
    held["score"]["metrics"]["best"] = dict(held["score"]["metrics"]["mse_avg"])


def halve(path: Path, statistic: str = "vorticity_mse") -> None:
    """Halve a statistic in a score file."""
    with netCDF4.Dataset(path, "r+") as file:
        row = file.statistics.split().index(statistic)
        file["value"][row] = 0.5 * file["value"][row]


def link(path: Path, target: Path) -> None:
    """Replace a file by a symbolic link."""
    path.unlink()
    path.symlink_to(target)


DAMAGE: dict[str, tuple[Callable[[BoardBench], object], set[str]]] = {
    "edited score": (lambda b: b.edit("noisy", set_mean), {"score"}),
    "edited score by a millionth": (lambda b: b.edit("noisy", lambda h: set_mean(h, 1 - 3e-6)), {"score"}),
    "edited score, digest forged": (lambda b: (b.edit("noisy", set_mean), b.reseal("noisy")), {"score"}),
    "flag removed": (
        lambda b: b.edit("persistence", lambda h: h["score"]["files"][0].pop("flags")),
        {"score"},
    ),
    "scorer renamed": (lambda b: b.edit("noisy", lambda h: h["score"].update(scored_by="me")), {"score"}),
    "metric removed": (
        lambda b: (b.edit("noisy", lambda h: h["score"]["metrics"].pop("mse_avg")), b.reseal("noisy")),
        {"score"},
    ),
    "metric invented": (
        lambda b: (
            b.edit(
                "noisy", lambda h: h["score"]["metrics"].update(best=dict(h["score"]["metrics"]["mse_avg"]))
            ),
            b.reseal("noisy"),
        ),
        {"score"},
    ),
    "edited score file": (lambda b: halve(b.folder / SCORES / "noisy.nc"), {"score_file"}),
    "edited score file, hash forged": (
        lambda b: (halve(b.folder / SCORES / "damped_3.nc"), b.reseal("damped")),
        {"score"},
    ),
    "score file of another method": (
        lambda b: (
            shutil.copyfile(b.folder / SCORES / "persistence.nc", b.folder / SCORES / "noisy.nc"),
            b.reseal("noisy"),
        ),
        {"score_file", "score"},
    ),
    "score file cut short": (
        lambda b: (
            (b.folder / SCORES / "noisy.nc").write_bytes(
                (b.folder / SCORES / "noisy.nc").read_bytes()[:-999]
            ),
            b.reseal("noisy"),
        ),
        {"score_file"},
    ),
    "missing score file": (lambda b: (b.folder / SCORES / "damped_3.nc").unlink(), {"missing"}),
    "stray score file": (
        lambda b: shutil.copyfile(b.folder / SCORES / "noisy.nc", b.folder / SCORES / "other.nc"),
        {"stray"},
    ),
    "missing entry": (lambda b: b.entry("noisy").unlink(), {"stray"}),
    "oversize score file": (
        lambda b: (b.folder / SCORES / "noisy.nc").write_bytes(bytes(300_001)),
        {"oversize"},
    ),
    "score file that is a link": (
        lambda b: link(b.folder / SCORES / "noisy.nc", b.folder / SCORES / "damped_0.nc"),
        {"folder", "missing"},
    ),
    "entry that is a link": (
        lambda b: link(b.entry("noisy"), Path("/etc/passwd")),
        {"folder"},
    ),
    "folder that is a link": (
        lambda b: (b.folder / "submissions" / "fluid").symlink_to("/etc", target_is_directory=True),
        {"folder"},
    ),
    "other files": (lambda b: (b.folder / PLACE / "evil.py").write_text("import os"), {"folder"}),
    "name that a log would obey": (
        lambda b: (b.folder / PLACE / "a\n::warning::x.yaml").write_text("a: 1"),
        {"folder"},
    ),
    "entry at another depth": (
        lambda b: b.entry("noisy").rename(b.folder / "submissions/noisy.yaml"),
        {"folder", "stray"},
    ),
    "unknown key": (lambda b: b.edit("noisy", lambda h: h.update(lisence="MIT")), {"schema"}),
    "link that is not http": (
        lambda b: b.edit("noisy", lambda h: h.update(code="javascript:alert(1)")),
        {"schema"},
    ),
    "name of 10 kB": (lambda b: b.edit("noisy", lambda h: h.update(name="n" * 10_000)), {"schema"}),
    "path outside": (
        lambda b: b.edit("noisy", lambda h: h["predictions"][0].update(path="../../secret")),
        {"schema"},
    ),
    "entry of 100 MB": (lambda b: os.truncate(b.entry("noisy"), 100_000_000), {"readable"}),
    "YAML with aliases": (
        lambda b: b.entry("noisy").write_text("a: &a [x]\nb: *a\n"),
        {"readable"},
    ),
    "place": (
        lambda b: b.entry("noisy").rename(b.folder / PLACE / "other.yaml"),
        {"place"},
    ),
    "unknown split": (
        lambda b: (
            (b.folder / "submissions/cavty/tiny").mkdir(parents=True),
            b.edit("noisy", lambda h: h.update(split="cavty")),
        ),
        {"split"},
    ),
    "old data set": (
        lambda b: (b.edit("noisy", lambda h: h["dataset"].update(sha256="0" * 64)), b.reseal("noisy")),
        {"version", "score_file", "score"},
    ),
    "superseded by nothing": (
        lambda b: b.edit("noisy", lambda h: h.update(status="superseded", superseded_by="none")),
        {"lifecycle"},
    ),
    "superseded by itself": (
        lambda b: b.edit("noisy", lambda h: h.update(status="superseded", superseded_by="noisy")),
        {"lifecycle"},
    ),
    "superseded in a circle": (
        lambda b: [
            b.edit(one, lambda h, two=two: h.update(status="superseded", superseded_by=two))
            for one, two in (("noisy", "damped"), ("damped", "noisy"))
        ],
        {"lifecycle"},
    ),
    "cost edited": (
        lambda b: b.edit("damped", lambda h: h["cost"].update(seconds_per_frame=1e-3)),
        {"score"},
    ),
    "cost removed": (lambda b: b.edit("damped", lambda h: h.pop("cost")), {"score"}),
    "parameters edited": (lambda b: b.edit("noisy", lambda h: h.update(parameters=4)), {"score"}),
    "hardware edited": (lambda b: b.edit("noisy", lambda h: h.update(hardware="1 min")), {"score"}),
    "notes edited": (lambda b: b.edit("noisy", lambda h: h.update(notes="new")), set()),
    "predictions that are not there": (
        lambda b: b.edit("noisy", lambda h: h["predictions"][0].update(path="predictions/x.nc")),
        {"predictions"},
    ),
    "predictions behind a link": (
        lambda b: (
            (b.folder / "x.nc").symlink_to(b.entry("noisy")),
            b.edit("noisy", lambda h: h["predictions"][0].update(path="x.nc")),
        ),
        {"predictions"},
    ),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_found(name: str, own: BoardBench) -> None:
    """Each kind of damage is found by its checks and by no others."""
    damage, expected = DAMAGE[name]
    damage(own)
    assert set(found(own)) == expected


def test_all_checks_have_damage() -> None:
    """No check is without a test; the page and forgeries have their own."""
    tested = {check for _, checks in DAMAGE.values() for check in checks}
    assert tested | {"page", "rescored", "statistics", "truth"} == set(CHECKS)


def test_scoring_again_finds_what_a_forger_hid(own: BoardBench) -> None:
    """Statistics halved, hash, aggregates and digest forged: only the predictions themselves tell."""
    path = own.predict(noisy, "noisy", parameters=5)

    def rescored() -> list[str]:
        with in_process():
            where = {"registry": own.registry, "root": own.data.root, "page": False, "isolated": False}
            result = check_board(own.folder, predictions=[path], **where)
        return [f"{finding.check}: {finding.got}" for finding in result.findings]

    assert rescored() == []
    halve(own.folder / SCORES / "noisy.nc")
    halved = summarise(combine([read_stored(own.folder / SCORES / "noisy.nc").scores]))
    plain = {name: summary.model_dump() for name, summary in halved.items()}
    own.edit("noisy", lambda held: held["score"].update(metrics=plain))
    own.reseal("noisy")
    assert rescored() == ["rescored: other vorticity_mse"]
    own.entry("noisy").unlink()
    (own.folder / SCORES / "noisy.nc").unlink()
    (said,) = rescored()
    assert said.startswith("rescored: ")


def test_withdrawn_entries_may_be_old(own: BoardBench) -> None:
    """What is not active need not belong to the data set of today."""
    text = own.data.size.file.read_text() if own.data.size.file.exists() else ""
    newer = own.folder.parent / "newer.yaml"
    newer.write_text(text.replace("version: 2.0.0", "version: 3.0.0"))
    bench = own
    result = check_board(bench.folder, registry=load(newer), page=False, isolated=False)
    assert {finding.check for finding in result.findings} == {"version"}
    assert len(result.findings) == 3
    for path in bench.entry("noisy").parent.glob("*.yaml"):
        held = yaml.safe_load(path.read_text())
        path.write_text(yaml.safe_dump(held | {"status": "withdrawn", "reason": "old data"}))
    result = check_board(bench.folder, registry=load(newer), page=False, isolated=False)
    assert not result.findings


def test_a_stale_page_is_found(own: BoardBench) -> None:
    """No page, an edited one, a link and a page of other entries are stale; a new build mends it."""
    assert found(own, page=True) == ["page"]
    page = build(own.folder, registry=own.registry).page
    assert found(own, page=True) == []
    assert build(own.folder, registry=own.registry).written == ()
    data = page.read_bytes()
    page.write_bytes(data.replace(b"noisy", b"nOisy", 1))
    assert found(own, page=True) == ["page"]
    page.unlink()
    page.symlink_to("elsewhere.html")
    assert found(own, page=True) == ["page"]
    page.unlink()
    page.write_bytes(data)
    own.edit("noisy", lambda held: held.update(notes="new"))
    with pytest.raises(ChecksFailedError, match="leaderboard build"):
        build(own.folder, check=True, registry=own.registry)
    assert found(own, page=True) == ["page"]
    (own.folder / "schema.json").write_text("{}")
    assert build(own.folder, registry=own.registry).written == (page, own.folder / "schema.json")
    assert found(own, page=True) == []


def test_an_entry_has_no_key_that_is_not_checked() -> None:
    """Strict at every depth: what the schema does not know cannot pass."""
    assert Entry.model_config["extra"] == "forbid"
    assert Entry.model_config["strict"] is True
