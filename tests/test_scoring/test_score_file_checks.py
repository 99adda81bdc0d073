"""Score files of strangers: self-contained, bounded, and of the shape of their task."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from board_bench import SCORES, BoardBench, copied

from lagbench.board.check import check_board
from lagbench.errors import UnreadableFileError
from lagbench.scoring.score_file import read_statistics


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard that the test may damage."""
    return copied(home, tmp_path, without=["damped"])


def _replace(file: h5py.File, **options: object) -> None:
    shape = file["value"].shape
    del file["value"]
    file.create_dataset("value", shape, **{"dtype": "f4", **options})


def _link(file: h5py.File, link: object) -> None:
    del file["value"]
    file["value"] = link


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(file["value"].shape, "f4")
    layout[...] = h5py.VirtualSource("secret", "film", layout.shape)
    del file["value"]
    file.create_virtual_dataset("value", layout)


HOSTILE: dict[str, Callable[[h5py.File], object]] = {
    "external link": lambda file: _link(file, h5py.ExternalLink("secret", "/film")),
    "external storage": lambda file: _replace(file, external=[("secret", 0, 999_999)]),
    "virtual": _virtual,
    "bomb": lambda file: file.create_dataset(
        "bomb", (1 << 30,), "f4", compression="gzip", chunks=(1 << 20,)
    ),
    "infinite": lambda file: file["value"].write_direct(
        np.full(file["value"].shape, np.inf, np.float32)
    ),
    "another shape": lambda file: _link(file, np.zeros((1, 1, 1), np.float32)),
    # the scores of the reference would be those of other scenarios
    "descending scenarios": lambda file: file["scenario"].write_direct(
        file["scenario"][...][::-1].copy()
    ),
    "repeated scenarios": lambda file: file["scenario"].write_direct(
        np.full(file["scenario"].shape, 3, np.int32)
    ),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_score_files_are_refused(kind: str, own: BoardBench) -> None:
    """Nothing outside the file is shown, nothing is unpacked to gigabytes, no shape or
    name is believed.
    """
    path = own.folder / SCORES / "noisy.nc"
    (path.parent / "secret").write_bytes(bytes(range(256)) * 4000)
    with h5py.File(path, "r+") as file:
        HOSTILE[kind](file)
    with pytest.raises(UnreadableFileError):
        read_statistics(path)
    (path.parent / "secret").unlink()
    own.rehash("noisy")
    (finding,) = check_board(own.folder, registry=own.registry).findings
    assert "noisy.nc" in finding
