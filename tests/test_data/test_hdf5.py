"""The guard of HDF5 files: the declarations of a header against the file's bytes."""

from __future__ import annotations

import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from lagbench.data.hdf5 import list_variables, open_hdf5
from lagbench.errors import DataError


def list_arrays(path: Path) -> set[str]:
    """Return the names of the arrays of a file that passes."""
    with open_hdf5(path) as file:
        return set(list_variables(file))


def write_file(path: Path, fill: Callable[[h5py.File], object]) -> Path:
    """Write a file with one plain array and what a test adds."""
    with h5py.File(path, "w") as file:
        file["plain"] = np.zeros(3)
        fill(file)
    return path


def test_variables_of_the_root_are_listed(tmp_path: Path) -> None:
    """Packed, scalar and empty ones, and texts too."""

    def fill(file: h5py.File) -> None:
        file.create_dataset(
            "packed",
            data=np.ones((9, 9)),
            compression=1,
            shuffle=True,
            fletcher32=True,
        )
        file["scalar"] = 1.5
        file["empty"] = np.zeros((0, 2))
        file["texts"] = ["a", "b"]
        file["group/more"] = 1

    path = write_file(tmp_path / "a.h5", fill)
    assert list_arrays(path) == {"plain", "packed", "scalar", "empty", "texts"}


def soft_link(file: h5py.File) -> None:
    """Link to an array of the same file."""
    file["x"] = h5py.SoftLink("/plain")


def external_link(file: h5py.File) -> None:
    """Link to another file."""
    file["x"] = h5py.ExternalLink("/etc/passwd", "/x")


def external_storage(file: h5py.File) -> None:
    """Keep the values in another file."""
    file.create_dataset("x", (4,), "u1", external=[("/etc/passwd", 0, 4)])


def virtual_dataset(file: h5py.File) -> None:
    """Show the values of another file."""
    layout = h5py.VirtualLayout((3,), "f8")
    layout[...] = h5py.VirtualSource("elsewhere.h5", "y", (3,))
    file.create_virtual_dataset("x", layout)


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
        external_storage,
        virtual_dataset,
        inflated,
        nothing_stored,
        crowd,
    ],
)
def test_files_that_may_harm_a_reader_are_refused(
    tmp_path: Path, fill: Callable[[h5py.File], None]
) -> None:
    """The error comes in little memory."""
    path = write_file(tmp_path / "a.h5", fill)
    tracemalloc.start()
    with pytest.raises(DataError):
        list_arrays(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 32 << 20
