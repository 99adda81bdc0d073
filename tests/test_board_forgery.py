"""What a forger who makes every hash anew cannot hide, and what only the data can tell."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import pytest
import yaml
from board_bench import BoardBench, copied, in_process
from board_forgery import (
    SCORES,
    forge,
    rename,
    repaint,
    rewrite,
    scale,
    shorter,
    undefine,
    unmeasure,
    with_statistic,
)
from report_bench import damped, noisy

from lagbench.board import draft
from lagbench.board.build import build
from lagbench.board.check import CheckResult, check_board
from lagbench.board.coverage import gaps
from lagbench.board.entry_file import read_entry
from lagbench.board.folder import Folder
from lagbench.board.likeness import unlike, untrue
from lagbench.board.stored import Stored, read_stored
from lagbench.data.registry import Size, load
from lagbench.errors import UnreadableFileError
from lagbench.scoring import score

LEADERBOARD = Path(__file__).parent.parent / "leaderboard"
LAST = slice(-5, None)


@pytest.fixture
def own(tmp_path_factory: pytest.TempPathFactory, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard that the test may forge: persistence, two seeds, one method."""
    return copied(tmp_path_factory, tmp_path, without=["constant-velocity", "flipping"])


def checked(bench: BoardBench, **options: Any) -> CheckResult:
    """Check the leaderboard in this process, without its page."""
    with in_process():
        return check_board(bench.folder, registry=bench.registry, page=False, isolated=False, **options)


def told(result: CheckResult) -> list[str]:
    """Return check and got of every finding."""
    return [f"{finding.check}: {finding.got}" for finding in result.findings]


GAPS = {
    "statistic left out": (rename("density_rmse"), {"statistics"}, "no density_rmse"),
    "error left out": (rename("attribute_mse"), {"statistics"}, "no attribute_mse"),
    "frames not measured": (unmeasure("vorticity_mse", LAST), {"statistics", "truth"}, "or other ones"),
    "bad errors left out": (
        undefine("position_mse", LAST),
        {"statistics", "truth"},
        "5 without one",
    ),
    "bad vorticity left out": (
        undefine("vorticity_mse", LAST),
        {"truth"},
        "frames of vorticity_mse",
    ),
    "truth edited": (scale("energy_true", 2.0), {"truth"}, "other energy_true"),
    "divergence of the truth edited": (scale("divergence_rms_true", 0.9), {"truth"}, "divergence_rms_true"),
    "film of the truth edited": (repaint(0), {"truth"}, "other the film"),
    "maps of the truth edited": (repaint(0, "vorticity"), {"truth"}, "other vorticity maps"),
}


@pytest.mark.parametrize("name", GAPS)
def test_gaps_and_another_truth_are_found(name: str, own: BoardBench) -> None:
    """What is left out, and what the truth alone decides: found without the data, file and fix named."""
    change, expected, said = GAPS[name]
    forge(own, "noisy", change)
    result = checked(own)
    assert {finding.check for finding in result.findings} == expected
    assert said in " ".join(told(result))
    for finding in result.findings:
        assert finding.where == f"{SCORES}/noisy.nc"
        assert finding.expected
        assert "submit" in finding.fix


def test_a_forged_floor_is_not_the_witness_of_the_truth(own: BoardBench) -> None:
    """Where the floor itself was edited, all others say so."""
    forge(own, "persistence", scale("energy_true", 2.0))
    found = checked(own).findings
    assert [finding.check for finding in found] == ["truth"] * 3
    assert all("persistence" in finding.fix for finding in found)


def committed() -> list[tuple[Path, Size, Stored]]:
    """Return the committed score files, each with its size."""
    folder, registry = Folder(LEADERBOARD), load()
    found = []
    for path in folder.score_files():
        size = registry.size(*path.parts[1:3])
        found.append((path, size, read_stored(folder.path / path, size)))
    return found


