"""How a library packs a scenario file does not matter to its content hash."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import independent_hash
import netCDF4
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scenario_factory import DIMS, make_key, write_scenario

from lagbench.data.scenario import rehash

KEY = make_key()


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

    def shuffled(names: Any) -> list[str]:  # without the one that only netCDF may write
        listed = [name for name in names if name != "_NCProperties"]
        order.shuffle(listed)
        return listed

    path, content = write_scenario(tmp_path, KEY)
    other = tmp_path / f"{library}.nc"
    REPACK[library](path, other, Packing(level, shuffle, chunk, shuffled))
    assert rehash(other) == content
    assert independent_hash.content_hash(other) == content


CHUNKED = ("position", "velocity")


class Packing(NamedTuple):
    """How a file is packed."""

    level: int
    shuffle: bool
    chunk: tuple[int, int, int]
    shuffled: Callable[[Any], list[str]]  # puts names into another order


def repack_h5py(path: Path, other: Path, how: Packing) -> None:
    """Copy a scenario file by h5py with other packing."""
    with h5py.File(path) as old, h5py.File(other, "w", track_order=True) as new:
        names = how.shuffled(old)
        for name in names:
            packing = (
                {"chunks": how.chunk, "shuffle": how.shuffle} if name in CHUNKED else {}
            )
            if packing and how.level:
                packing |= {"compression": "gzip", "compression_opts": how.level}
            dtype = (
                h5py.string_dtype()
                if old[name].dtype.kind == "O"
                else old[name].dtype.newbyteorder(">")
            )
            new.create_dataset(name, data=old[name][()], dtype=dtype, **packing)
            if DIMS[name] == (name,):
                new[name].make_scale(name)
        for name in names:
            for axis, dim in enumerate(DIMS[name] if DIMS[name] != (name,) else ()):
                new[name].dims[axis].attach_scale(new[dim])
        for name in how.shuffled(old.attrs):
            value = old.attrs[name]
            new.attrs[name] = value.decode() if isinstance(value, bytes) else value


def repack_netcdf4(path: Path, other: Path, how: Packing) -> None:
    """Copy a scenario file by netCDF4 with other packing."""
    with netCDF4.Dataset(path) as old, netCDF4.Dataset(other, "w") as new:
        for name in how.shuffled(old.dimensions):
            new.createDimension(
                name, None if name == "frame" else old.dimensions[name].size
            )
        for name in how.shuffled(old.variables):
            dtype = old[name].dtype
            packing: dict[str, Any] = {}
            if name in CHUNKED:
                packing = {
                    "chunksizes": how.chunk,
                    "shuffle": how.shuffle,
                    "endian": "big",
                }
                packing |= {
                    "compression": "zlib" if how.level else None,
                    "complevel": how.level,
                }
                dtype = dtype.newbyteorder(">")
            variable = new.createVariable(name, dtype, DIMS[name], **packing)
            variable[...] = old[name][...]
        new.setncatts(
            {name: old.getncattr(name) for name in how.shuffled(old.ncattrs())}
        )


def repack_xarray(path: Path, other: Path, how: Packing) -> None:
    """Copy a scenario file by xarray with other packing."""
    with xr.open_dataset(path) as old:
        loaded = old.load().drop_encoding()
    loaded = loaded[how.shuffled(loaded.data_vars)]
    loaded.attrs = {name: loaded.attrs[name] for name in how.shuffled(loaded.attrs)}
    packing = {
        "chunksizes": how.chunk,
        "zlib": how.level > 0,
        "complevel": how.level,
        "shuffle": how.shuffle,
    }
    encoding: dict[str, dict[str, Any]] = {
        str(name): {"_FillValue": None} for name in loaded.variables
    }
    for name in ("position", "velocity"):
        encoding[name] |= packing
    loaded.to_netcdf(other, engine="netcdf4", encoding=encoding)


REPACK = {"h5py": repack_h5py, "netcdf4": repack_netcdf4, "xarray": repack_xarray}
