"""Faults of particles, types and values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import netCDF4
import numpy as np
from fault_registry import DIMS, SHAPE, built, fault, positions, replace, simple, store
from numpy.typing import ArrayLike, NDArray
from submission_data import PARTICLES, Bench


@fault("particles", says="47")
def particle_missing(bench: Bench) -> Path:
    """One particle too few."""
    with built(bench, "particle_missing", particles=47) as (path, _):
        return path


@fault("particles", says="96")
def particles_doubled(bench: Bench) -> Path:
    """Twice as many particles."""
    with built(bench, "particles_doubled", particles=96) as (path, _):
        return path


def _typed(name: str, dtype: str) -> None:
    simple(
        "dtype",
        f"positions_{name}",
        lambda f: store(f, positions(f).astype(dtype)),
        says=name,
    )


for _name, _type in {
    "float64": "f8",
    "float16": "f2",
    "int32": "i4",
    "uint8": "u1",
}.items():
    _typed(_name, _type)
simple(
    "dtype",
    "positions_complex",
    lambda f: store(f, positions(f).astype("c8")),
    says="compound",
)
simple("dtype", "positions_bool", lambda f: store(f, positions(f) > 0.5), says="enum")
simple(
    "dtype",
    "positions_opaque",
    lambda f: store(f, np.zeros(SHAPE, "V4")),
    says="opaque",
)
simple(
    "dtype",
    "positions_text",
    lambda f: store(f, positions(f).astype("S8")),
    says="string",
)
_TEXT = h5py.string_dtype()
_RAGGED = h5py.vlen_dtype(np.float32)
simple(
    "dtype",
    "positions_vlen",
    lambda f: replace(f, "position", DIMS, shape=SHAPE, dtype=_RAGGED),
    says="length",
)
simple(
    "dtype",
    "positions_vlen_text",
    lambda f: replace(f, "position", DIMS, shape=SHAPE, dtype=_TEXT),
)
simple(
    "dtype",
    "positions_references",
    lambda f: replace(f, "position", DIMS, shape=SHAPE, dtype=h5py.ref_dtype),
)
simple(
    "dtype",
    "scale_factor",
    lambda f: f["position"].attrs.update(scale_factor=0.5),
    says="scale_factor",
)
simple(
    "dtype",
    "add_offset",
    lambda f: f["position"].attrs.update(add_offset=1.0),
    says="add_offset",
)


@fault("dtype", says="not IEEE")
def float_of_another_kind(bench: Bench) -> Path:
    """Four bytes with an exponent of another bias."""
    path = bench.copy("float_of_another_kind.nc")
    with h5py.File(path, "r+") as file:
        kind = h5py.h5t.IEEE_F32LE.copy()
        kind.set_ebias(100)
        del file["position"]
        h5py.h5d.create(file.id, b"position", kind, h5py.h5s.create_simple(SHAPE))
        for axis, dim in enumerate(DIMS):
            file["position"].dims[axis].attach_scale(file[dim])
    return path


# --- values ---------------------------------------------------------------------------


def _value(
    check: str, name: str, edit: Callable[[NDArray[np.float32]], ArrayLike], says: str
) -> None:
    simple(
        check,
        name,
        lambda f: store(f, np.asarray(edit(positions(f)), np.float32)),
        says=says,
    )


def _put(place: Any, value: float) -> Callable[[NDArray[np.float32]], ArrayLike]:
    def edit(values: NDArray[np.float32]) -> ArrayLike:
        values[place] = value
        return values

    return edit


def _permuted(values: NDArray[np.float32]) -> ArrayLike:
    return values[:, :, np.random.Generator(np.random.PCG64(1)).permutation(PARTICLES)]


_value(
    "finite",
    "one_nan",
    _put((1, 2, 3, 1), np.nan),
    "scenario 4, frame 5, particle 3, y",
)
_value(
    "finite",
    "one_infinity",
    _put((2, 7, 0, 0), np.inf),
    "scenario 5, frame 10, particle 0, x",
)
_value(
    "finite", "last_frames_nan", _put((slice(None), slice(5, None)), np.nan), "finite"
)
_value("finite", "all_nan", _put(..., np.nan), "finite")
_value("finite", "all_infinite", _put(..., -np.inf), "finite")
_value("start", "particles_permuted", _permuted, "another order")
_value("in_domain", "huge_values", lambda v: v + np.float32(1e30), "far beyond")
_value(
    "in_domain",
    "one_huge_value",
    _put((1, 2, 3, 1), 3e38),
    "scenario 4, frame 5, particle 3",
)
_value("in_domain", "eleven_boxes_away", _put((1, 2, 3, 0), -11.0), "far beyond")


def _marks(*marks: int, dim: str = "scenario") -> Callable[[h5py.File], object]:
    def change(file: h5py.File) -> None:
        if dim not in file:
            file.create_dataset(dim, data=np.arange(len(marks))).make_scale(dim)
        replace(file, "diverged_at", (dim,), np.array(marks, np.int32))

    return change


simple(
    "diverged_at",
    "marks_on_their_own_dimension",
    _marks(-1, -1, -1, dim="mark"),
    says="per scenario",
)
simple("diverged_at", "marks_too_few", _marks(-1, -1, dim="mark"), says="per scenario")
simple("diverged_at", "mark_beyond_the_horizon", _marks(-1, 100_000, -1), says="100000")
simple(
    "diverged_at", "mark_at_a_given_frame", _marks(2, -1, -1), says="no predicted frame"
)
simple("diverged_at", "mark_below_never", _marks(-1, -1, -5), says="-5")
simple(
    "diverged_at",
    "moves_after_its_mark",
    _marks(-1, 7, -1),
    says="scenario 4, frame 10",
)


@fault("finite", says="never written")
def frame_never_written(bench: Bench) -> Path:
    """What netCDF leaves where a frame was skipped while writing."""
    path = bench.folder / "frame_never_written.nc"
    with netCDF4.Dataset(bench.valid) as valid, built(bench, path.stem) as (_, file):
        file.renameVariable("position", "old")
        file.createVariable("position", "f4", DIMS)
        for frame in (0, 1, 2, 3, 5, 6, 7):
            file["position"][:, frame] = valid["position"][:, frame]
    return path
