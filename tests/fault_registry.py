"""How faulty prediction files are made: the registry of faults and changes to a valid
file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
from numpy.typing import ArrayLike, NDArray
from submission_data import FRAMES, GIVEN, HORIZON, PARTICLES, TESTS, Bench

DIMS = ("scenario", "frame", "particle", "space")
SHAPE = (len(TESTS), HORIZON, PARTICLES, 2)


@dataclass(frozen=True)
class Fault:
    """A way to be wrong."""

    make: Callable[[Bench], Path]  # writes the file and returns its path
    check: str  # that must name it
    exit_code: int  # that it must lead to
    says: str = ""  # a word that the message must contain


FAULTS: dict[str, Fault] = {}


def fault(
    check: str,
    exit_code: int = 1,
    *,
    says: str = "",
) -> Callable[[Callable[[Bench], Path]], Callable[[Bench], Path]]:
    """Register a function that makes a faulty file."""

    def register(make: Callable[[Bench], Path]) -> Callable[[Bench], Path]:
        FAULTS[make.__name__] = Fault(make, check, exit_code, says)
        return make

    return register


def simple(
    check: str,
    name: str,
    change: Callable[[h5py.File], object],
    *,
    says: str = "",
) -> None:
    """Register a fault that changes an open copy of the valid file."""

    def make(bench: Bench) -> Path:
        path = bench.copy(f"{name}.nc")
        with h5py.File(path, "r+") as file:
            change(file)
        return path

    exit_code = 1
    if check == "dataset":
        exit_code = 4
    FAULTS[name] = Fault(make, check, exit_code, says=says)


def replace(
    file: h5py.File,
    name: str,
    dims: tuple[str, ...],
    data: Any = None,
    **options: Any,
) -> h5py.Dataset:
    """Replace a variable by another of the same name, with dimension scales
    attached.
    """
    attributes = {}
    if name in file:
        old_attributes = file[name].attrs
        if "units" in old_attributes:
            attributes["units"] = old_attributes["units"]
        del file[name]
    dataset = file.create_dataset(name, data=data, **options)
    dataset.attrs.update(attributes)
    for axis, dim in enumerate(dims):
        if dim in file and dim != name:
            dataset.dims[axis].attach_scale(file[dim])
    return dataset


def positions(file: h5py.File) -> NDArray[np.float32]:
    """Return the positions of an open file."""
    values: NDArray[np.float32] = file["position"][...]
    return values


def store(file: h5py.File, values: ArrayLike, **options: Any) -> h5py.Dataset:
    """Put other positions in place of those of an open file."""
    return replace(file, "position", DIMS, np.asarray(values), **options)


@contextmanager
def built(
    bench: Bench,
    name: str,
    *,
    scenarios: ArrayLike = TESTS,
    frames: ArrayLike = range(GIVEN, FRAMES),
    particles: int = PARTICLES,
    dims: tuple[str, ...] = DIMS,
    unlimited: bool = False,
) -> Iterator[tuple[Path, netCDF4.Dataset]]:
    """Yield a new file with other coordinates; unwritten frames stand still in the
    middle.
    """
    path = bench.folder / f"{name}.nc"
    scenario_ids = np.array(scenarios, np.int64)
    frame_numbers = np.array(frames, np.int64)
    lengths = {
        "scenario": len(scenario_ids),
        "frame": len(frame_numbers),
        "particle": particles,
        "space": 2,
    }
    with netCDF4.Dataset(bench.valid) as valid, netCDF4.Dataset(path, "w") as file:
        for dim, length in lengths.items():
            is_unlimited = unlimited and dim == "frame"
            file.createDimension(dim, None if is_unlimited else length)
        file.createVariable("scenario", "i8", ("scenario",))[:] = scenario_ids
        file.createVariable("frame", "i8", ("frame",))[:] = frame_numbers
        position = file.createVariable("position", "f4", dims, zlib=True)
        shape = [lengths[dim] for dim in dims]
        position[:] = np.full(shape, 0.5, np.float32)
        attributes = {name: valid.getncattr(name) for name in valid.ncattrs()}
        file.setncatts(attributes)
        yield path, file


def rows(
    bench: Bench,
    name: str,
    scenarios: list[int],
    frames: list[int],
    pick: Any,
) -> Path:
    """Write a selection of the valid positions under other coordinates."""
    with h5py.File(bench.valid) as valid:
        values = positions(valid)[pick]
    with built(bench, name, scenarios=scenarios, frames=frames) as (path, file):
        file["position"][:] = values
    return path


def attribute(
    name: str,
    attribute: str,
    value: Any,
    *,
    check: str = "format",
    says: str = "",
) -> None:
    """Register a fault that sets a global attribute, or removes it where the value is
    None.
    """

    def change(file: h5py.File) -> None:
        if value is None:
            del file.attrs[attribute]
        else:
            file.attrs[attribute] = value

    simple(check, name, change, says=says or attribute)
