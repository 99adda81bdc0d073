"""A model or a folder in place of predictions: what the message advises."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest

from lagbench.board.entry import Meta
from lagbench.board.submit import submit
from lagbench.errors import LagbenchError, UnreadableFileError
from lagbench.scoring.boards import SUBMISSIONS
from lagbench.scoring.compare import compare
from lagbench.scoring.score import score
from lagbench.submission.other_files import (
    BOARD_ENTRIES,
    find_model_ending,
    refuse_other_files,
)


def write_model(path: Path, ending: str) -> Path:
    """Write a file that begins like a model of a format."""
    if ending == ".pt":
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("weights/data.pkl", b"")
    elif ending == ".safetensors":
        header = json.dumps({"__metadata__": {}}).encode()
        path.write_bytes(len(header).to_bytes(8, "little") + header)
    else:
        path.write_bytes(b"\x08\x08\x12\x07pytorch")
    return path


@pytest.mark.parametrize("ending", [".onnx", ".safetensors"])
def test_a_model_is_known_by_its_bytes_or_its_name(tmp_path: Path, ending: str) -> None:
    path = write_model(tmp_path / f"small{ending}", ending)
    unnamed = write_model(tmp_path / "small.nc", ending)
    other = tmp_path / f"other{ending}"
    other.write_bytes(b"bytes of any kind")
    assert find_model_ending(path) == ending
    assert find_model_ending(unnamed) == ending
    assert find_model_ending(other) == ending
    with pytest.raises(UnreadableFileError) as caught:
        refuse_other_files(path)
    fix = str(caught.value.fix)
    assert f"lagbench predict {path}" in fix
    assert fix.endswith(" -o small.nc")
    assert ("--split SPLIT --size SIZE" in fix) is (ending == ".onnx")
    with pytest.raises(UnreadableFileError) as caught:
        refuse_other_files(unnamed)
    assert f"name it small{ending}" in str(caught.value.fix)


def test_other_files_are_left_to_their_reader(tmp_path: Path) -> None:
    """HDF5, a text, an archive, and paths that no file has."""
    for name, content in (
        ("hdf5.onnx", b"\x89HDF\r\n\x1a\n"),
        ("scores.json", b'{"format": 1}'),
        ("values.npz", b"PK\x03\x04"),
        ("empty.nc", b""),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        refuse_other_files(path)
    for name in ("none.onnx", "a\0b", "x" * 300):
        refuse_other_files(tmp_path / name)


def test_every_reader_of_predictions_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    model = write_model(tmp_path / "small.onnx", ".onnx")
    Path("scores.nc").write_bytes(b"")
    meta = Meta(method="m", authors=("a",), command="c")
    calls = (
        lambda: score(model),
        lambda: submit([model], meta, board="trial"),
        lambda: compare(model, "persistence"),
        lambda: compare("scores.nc", model),
    )
    for call in calls:
        with pytest.raises(LagbenchError) as caught:
            call()
        assert caught.value.exit_code == UnreadableFileError.exit_code
        assert "lagbench predict" in str(caught.value)
        assert "submission.write" not in str(caught.value)


def test_a_leaderboard_in_place_of_predictions_is_recognised(tmp_path: Path) -> None:
    assert BOARD_ENTRIES == SUBMISSIONS
    board = tmp_path / "trial"
    (board / SUBMISSIONS).mkdir(parents=True)
    (board / ".lock").touch()
    for read in (score, lambda path: compare(path, "persistence")):
        with pytest.raises(LagbenchError) as caught:
            read(board)
        assert f"lagbench leaderboard show --board {board}" in str(caught.value)


def test_of_a_folder_only_netcdf_files_are_named(tmp_path: Path) -> None:
    for name in (".hidden.nc", "index.html", "small.nc"):
        (tmp_path / name).touch()
    with pytest.raises(UnreadableFileError) as caught:
        refuse_other_files(tmp_path)
    assert caught.value.fix == "name a file in it: small.nc"
    (tmp_path / "small.nc").unlink()
    with pytest.raises(UnreadableFileError) as caught:
        refuse_other_files(tmp_path)
    assert "no .nc file" in str(caught.value.fix)
