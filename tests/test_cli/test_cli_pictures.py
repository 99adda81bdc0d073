"""The commands plot and animate write the file that they name."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import Result
from conftest import SIZE, SPLIT

import lagbench
from lagbench.make.generate import GenerationResult

Run = Callable[..., Result]


@pytest.mark.parametrize(
    ("words", "beginning"),
    [
        (("plot", "--kind", "speed"), b"\x89PNG"),
        (("plot", "--kind", "speed", "-o", "a.svg"), b"<?xml"),
        pytest.param(
            ("plot", "--sheet", "-o", "a.png"), b"\x89PNG", marks=pytest.mark.slow
        ),
        (("animate", "4", "--every", "13", "-o", "a.gif"), b"GIF"),
    ],
)
def test_a_picture_replaces_a_file_only_on_request(
    words: tuple[str, ...],
    beginning: bytes,
    run: Run,
    generated: GenerationResult,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    command, *rest = words
    line = [command, SPLIT, *rest, "--size", SIZE, "--root", generated.root, "--json"]
    drawn = run(*line)
    assert drawn.exit_code == 0, drawn.output
    file = tmp_path / json.loads(drawn.stdout)["output"]
    assert file.read_bytes().startswith(beginning)
    assert run(*line).exit_code == 2
    assert run(*line, "--overwrite").exit_code == 0


def test_python_draws_the_same_picture(
    run: Run, generated: GenerationResult, tmp_path: Path
) -> None:
    file = generated.folder / "test" / "0004.nc"
    pictures = [tmp_path / "python.png", tmp_path / "command.png"]
    lagbench.plot(file, output=pictures[0], frame=5, kind="speed")
    words = ("plot", file, "--frame", 5, "--kind", "speed", "-o", pictures[1])
    assert run(*words).exit_code == 0
    assert pictures[0].read_bytes() == pictures[1].read_bytes()


@pytest.mark.parametrize("command", ["plot", "animate"])
def test_data_that_cannot_be_read_have_their_exit_codes(
    command: str, run: Run, generated: GenerationResult, tmp_path: Path
) -> None:
    text = tmp_path / "text.nc"
    text.write_text("no netCDF")
    film = ("-o", tmp_path / "a.gif" if command == "animate" else tmp_path / "a.png")
    missing = ("--size", "tiny", "--root", tmp_path)
    scenario = generated.folder / "test" / "0003.nc"
    assert run(command, "cavity", *missing, *film).exit_code == 4
    assert run(command, text, *film).exit_code == 4
    assert run(command, tmp_path / "none.nc", *film).exit_code == 4
    assert run(command, scenario, "--scenario", 4, *film).exit_code == 2