def test_what_the_scorer_wrote_has_no_gaps() -> None:
    """Every committed score file is whole, and agrees about the truth with the first of its data set."""
    first: dict[str, Stored] = {}
    for path, size, held in committed():
        assert list(gaps(held.scores, size)) == [], path
        assert list(untrue(first.setdefault(f"{size.split} {size.name}", held), held)) == [], path
        assert list(unlike(held, held)) == []
    assert len(first) >= 4


def test_forged_floors_are_found_with_the_data(own: BoardBench) -> None:
    """Better statistics with every hash forged pass without the data, which is said, and fail with them."""
    forge(own, "persistence", scale("vorticity_mse", 2.0))
    blind = checked(own)
    assert (told(blind), blind.floors_rescored, blind.floors_trusted) == ([], (), ("cavity tiny",))
    seeing = checked(own, floors=True, root=own.data.root)
    assert told(seeing) == ["rescored: other vorticity_mse"]
    assert seeing.findings[0].where.endswith("persistence.yaml")
    assert (seeing.floors_rescored, seeing.floors_trusted) == (("cavity tiny",), ())
    elsewhere = checked(own, floors=True, root=own.folder)
    assert (told(elsewhere), elsewhere.floors_trusted) == ([], ("cavity tiny",))


def test_sound_floors_pass_with_the_data(own: BoardBench) -> None:
    """A floor predicted and scored anew is the one on the board; another one's predictions are not."""
    assert told(checked(own, floors=True, root=own.data.root)) == []
    swap = own.folder / "submissions/cavity/tiny/persistence.yaml"
    held = yaml.safe_load(swap.read_text())
    held["predictions"][0]["sha256"] = held["score"]["files"][0]["predictions_sha256"] = "0" * 64
    swap.write_text(yaml.safe_dump(held, sort_keys=False))
    own.reseal("persistence")
    found = told(checked(own, floors=True, root=own.data.root))
    assert f"rescored: {'0' * 64}" in found


@pytest.fixture
def predictions(own: BoardBench) -> Path:
    """The predictions of noisy."""
    return own.predict(noisy, "noisy", parameters=5)


def rescored(own: BoardBench, *paths: Path) -> list[str]:
    """Return what scoring predictions again finds."""
    return told(checked(own, predictions=paths, root=own.data.root))


def test_every_entry_of_the_same_predictions_is_compared(own: BoardBench, predictions: Path) -> None:
    """Two entries of one file: the forged one is found whichever is read last."""
    for name in ("a-copy", "z-copy"):
        own.submit(predictions, method=name)
    assert rescored(own, predictions) == []
    forge(own, "a-copy", scale("vorticity_mse", 0.5))
    assert rescored(own, predictions) == ["rescored: other vorticity_mse"]


@pytest.mark.parametrize("statistic", ["sinkhorn", "of_another_package"])
def test_statistics_that_the_scorer_does_not_measure(
    statistic: str, own: BoardBench, predictions: Path
) -> None:
    """A perfect value of an extra metric, or of another package's, has to be what scoring again gives."""
    rewrite(own.folder / SCORES / "noisy.nc", own.data.card(predictions), with_statistic(statistic))
    forge(own, "noisy")
    said = [line for line in rescored(own, predictions) if line.startswith("rescored")]
    assert len(said) == 1
    assert statistic in said[0] or "transport" in said[0]


@pytest.mark.parametrize(("name", "said"), [("film", "the film"), ("vorticity", "vorticity maps")])
def test_pictures_are_compared(name: str, said: str, own: BoardBench, predictions: Path) -> None:
    """A preview that is not of these predictions is found."""
    forge(own, "noisy", repaint(1, name))
    assert rescored(own, predictions) == [f"rescored: other {said}"]


def test_what_is_said_beside_the_numbers_is_compared(own: BoardBench, predictions: Path) -> None:
    """Flags, warnings and frozen scenarios are those that the scorer tells."""
    entry = yaml.safe_load(own.entry("noisy").read_text())
    entry["score"]["files"][0] |= {"diverged_at": {0: 7}, "flags": [{"name": "physics"}]}
    own.entry("noisy").write_text(yaml.safe_dump(entry, sort_keys=False))
    own.reseal("noisy")
    assert rescored(own, predictions) == ["rescored: []", "rescored: {}"]


