"""Every command that reads a file of the user's refuses one that cannot be read: an
error, an exit code.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import Result
from exchange_readers import straight_runs
from exchange_writers import write_gns, write_h5

Run = Callable[..., Result]

RANDOM = np.random.default_rng(0).bytes(5_000)


def hdf5(path: Path) -> None:
    """Write an HDF5 file of some kB, which a netCDF reader opens too."""
    with h5py.File(path, "w", libver="latest") as file:
        file["other"] = np.zeros((20, 30, 2), np.float32)


def cut(path: Path) -> None:
    """Write the first half of an HDF5 file."""
    hdf5(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


def locked(path: Path) -> None:
    """Write a file that its owner may not read."""
    hdf5(path)
    path.chmod(0)


FAULTS: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: None,
    "a folder": lambda path: path.mkdir(),
    "empty": lambda path: path.touch(),
    "text": lambda path: path.write_text("no file of ours: [unclosed, {\n"),
    "random bytes": lambda path: path.write_bytes(RANDOM),
    "cut": cut,
    "another HDF5 file": hdf5,
} | ({} if os.geteuid() == 0 else {"locked": locked})  # root may read everything

COMMANDS: dict[str, tuple[str, ...]] = {
    "validate": ("validate", "{}.nc"),
    "score": ("score", "{}.nc"),
    "score two": ("score", "{}.nc", "{}.nc", "--report", "report"),
    "compare predictions": ("compare", "{}.nc", "persistence"),
    "compare scores": ("compare", "{}.json", "persistence"),
    "compare second": ("compare", "{}.json", "{}.json"),
    "plot": ("plot", "{}.nc"),
    "animate": ("animate", "{}.nc", "-o", "film.gif"),
    "predict": ("predict", "{}.pt", "-o", "new.nc"),
    "train recipe": (
        "train",
        "curl-noise",
        "--size",
        "tiny",
        "--baseline",
        "mlp",
        "--recipe",
        "./{}.yaml",
    ),
    "submit": (
        "submit",
        "{}.nc",
        "--method",
        "x",
        "--author",
        "y",
        "--command",
        "z",
        "--new-board",
    ),
    "submit meta": ("submit", "predictions.nc", "--from", "{}.yaml"),
    "adopt npy": (
        "adopt",
        "{}.npy",
        "good.npy",
        "-o",
        "own",
        "--radius",
        "0.1",
        "--frame-interval",
        "0.1",
    ),
    "adopt npz": (
        "adopt",
        "{}.npz",
        "good.npy",
        "-o",
        "own",
        "--radius",
        "0.1",
        "--frame-interval",
        "0.1",
    ),
    "adopt nc": (
        "adopt",
        "{}.nc",
        "good.npy",
        "-o",
        "own",
        "--radius",
        "0.1",
        "--frame-interval",
        "0.1",
    ),
    "adopt describe": ("adopt", "good.npy", "-o", "own", "--describe", "{}.yaml"),
    "import gns": (
        "import",
        "gns",
        "--format",
        "gns-npz",
        "-o",
        "own",
    ),
    "import gns metadata": (
        "import",
        "gns-meta",
        "--format",
        "gns-npz",
        "-o",
        "own",
    ),
    "import h5": ("import", "h5", "--format", "lagrangebench-h5", "-o", "own"),
    "check predictions": ("leaderboard", "check", "--predictions", "{}.nc"),
    "verify": ("verify", "local/"),
    "info": ("info", "local/"),
    "export": ("export", "local/"),
    "template": ("template", "local/", "-o", "made.nc"),
}

PLACES = {
    "import gns": "gns/train.npz",
    "import gns metadata": "gns-meta/metadata.json",
    "import h5": "h5/train.h5",
    **dict.fromkeys(("verify", "info", "export", "template"), "local/split.yaml"),
}
"""Where the file lies that a command is not given by name."""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with what is right around the file that is not."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LAGBENCH_ROOT", str(tmp_path / "root"))
    np.save("good.npy", np.stack(straight_runs(3)))
    for name in ("gns", "gns-meta"):
        write_gns(tmp_path / name, straight_runs(3))
    write_h5(tmp_path / "h5", straight_runs(3))
    (tmp_path / "local").mkdir()
    (tmp_path / "leaderboard" / "submissions").mkdir(parents=True)
    hdf5(tmp_path / "predictions.nc")
    return tmp_path


NOT_RIGHT = 1
"""Exit code of a file that can be read but is not right, and of a check that names what
it cannot read.
"""


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("command", COMMANDS)
def test_an_unreadable_file_is_one_error(
    command: str, fault: str, run: Run, folder: Path
) -> None:
    """The documented exit code, one message of few lines that names the file, and
    nothing is written.
    """
    words = [word.format("bad") for word in COMMANDS[command]]
    named = [word for word in words if word.startswith(("bad.", "./bad."))]
    place = folder / PLACES.get(command, named[0] if named else "")
    if place.is_file():
        place.unlink()
    FAULTS[fault](place)
    before = sorted(path.relative_to(folder) for path in folder.rglob("*"))
    done = run(*words)
    said = done.stdout + done.stderr
    readable = fault == "another HDF5 file" or command == "check predictions"
    assert done.exit_code in (2, 3, *([NOT_RIGHT] if readable else [])), said
    assert "Traceback" not in said
    assert "unexpected" not in said
    errors = re.findall(r"^lagbench: .+", done.stderr, re.M)
    assert len(errors) <= 1  # validate and score list what they found instead
    assert place.name in said or words[1].rstrip("/") in said
    assert fault == "another HDF5 file" or len(said.splitlines()) <= 12
    assert sorted(path.relative_to(folder) for path in folder.rglob("*")) == before
