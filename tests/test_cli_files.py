"""The command line and files: what it is given, what it writes, what it leaves alone."""

from __future__ import annotations

import re
from collections.abc import Callable
from importlib.metadata import requires
from pathlib import Path

import pytest
from conftest import SIZE, SPLIT
from typer.testing import Result

from lagbench.cli.machine import NEEDED
from lagbench.make.generate import GenerationResult

Run = Callable[..., Result]


def files_below(folder: Path) -> set[str]:
    """Return the names of all files, relative to the folder."""
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_clean_leaves_the_pictures_of_others(run: Run, copied: Callable[[], Path]) -> None:
    """A user's own PNG files, beside our cards and among our pictures, stay."""
    root = copied()
    folder = root / SPLIT / SIZE / "v2"
    mine = {"mine.png", "pictures/mine.png", "README.txt"}
    for name in mine:
        (folder / name).write_bytes(b"mine")
    assert run("clean", SPLIT, "--size", SIZE, "--root", root).exit_code == 0
    assert files_below(folder) == mine


def test_a_dry_clean_writes_nothing(
    run: Run, copied: Callable[[], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes no lock, so it also works on a folder that nobody may write, and beside a writer."""
    root = copied()
    before = files_below(root)

    def refused(*_: object, **__: object) -> None:
        raise AssertionError

    monkeypatch.setattr("lagbench.make.clean.dataset_lock", refused)
    result = run("clean", SPLIT, "--size", SIZE, "--root", root, "--dry-run")
    assert result.exit_code == 0, result.output
    assert "10 files" in result.stdout
    assert files_below(root) == before


@pytest.mark.parametrize("command", ["plot", "animate"])
@pytest.mark.parametrize(("name", "word"), [("none.nc", "missing"), ("text.nc", "not one of lagbench")])
def test_a_file_that_the_user_names_and_cannot_be_read_exits_3(
    command: str, name: str, word: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A missing file and a text file are unreadable files, not damaged data sets."""
    monkeypatch.chdir(tmp_path)
    Path("text.nc").write_text("no netCDF")
    for source in (name, tmp_path / name, f"./{name}"):
        result = run(command, source)
        assert result.exit_code == 3, result.output
        assert word in result.stderr
        assert name in result.stderr
        assert "lagbench generate writes what is missing" not in result.stderr


def test_a_damaged_scenario_of_a_split_exits_4(run: Run, copied: Callable[[], Path], tmp_path: Path) -> None:
    """The same damage below the root folder is a damaged data set, whose remedy is to generate."""
    root = copied()
    (root / SPLIT / SIZE / "v2" / "test" / "0003.nc").write_text("no netCDF")
    result = run("plot", SPLIT, "--size", SIZE, "--root", root, "-o", tmp_path / "x.png")
    assert result.exit_code == 4
    assert "lagbench generate" in result.stderr


@pytest.mark.parametrize(
    "words",
    [("plot", "-o", "{}/a.png"), ("plot", "--sheet", "-o", "{}/a.png"), ("animate", "-o", "{}/a.gif")],
)
def test_pictures_go_to_folders_that_are_there(
    words: tuple[str, ...], run: Run, generated: GenerationResult, tmp_path: Path
) -> None:
    """A folder that is misspelt is refused, not made."""
    lost = tmp_path / "lost"
    command, *options = (word.format(lost) for word in words)
    result = run(command, SPLIT, "--size", SIZE, "--root", generated.root, *options)
    assert result.exit_code == 2, result.output
    assert str(lost) in result.stderr
    assert not lost.exists()


def test_doctor_looks_at_every_dependency() -> None:
    """The libraries that it asks for are those that the package declares, no more and no fewer."""
    declared = [line for line in requires("lagbench") or [] if "extra ==" not in line]
    assert {name.lower() for name in NEEDED} == {re.split(r"[^\w.-]", line)[0].lower() for line in declared}