def damaged(path: Path, predictions: Path) -> Path:
    """Write predictions with a position that is no number."""
    shutil.copyfile(predictions, path)
    with h5py.File(path, "r+") as file:
        file["position"][0, 0, 0, 0] = float("nan")
    return path


def _never(*_: object, **__: object) -> None:
    raise AssertionError("opened here")


def test_broken_predictions_are_opened_in_the_child_only(
    own: BoardBench, predictions: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever is wrong with the file is found before this process opens it; other findings remain."""
    cut = tmp_path / "cut.nc"
    cut.write_bytes(predictions.read_bytes()[:-9999])
    own.edit("damped", lambda held: held["score"].update(scored_by="me"))
    for module in (score, draft):
        monkeypatch.setattr(module, "open_predictions", _never)
    paths = [cut, damaged(tmp_path / "nan.nc", predictions)]
    result = checked(own, predictions=paths, root=own.data.root)
    assert [finding.check for finding in result.findings] == ["score", "rescored", "rescored"]
    assert [finding.where for finding in result.findings[1:]] == [str(path) for path in paths]
    assert "HDF5 cannot read" in result.findings[1].got
    assert "finite" in result.findings[2].got
    with pytest.raises(UnreadableFileError):
        own.submit(cut, method="cut")


def test_a_broken_score_file_is_not_opened_for_its_predictions(
    own: BoardBench, predictions: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A score file that the child could not read stays closed; its finding is the only one."""
    bad = own.folder / SCORES / "noisy.nc"
    monkeypatch.setattr("lagbench.board.check.unreadable_in_child", lambda _: {bad: "stopped"})
    with in_process():
        result = check_board(
            own.folder, registry=own.registry, page=False, predictions=[predictions], root=own.data.root
        )
    assert told(result) == ["score_file: stopped"]


def newer(own: BoardBench) -> Path:
    """Write a registry in which the data set has a new MAJOR version."""
    path = own.folder.parent / "newer.yaml"
    path.write_text(own.data.size.file.read_text().replace("version: 2.0.0", "version: 3.0.0"))
    return path


def test_old_seeds_of_other_shapes_are_a_finding(own: BoardBench) -> None:
    """Two seeds of an old data set, one with fewer frames: no mean of both, no traceback."""
    registry = load(newer(own))
    entry = read_entry(own.entry("damped"))
    card = own.data.card(own.predict(damped, "damped", seed=3))
    card = replace(card, predictions_sha256=entry.predictions[1].sha256)
    rewrite(own.folder / SCORES / "damped_3.nc", card, shorter)
    own.reseal("damped")
    result = check_board(own.folder, registry=registry, page=False, isolated=False)
    names = [finding.check for finding in result.findings if "damped_3" in finding.where]
    assert set(names) == {"score_file", "truth"}
    assert build(own.folder, registry=registry).rows == 2


def test_a_line_into_a_circle_has_an_end(own: BoardBench) -> None:
    """One that is superseded by a member of a circle is no member itself."""
    for one, two in (("noisy", "damped"), ("damped", "persistence"), ("persistence", "damped")):
        own.edit(one, lambda held, two=two: held.update(status="superseded", superseded_by=two))
    found = [(finding.check, finding.where.rpartition("/")[2]) for finding in checked(own).findings]
    assert sorted(found) == [("lifecycle", "damped.yaml"), ("lifecycle", "persistence.yaml")]


def test_a_missing_score_file_names_its_fix(own: BoardBench) -> None:
    """Building without a score file is an unreadable file, and says what to do."""
    (own.folder / SCORES / "noisy.nc").unlink()
    with pytest.raises(UnreadableFileError, match="leaderboard check") as error:
        build(own.folder, registry=own.registry)
    assert "lagbench submit" in str(error.value.expected)
    assert error.value.fix
