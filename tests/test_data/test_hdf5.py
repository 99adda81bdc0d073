"""The guard of HDF5 files: what a header declares is held against what the file
holds.
"""

from __future__ import annotations

import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from lagbench.data.hdf5 import open_hdf5
from lagbench.data.structure import Structure, check_structure
from lagbench.errors import UnreadableFileError, check_regular

ANY = Structure(groups=None)


def look(path: Path, expected: Structure = ANY) -> set[str]:
    """Return the names of the arrays of a file that passes."""
    with open_hdf5(path) as file:
        return set(check_structure(file, path, expected))


def made(path: Path, fill: Callable[[h5py.File], object]) -> Path:
    """Write a file with one plain array and what a test adds."""
    with h5py.File(path, "w") as file:
        file["plain"] = np.zeros(3)
        fill(file)
    return path


def test_what_may_be_there_is_listed(tmp_path: Path) -> None:
    """Arrays of the root and of its groups, packed, scalar and empty ones too."""

    def fill(file: h5py.File) -> None:
        file.create_dataset(
            "a/packed",
            data=np.ones((9, 9)),
            compression=1,
            shuffle=True,
            fletcher32=True,
        )
        file["a/scalar"] = 1.5
        file["a/empty"] = np.zeros((0, 2))

    assert look(made(tmp_path / "a.h5", fill)) == {
        "plain",
        "a/packed",
        "a/scalar",
        "a/empty",
    }


def _twice(file: h5py.File) -> None:
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk((8,))
    for _ in range(2):
        plist.set_filter(h5py.h5z.FILTER_DEFLATE, h5py.h5z.FLAG_OPTIONAL, (1,))
    h5py.h5d.create(
        file.id, b"x", h5py.h5t.IEEE_F32LE, h5py.h5s.create_simple((8,)), plist
    )


def _bomb(file: h5py.File) -> None:
    """A chunk that declares 4 MiB and unpacks to 512 MiB, from half a MiB."""
    dataset = file.create_dataset(
        "x", (1 << 20,), "f4", chunks=(1 << 20,), compression=1
    )
    packer = zlib.compressobj(9)
    stream = (
        b"".join(packer.compress(bytes(1 << 24)) for _ in range(32)) + packer.flush()
    )
    dataset.id.write_direct_chunk((0,), stream)


def _inflated(file: h5py.File) -> None:
    """16 chunks of 32 MiB of zeros each."""
    dataset = file.create_dataset(
        "x", (1 << 28,), "i2", chunks=(1 << 24,), compression=9
    )
    packed = zlib.compress(bytes(1 << 25), 9)
    for first in range(0, 1 << 28, 1 << 24):
        dataset.id.write_direct_chunk((first,), packed)


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((3,), "f8")
    layout[...] = h5py.VirtualSource("elsewhere.h5", "y", (3,))
    file.create_virtual_dataset("x", layout)


REFUSED: dict[str, Callable[[h5py.File], object]] = {
    "soft link": lambda f: f.__setitem__("x", h5py.SoftLink("/plain")),
    "external link": lambda f: f.__setitem__(
        "x", h5py.ExternalLink("/etc/passwd", "/x")
    ),
    "link in a group": lambda f: f.create_group("a").__setitem__(
        "x", h5py.ExternalLink("b.h5", "/x")
    ),
    "group in a group": lambda f: f.create_group("a/b"),
    "external storage": lambda f: f.create_dataset(
        "x", (4,), "u1", external=[("/etc/passwd", 0, 4)]
    ),
    "virtual": _virtual,
    "foreign filter": lambda f: f.create_dataset(
        "x", data=np.zeros(99), compression="lzf"
    ),
    "filter twice": _twice,
    "compound": lambda f: f.__setitem__("x", np.zeros(3, [("a", "f4")])),
    "texts": lambda f: f.__setitem__("x", ["a", "b"]),
    "chunk bomb": _bomb,
    "inflated": _inflated,
    "nothing stored": lambda f: f.create_dataset(
        "x", (3, 1 << 32, 2), "f4", chunks=(1, 1 << 20, 2)
    ),
    "crowd": lambda f: [f.create_group(f"g{i}") for i in range(1100)],
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_may_harm_a_reader_is_refused(tmp_path: Path, name: str) -> None:
    """Exit code 3 and the file's name, in little memory."""
    path = made(tmp_path / "a.h5", REFUSED[name])
    tracemalloc.start()
    with pytest.raises(UnreadableFileError) as caught:
        look(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(path) in str(caught.value.where)
    assert peak < 32 << 20


def test_formats_say_what_they_expect(tmp_path: Path) -> None:
    """Groups by name, texts, members, bytes in all."""
    path = made(tmp_path / "a.h5", lambda f: f.__setitem__("a/x", ["a text"]))
    right = Structure(groups=("a",), texts=True)
    assert look(path, right) == {"plain", "a/x"}
    for change in (
        {"groups": ()},
        {"groups": ("b",)},
        {"texts": False},
        {"members": 1},
        {"unpacked": 24},
    ):
        with pytest.raises(UnreadableFileError):
            look(path, replace(right, **change))


def test_large_honest_chunks_pass(tmp_path: Path) -> None:
    """Random numbers in a chunk of 4 MiB, whose stream might unpack to gigabytes and
    does not.
    """
    packing = {
        "data": np.random.default_rng(0).random(1 << 19),
        "chunks": (1 << 19,),
        "compression": 1,
    }
    assert look(
        made(tmp_path / "a.h5", lambda f: f.create_dataset("x", **packing))
    ) == {"plain", "x"}


def test_long_files_are_refused(tmp_path: Path) -> None:
    """A byte too many."""
    (tmp_path / "a").write_bytes(bytes(100))
    assert check_regular(tmp_path / "a", longest=100) == 100
    with pytest.raises(UnreadableFileError):
        check_regular(tmp_path / "a", longest=99)
