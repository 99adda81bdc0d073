"""The commands plot and animate."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import Result
from conftest import SIZE, SPLIT

import lagbench
from lagbench.errors import UsageError
from lagbench.make.generate import GenerationResult

Run = Callable[..., Result]


def test_a_picture_is_named_after_its_data(
    run: Run,
    generated: GenerationResult,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By default it shows the last of the 26 frames."""
    monkeypatch.chdir(tmp_path)
    words = ["plot", SPLIT, "--size", SIZE, "--root", generated.root, "--kind", "speed"]
    result = run(*words, "--frame", 5)
    assert result.exit_code == 0, result.output
    picture = tmp_path / "curl-noise-tiny-0003-frame5.png"
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert run(*words).exit_code == 0
    assert (tmp_path / "curl-noise-tiny-0003-frame25.png").is_file()


def test_python_draws_the_same_picture(
    run: Run, generated: GenerationResult, tmp_path: Path
) -> None:
    """Named by its split or by its file, it has the bytes of the command's picture."""
    pictures = [tmp_path / "split.png", tmp_path / "file.png", tmp_path / "command.png"]
    options = {"frame": 5, "kind": "speed"}
    lagbench.plot(
        SPLIT,
        size=SIZE,
        root=generated.root,
        output=pictures[0],
        scenario=4,
        **options,
    )
    file = generated.folder / "test" / "0004.nc"
    lagbench.plot(file, output=pictures[1], **options)
    words = ("plot", file, "--frame", 5, "--kind", "speed", "-o", pictures[2])
    assert run(*words).exit_code == 0
    with pytest.raises(UsageError) as caught:
        lagbench.plot(file, output=pictures[1], **options)
    assert "overwrite" in caught.value.fix
    lagbench.plot(file, output=pictures[1], overwrite=True, **options)
    assert len({picture.read_bytes() for picture in pictures}) == 1
    with pytest.raises(UsageError):
        lagbench.animate(file, beside=4, output=tmp_path / "none" / "film.gif")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "name"),
    [
        (("plot", "--kind", "speed", "--frame", 5), "curl-noise-tiny-0003-frame5.png"),
        (("plot", "-o", "a.png"), "a.png"),
        (("plot", "--sheet", "-o", "a.png"), "a.png"),
        (("animate", "--every", 13, "-o", "a.gif"), "a.gif"),
    ],
)
def test_a_file_is_replaced_only_on_request(
    words: tuple[str, ...],
    name: str,
    run: Run,
    generated: GenerationResult,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A picture that is named after its data is a file like any other."""
    monkeypatch.chdir(tmp_path)
    Path(name).write_bytes(b"the work of a week")
    data_set = (SPLIT, "--size", SIZE, "--root", generated.root)
    refused = run(*words, *data_set)
    assert refused.exit_code == 2, refused.output
    assert "--overwrite" in refused.stderr
    assert Path(name).read_bytes() == b"the work of a week"
    replaced = run(*words, *data_set, "--overwrite")
    assert replaced.exit_code == 0, replaced.output
    assert Path(name).read_bytes()[:3] in {b"\x89PN", b"GIF"}


def test_two_files_become_one_film(
    run: Run,
    generated: GenerationResult,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = generated.folder / "test"
    files = (folder / "0003.nc", folder / "0004.nc")
    film = run("animate", *files, "--every", 13, "-o", "two.gif", "--json")
    assert film.exit_code == 0, film.output
    assert json.loads(film.stdout) == {"output": "two.gif"}
    assert (tmp_path / "two.gif").read_bytes()[:3] == b"GIF"


def test_a_picture_of_missing_data_exits_4(run: Run, tmp_path: Path) -> None:
    assert run("plot", SPLIT, "--size", SIZE, "--root", tmp_path).exit_code == 4


@pytest.mark.parametrize("command", ["plot", "animate"])
@pytest.mark.parametrize("name", ["none.nc", "text.nc"])
def test_a_named_file_that_cannot_be_read_exits_3(
    command: str,
    name: str,
    run: Run,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A missing file and a text file are unreadable files, not damaged data sets."""
    monkeypatch.chdir(tmp_path)
    Path("text.nc").write_text("no netCDF")
    for source in (name, tmp_path / name, f"./{name}"):
        result = run(command, source)
        assert result.exit_code == 3, result.output
        assert name in result.stderr
        assert "lagbench plot cavity" in result.stderr


def test_a_named_file_with_an_impossible_obstacle_exits_3(
    run: Run, generated: GenerationResult, tmp_path: Path
) -> None:
    """The message names the file, as for every other damage."""
    file = tmp_path / "scene.nc"
    shutil.copy(generated.folder / "test" / "0003.nc", file)
    place = {"obstacle_x": 0.5, "obstacle_y": 0.5, "obstacle_diameter": 0.0}
    with h5py.File(file, "r+") as scene:
        names = [scene.attrs["hashed_parameters"].decode(), *place]
        scene.attrs["hashed_parameters"] = np.bytes_(" ".join(names).encode())
        for name, value in place.items():
            scene.attrs[name] = value
    result = run("plot", file, "-o", tmp_path / "a.png")
    assert result.exit_code == 3, result.output
    assert "scene.nc" in result.stderr


@pytest.mark.parametrize(
    "words",
    [
        ("plot", "-o", "{}/a.png"),
        ("plot", "--sheet", "-o", "{}/a.png"),
        ("animate", "-o", "{}/a.gif"),
    ],
)
def test_a_misspelt_folder_is_refused_and_not_made(
    words: tuple[str, ...],
    run: Run,
    generated: GenerationResult,
    tmp_path: Path,
) -> None:
    folder = tmp_path / "lost"
    command, *options = (word.format(folder) for word in words)
    result = run(command, SPLIT, "--size", SIZE, "--root", generated.root, *options)
    assert result.exit_code == 2, result.output
    assert str(folder) in result.stderr
    assert not folder.exists()


@pytest.mark.parametrize("command", ["plot", "animate"])
def test_a_file_beside_an_id_is_refused(
    command: str, run: Run, generated: GenerationResult, tmp_path: Path
) -> None:
    """Nobody gets the picture of another scenario than the one that was named."""
    file = generated.folder / "test" / "0003.nc"
    result = run(command, file, "--scenario", 4, "-o", tmp_path / "a.gif")
    assert result.exit_code == 2, result.output
    assert "--scenario" in result.stderr


@pytest.mark.parametrize(("option", "number"), [("--scenario", 4), ("--frame", 5)])
def test_a_sheet_refuses_the_choice_of_one(
    option: str, number: int, run: Run, generated: GenerationResult, tmp_path: Path
) -> None:
    """A sheet shows all scenarios: the number would be left out in silence."""
    sheet = tmp_path / "sheet.png"
    words = ("plot", SPLIT, "--size", SIZE, "--root", generated.root, "--sheet")
    result = run(*words, option, number, "-o", sheet)
    assert result.exit_code == 2, result.output
    assert option in result.stderr
    assert not sheet.exists()
