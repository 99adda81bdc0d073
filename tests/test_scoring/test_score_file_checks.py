"""Score files of strangers: self-contained, bounded, and read in a child process
first.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from board_bench import SCORES, BoardBench, copied

from lagbench.board.check import check_board
from lagbench.errors import UnreadableFileError
from lagbench.scoring.score_file_checks import read_score_file


@pytest.fixture
def own(home: Path, tmp_path: Path) -> BoardBench:
    """A copy of the leaderboard that the test may damage."""
    return copied(home, tmp_path, without=["damped"])


def hostile(path: Path, kind: str, secret: Path) -> None:
    """Make a valid score file one that reaches outside, unpacks to gigabytes, or has
    other insides.
    """
    with h5py.File(path, "r+") as file:
        preview = file["preview"]
        film = preview["film"]
        shape = film.shape
        attributes = {name: film.attrs[name] for name in ("scale_factor", "add_offset")}
        if kind.startswith("best floor "):
            file.attrs["best_floor"] = kind.removeprefix("best floor ")
            file.require_dataset("best_floor_value", file["scenario"].shape, "f8")[
                ...
            ] = 9.0
            return
        if kind == "infinite":
            file["value"][0, 0, 0] = np.inf
            return
        if kind.startswith("beyond float32: "):
            # of the two steps the second one is infinite
            variable = preview[kind.removeprefix("beyond float32: ")]
            variable[...] = np.arange(variable.size).reshape(variable.shape) % 2
            variable.attrs["scale_factor"] = 1e300
            variable.attrs["add_offset"] = 0.0
            return
        if kind.startswith("material "):
            number = int(kind.removeprefix("material "))
            count = len(preview["material"])
            del preview["material"]
            preview["material"] = np.full(count, number, np.int32)
            return
        if kind == "descending scenarios":
            file["scenario"][...] = file["scenario"][...][::-1]
            return
        if kind == "repeated scenarios":
            file["scenario"][...] = file["scenario"][0]
            return
        if kind == "extra group":
            file.create_group("more")
            return
        if kind == "packed twice":
            plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
            plist.set_chunk((64,))
            plist.set_deflate(9)
            plist.set_deflate(9)
            h5py.h5d.create(
                file.id,
                b"twice",
                h5py.h5t.NATIVE_FLOAT,
                h5py.h5s.create_simple((64,)),
                plist,
            )
            return
        if kind == "bomb":
            options = {
                "dtype": "f4",
                "compression": "gzip",
                "chunks": (1 << 20,),
                "fillvalue": 0,
            }
            file.create_dataset("bomb", (1 << 30,), **options)
            return
        del preview["film"]
        if kind == "external link":
            preview["film"] = h5py.ExternalLink(str(secret), "/film")
        elif kind == "soft link":
            preview["film"] = h5py.SoftLink("/value")
        elif kind == "external storage":
            size = int(np.prod(shape)) * 2
            made = preview.create_dataset(
                "film", shape, "u2", external=[(str(secret), 0, size)]
            )
            made.attrs.update(attributes)
        elif kind == "virtual":
            layout = h5py.VirtualLayout(shape, "u2")
            layout[...] = h5py.VirtualSource(str(secret), "film", shape)
            preview.create_virtual_dataset("film", layout)
        elif kind == "strings":
            preview.create_dataset("film", shape, h5py.string_dtype())
        elif kind == "another type":
            preview.create_dataset("film", shape, "f8")
        elif kind == "another shape":
            preview.create_dataset("film", (2, 1, 1, 2), "u2")


@pytest.mark.parametrize(
    "kind",
    [
        *(
            "external link",
            "soft link",
            "external storage",
            "virtual",
            "bomb",
            "extra group",
            "strings",
        ),
        *("infinite", "another type", "another shape", "packed twice"),
        # the page could not draw them
        *("beyond float32: vorticity", "beyond float32: histogram"),
        *("material 77", "material -1", "material 256"),
        # the scores of the reference would be those of other scenarios
        *("descending scenarios", "repeated scenarios"),
        # it would stand in for the submission itself, another's file, or count though
        # it must not
    ],
)
def test_hostile_score_files_are_refused(kind: str, own: BoardBench) -> None:
    """Nothing outside the file is shown, nothing is unpacked to gigabytes, no shape or
    name is believed.
    """
    secret = own.folder.parent / "secret"
    secret.write_bytes(bytes(range(256)) * 400)
    path = own.folder / SCORES / "noisy.nc"
    hostile(path, kind, secret)
    assert path.stat().st_size <= 1_000_000
    with pytest.raises(UnreadableFileError):
        read_score_file(path)
    own.rehash("noisy")
    (finding,) = check_board(own.folder, registry=own.registry).findings
    assert "noisy.nc" in finding
