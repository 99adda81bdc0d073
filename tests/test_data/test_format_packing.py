"""How a library packs a scenario file does not matter to its content hash."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import independent_hash
import netCDF4
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scenario_factory import DIMS, make_key, write_scenario

from lagbench.data.scenario import rehash

KEY = make_key()


@pytest.mark.slow
@settings(
    max_examples=20,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    library=st.sampled_from(["h5py", "netcdf4", "xarray"]),
    level=st.integers(0, 9),
    shuffle=st.booleans(),
    chunk=st.tuples(st.integers(1, 4), st.integers(1, 8), st.integers(1, 2)),
    order=st.randoms(use_true_random=False),
)
def test_packing_does_not_matter(
    tmp_path: Path,
    library: str,
    level: int,
    shuffle: bool,
    chunk: tuple[int, int, int],
    order: random.Random,
) -> None:
    """Chunks, compression, library and order of attributes leave the hash as it is."""

    def shuffle_names(names: Any) -> list[str]:
        # Only netCDF may write _NCProperties.
        shuffled = [name for name in names if name != "_NCProperties"]
        order.shuffle(shuffled)
        return shuffled

    path, content = write_scenario(tmp_path, KEY)
    other = tmp_path / f"{library}.nc"
    REPACK[library](path, other, Packing(level, shuffle, chunk, shuffle_names))
    assert rehash(other) == content
    assert independent_hash.content_hash(other) == content


CHUNKED = ("position", "velocity")


class Packing(NamedTuple):
    """How a file is packed."""

    level: int
    shuffle: bool
    chunk: tuple[int, int, int]
    shuffle_names: Callable[[Any], list[str]]  # puts names into another order


def h5py_options(name: str, packing: Packing) -> dict[str, Any]:
    """Return the options of a data set."""
    options: dict[str, Any] = {}
    if name in CHUNKED:
        options["chunks"] = packing.chunk
        options["shuffle"] = packing.shuffle
        if packing.level:
            options["compression"] = "gzip"
            options["compression_opts"] = packing.level
    return options


def repack_h5py(path: Path, other: Path, packing: Packing) -> None:
    """Copy a scenario file by h5py with other packing."""
    with h5py.File(path) as old, h5py.File(other, "w", track_order=True) as new:
        names = packing.shuffle_names(old)
        for name in names:
            values = old[name]
            dtype = values.dtype.newbyteorder(">")
            if values.dtype.kind == "O":
                dtype = h5py.string_dtype()
            options = h5py_options(name, packing)
            new.create_dataset(name, data=values[()], dtype=dtype, **options)
            if DIMS[name] == (name,):
                new[name].make_scale(name)
        for name in names:
            if DIMS[name] != (name,):
                for axis, dim in enumerate(DIMS[name]):
                    new[name].dims[axis].attach_scale(new[dim])
        for name in packing.shuffle_names(old.attrs):
            value = old.attrs[name]
            if isinstance(value, bytes):
                value = value.decode()
            new.attrs[name] = value


def netcdf4_options(name: str, packing: Packing) -> dict[str, Any]:
    """Return the options of a variable."""
    options: dict[str, Any] = {}
    if name in CHUNKED:
        options["chunksizes"] = packing.chunk
        options["shuffle"] = packing.shuffle
        options["endian"] = "big"
        options["complevel"] = packing.level
        if packing.level:
            options["compression"] = "zlib"
    return options


def repack_netcdf4(path: Path, other: Path, packing: Packing) -> None:
    """Copy a scenario file by netCDF4 with other packing."""
    with netCDF4.Dataset(path) as old, netCDF4.Dataset(other, "w") as new:
        for name in packing.shuffle_names(old.dimensions):
            length = old.dimensions[name].size
            if name == "frame":
                length = None
            new.createDimension(name, length)
        for name in packing.shuffle_names(old.variables):
            dtype = old[name].dtype
            if name in CHUNKED:
                dtype = dtype.newbyteorder(">")
            options = netcdf4_options(name, packing)
            variable = new.createVariable(name, dtype, DIMS[name], **options)
            variable[...] = old[name][...]
        for name in packing.shuffle_names(old.ncattrs()):
            new.setncattr(name, old.getncattr(name))


def repack_xarray(path: Path, other: Path, packing: Packing) -> None:
    """Copy a scenario file by xarray with other packing."""
    with xr.open_dataset(path) as old:
        data = old.load().drop_encoding()
    data = data[packing.shuffle_names(data.data_vars)]
    names = packing.shuffle_names(data.attrs)
    data.attrs = {name: data.attrs[name] for name in names}
    encoding: dict[str, dict[str, Any]] = {}
    for variable in data.variables:
        name = str(variable)
        encoding[name] = {"_FillValue": None}
        if name in CHUNKED:
            encoding[name] |= {
                "chunksizes": packing.chunk,
                "zlib": packing.level > 0,
                "complevel": packing.level,
                "shuffle": packing.shuffle,
            }
    data.to_netcdf(other, engine="netcdf4", encoding=encoding)


REPACK = {
    "h5py": repack_h5py,
    "netcdf4": repack_netcdf4,
    "xarray": repack_xarray,
}
