"""The guard of HDF5 files: the declarations of a header against the file's bytes."""

from __future__ import annotations

import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from lagbench.data.hdf5 import open_hdf5
from lagbench.data.structure import Structure, check_structure
from lagbench.errors import UnreadableFileError

ANY = Structure(groups=None)


def list_arrays(path: Path, expected: Structure = ANY) -> set[str]:
    """Return the names of the arrays of a file that passes."""
    with open_hdf5(path) as file:
        return set(check_structure(file, path, expected))


def write_file(path: Path, fill: Callable[[h5py.File], object]) -> Path:
    """Write a file with one plain array and what a test adds."""
    with h5py.File(path, "w") as file:
        file["plain"] = np.zeros(3)
        fill(file)
    return path


def test_arrays_of_the_root_and_of_groups_are_listed(tmp_path: Path) -> None:
    """Packed, scalar and empty ones too."""

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

    path = write_file(tmp_path / "a.h5", fill)
    assert list_arrays(path) == {"plain", "a/packed", "a/scalar", "a/empty"}


def soft_link(file: h5py.File) -> None:
    """Link to an array of the same file."""
    file["x"] = h5py.SoftLink("/plain")


def external_link(file: h5py.File) -> None:
    """Link to another file."""
    file["x"] = h5py.ExternalLink("/etc/passwd", "/x")


def link_in_a_group(file: h5py.File) -> None:
    """Link to another file from a group."""
    file.create_group("a")["x"] = h5py.ExternalLink("b.h5", "/x")


def group_in_a_group(file: h5py.File) -> None:
    """Nest two groups."""
    file.create_group("a/b")


def external_storage(file: h5py.File) -> None:
    """Keep the values in another file."""
    file.create_dataset("x", (4,), "u1", external=[("/etc/passwd", 0, 4)])


def virtual_dataset(file: h5py.File) -> None:
    """Show the values of another file."""
    layout = h5py.VirtualLayout((3,), "f8")
    layout[...] = h5py.VirtualSource("elsewhere.h5", "y", (3,))
    file.create_virtual_dataset("x", layout)


def foreign_filter(file: h5py.File) -> None:
    """Pack with a filter that scenario files do not use."""
    file.create_dataset("x", data=np.zeros(99), compression="lzf")


def filter_twice(file: h5py.File) -> None:
    """Pack with the same filter twice."""
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_chunk((8,))
    for _ in range(2):
        properties.set_filter(h5py.h5z.FILTER_DEFLATE, h5py.h5z.FLAG_OPTIONAL, (1,))
    space = h5py.h5s.create_simple((8,))
    h5py.h5d.create(file.id, b"x", h5py.h5t.IEEE_F32LE, space, properties)


def compound_type(file: h5py.File) -> None:
    """Store pairs of a name and a value."""
    file["x"] = np.zeros(3, [("a", "f4")])


def texts(file: h5py.File) -> None:
    """Store texts."""
    file["x"] = ["a", "b"]


def inflated(file: h5py.File) -> None:
    """Store 16 chunks of 32 MiB of zeros each."""
    dataset = file.create_dataset(
        "x",
        (1 << 28,),
        "i2",
        chunks=(1 << 24,),
        compression=9,
    )
    packed = zlib.compress(bytes(1 << 25), 9)
    for first in range(0, 1 << 28, 1 << 24):
        dataset.id.write_direct_chunk((first,), packed)


def nothing_stored(file: h5py.File) -> None:
    """Declare gigabytes without a single chunk."""
    file.create_dataset("x", (3, 1 << 32, 2), "f4", chunks=(1, 1 << 20, 2))


def crowd(file: h5py.File) -> None:
    """Add more than a thousand groups."""
    for number in range(1100):
        file.create_group(f"g{number}")


@pytest.mark.parametrize(
    "fill",
    [
        soft_link,
        external_link,
        link_in_a_group,
        group_in_a_group,
        external_storage,
        virtual_dataset,
        foreign_filter,
        filter_twice,
        compound_type,
        texts,
        inflated,
        nothing_stored,
        crowd,
    ],
)
def test_files_that_may_harm_a_reader_are_refused(
    tmp_path: Path, fill: Callable[[h5py.File], None]
) -> None:
    """The error names the file, and comes in little memory."""
    path = write_file(tmp_path / "a.h5", fill)
    tracemalloc.start()
    with pytest.raises(UnreadableFileError) as caught:
        list_arrays(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert str(path) in str(caught.value.where)
    assert peak < 32 << 20


@pytest.fixture
def file_with_text(tmp_path: Path) -> Path:
    """A file with a text in a group."""

    def fill(file: h5py.File) -> None:
        file["a/x"] = ["a text"]

    return write_file(tmp_path / "a.h5", fill)


def test_a_file_of_the_expected_structure_passes(file_with_text: Path) -> None:
    expected = Structure(groups=("a",), texts=True)
    assert list_arrays(file_with_text, expected) == {"plain", "a/x"}


@pytest.mark.parametrize(
    "changes",
    [
        {"groups": ()},
        {"groups": ("b",)},
        {"texts": False},
        {"members": 1},
        {"unpacked": 24},
    ],
)
def test_a_file_of_another_structure_is_refused(
    file_with_text: Path, changes: dict[str, Any]
) -> None:
    """Groups by name, texts, number of members, bytes in all."""
    expected = replace(Structure(groups=("a",), texts=True), **changes)
    with pytest.raises(UnreadableFileError):
        list_arrays(file_with_text, expected)
