"""Faulty prediction files by name: what makes each, and the check that names it."""

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
ALL = list(range(GIVEN, FRAMES))


@dataclass(frozen=True)
class Fault:
    """A way to be wrong."""

    make: Callable[[Bench], Path]  # writes the file and returns its path
    check: str  # that must name it
    exit_code: int  # that it must lead to


FAULTS: dict[str, Fault] = {}


def replace(
    file: h5py.File, name: str, dims: tuple[str, ...], data: Any = None, **options: Any
) -> h5py.Dataset:
    """Replace a variable by another of its name, with dimension scales attached."""
    if name in file:
        del file[name]
    dataset = file.create_dataset(name, data=data, **options)
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
) -> Iterator[tuple[Path, netCDF4.Dataset]]:
    """Yield a new file with other coordinates; all stands still in the middle."""
    path = bench.folder / f"{name}.nc"
    scenario_ids = np.array(scenarios, np.int64)
    frame_numbers = np.array(frames, np.int64)
    shape = (len(scenario_ids), len(frame_numbers), particles, 2)
    with netCDF4.Dataset(bench.valid) as valid, netCDF4.Dataset(path, "w") as file:
        for dim, length in zip(DIMS, shape, strict=True):
            file.createDimension(dim, length)
        file.createVariable("scenario", "i8", ("scenario",))[:] = scenario_ids
        file.createVariable("frame", "i8", ("frame",))[:] = frame_numbers
        position = file.createVariable("position", "f4", DIMS, zlib=True)
        position[:] = np.full(shape, 0.5, np.float32)
        attributes = {name: valid.getncattr(name) for name in valid.ncattrs()}
        file.setncatts(attributes)
        yield path, file


def rows(
    bench: Bench, name: str, scenarios: list[int], frames: list[int], pick: Any
) -> Path:
    """Write a selection of the valid positions under other coordinates."""
    with h5py.File(bench.valid) as valid:
        values = positions(valid)[pick]
    with built(bench, name, scenarios=scenarios, frames=frames) as (path, file):
        file["position"][:] = values
    return path


def fault(
    check: str, exit_code: int = 1
) -> Callable[[Callable[[Bench], Path]], Callable[[Bench], Path]]:
    """Register a function that makes a faulty file."""

    def register(make: Callable[[Bench], Path]) -> Callable[[Bench], Path]:
        FAULTS[make.__name__] = Fault(make, check, exit_code)
        return make

    return register


def register_changes(
    check: str, changes: dict[str, Callable[[h5py.File], object]], exit_code: int = 1
) -> None:
    """Register faults that change an open copy of the valid file."""
    for name, change in changes.items():

        def make(bench: Bench, name: str = name, change: Any = change) -> Path:
            path = bench.copy(f"{name}.nc")
            with h5py.File(path, "r+", libver="latest") as file:
                change(file)
            return path

        FAULTS[name] = Fault(make, check, exit_code)


# --- files ----------------------------------------------------------------------------


@fault("readable", 3)
def missing_file(bench: Bench) -> Path:
    """No such file."""
    return bench.folder / "nowhere.nc"


@fault("readable", 3)
def folder(bench: Bench) -> Path:
    """A folder of that name."""
    path = bench.folder / "folder.nc"
    path.mkdir(exist_ok=True)
    return path


@fault("readable", 3)
def netcdf3(bench: Bench) -> Path:
    """The format before HDF5."""
    path = bench.folder / "netcdf3.nc"
    with netCDF4.Dataset(path, "w", format="NETCDF3_CLASSIC") as file:
        file.split = "cavity"
    return path


@fault("readable", 3)
def chunk_damaged(bench: Bench) -> Path:
    """A compressed chunk with eight bytes overwritten."""
    path = bench.copy("chunk_damaged.nc")
    with h5py.File(path) as file:
        info = file["position"].id.get_chunk_info(7)
    data = bytearray(path.read_bytes())
    data[info.byte_offset : info.byte_offset + 8] = b"\xff" * 8
    path.write_bytes(data)
    return path


BYTES: dict[str, Callable[[bytes], bytes]] = {
    "empty_file": lambda _: b"",
    "text_renamed": lambda _: b"scenario,frame,x,y\n3,6,0.1,0.2\n",
    "truncated_half": lambda data: data[: len(data) // 2],
}

for _name, _content in BYTES.items():

    def _make(bench: Bench, name: str = _name, content: Any = _content) -> Path:
        path = bench.folder / f"{name}.nc"
        path.write_bytes(content(bench.valid.read_bytes()))
        return path

    FAULTS[_name] = Fault(_make, "readable", 3)


# --- format ---------------------------------------------------------------------------


def attribute(name: str, value: Any) -> Callable[[h5py.File], object]:
    """Return what sets a global attribute, or removes it where the value is None."""

    def change(file: h5py.File) -> None:
        if value is None:
            del file.attrs[name]
        else:
            file.attrs[name] = value

    return change


def _move(file: h5py.File) -> None:
    file.move("position", "positions")


def _replaced(value: Any) -> Callable[[h5py.File], object]:
    def change(file: h5py.File) -> None:
        del file["position"]
        file["position"] = value

    return change


def _external_storage(file: h5py.File) -> None:
    outside = [("/etc/passwd", 0, h5py.h5f.UNLIMITED)]
    replace(file, "position", DIMS, shape=SHAPE, dtype="f4", external=outside)


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout(SHAPE, "f4")
    layout[...] = h5py.VirtualSource("valid.nc", "position", SHAPE)
    del file["position"]
    file.create_virtual_dataset("position", layout)


def _many_frames(file: h5py.File) -> None:
    count = 1 << 31
    chunks = (1 << 16,)
    replace(file, "frame", (), shape=(count,), chunks=chunks, dtype="i4", compression=1)
    file["frame"].make_scale("frame")
    shape = (3, count, PARTICLES, 2)
    replace(file, "position", DIMS, shape=shape, chunks=(1, 9, *shape[2:]), dtype="f4")


LISTS = {
    "ids_as_text": np.array([b"3", b"4", b"5"]),
    "ids_as_floats": np.array([3.0, 4.0, 5.0]),
}

ATTRIBUTES: dict[str, tuple[str, Any]] = {
    "no_format_number": ("lagbench_format", None),
    "another_format_number": ("lagbench_format", 2),
    "method_with_escape_codes": ("method", "best\x1b[2Jmethod"),
    "method_is_a_number": ("method", 5),
    "seconds_nan": ("seconds_per_frame", np.nan),
    "seed_as_text": ("seed", "seven"),
    "budget_of_no_json": ("budget", "much"),
    "no_split": ("split", None),
}

register_changes(
    "format",
    {name: attribute(*changed) for name, changed in ATTRIBUTES.items()}
    | {
        name: lambda file, ids=ids: replace(file, "scenario", (), ids)
        for name, ids in LISTS.items()
    }
    | {
        "variable_misspelt": _move,
        "external_link": _replaced(h5py.ExternalLink("/etc/passwd", "/x")),
        "position_without_values": _replaced(h5py.Empty("f4")),
        "external_storage": _external_storage,
        "virtual_dataset": _virtual,
        "two_billion_frames": _many_frames,
        "two_billion_particles": lambda file: replace(
            *(file, "position", DIMS),
            shape=(3, 8, 1 << 31, 2),
            chunks=(1, 1, 1 << 22, 2),
            dtype="f4",
            compression=1,
        ),
    },
)


# --- task -----------------------------------------------------------------------------


def _transposed(*order: int) -> Callable[[h5py.File], object]:
    dims = tuple(DIMS[axis] for axis in order)
    return lambda file: replace(
        file, "position", dims, positions(file).transpose(order)
    )


register_changes(
    "split",
    {
        "unknown_split": attribute("split", "cavty"),
        "unknown_subset": attribute("subset", "shift"),
        "path_as_split": attribute("split", "../../etc"),
    },
)
register_changes(
    "dataset",
    {
        "stale_hash": attribute("dataset_sha256", "ab" * 32),
        "another_major_version": attribute("dataset_version", "3.0.0"),
        "version_in_words": attribute("dataset_version", "latest"),
    },
    exit_code=4,
)
register_changes(
    "dims",
    {
        "space_before_particle": _transposed(0, 1, 3, 2),
        "axes_swapped_names_kept": lambda file: store(
            file, positions(file).swapaxes(2, 3)
        ),
        "dimensions_without_names": lambda file: replace(
            file, "position", (), positions(file)
        ),
        "three_components": lambda file: store(file, np.zeros((*SHAPE[:3], 3), "f4")),
        "fewer_frames_than_numbers": lambda file: store(file, positions(file)[:, :5]),
    },
)
register_changes(
    "particles",
    {
        "wrong_split": attribute("split", "curl-noise"),
    },
)


@fault("particles")
def particle_missing(bench: Bench) -> Path:
    """One particle too few."""
    with built(bench, "particle_missing", particles=PARTICLES - 1) as (path, _):
        return path


ROWS: dict[str, tuple[str, list[int], list[int], Any]] = {
    "scenario_missing": ("scenarios", [3, 5], ALL, [0, 2]),
    "scenario_unknown": ("scenarios", [3, 4, 5, 77], ALL, [0, 1, 2, 0]),
    "scenario_twice": ("scenarios", [3, 4, 5, 4], ALL, [0, 1, 2, 1]),
    "scenario_enormous": ("scenarios", [3, 4, 1 << 62], ALL, ...),
    "input_frames_included": (
        *("frames", [3, 4, 5], [0, 1, 2, *ALL]),
        np.s_[:, [0] * 3 + [*range(8)]],
    ),
    "frames_counted_from_0": ("frames", [3, 4, 5], list(range(8)), ...),
    "frames_reversed": ("frames", [3, 4, 5], ALL[::-1], np.s_[:, ::-1]),
}

for _name, (_check, *_selection) in ROWS.items():

    def _make_rows(bench: Bench, name: str = _name, args: Any = _selection) -> Path:
        return rows(bench, name, *args)

    FAULTS[_name] = Fault(_make_rows, _check, 1)


# --- values ---------------------------------------------------------------------------

TYPES = ("f8", "i4", "S8")

register_changes(
    "dtype",
    {
        f"positions_{kind}": lambda file, kind=kind: store(
            file, positions(file).astype(kind)
        )
        for kind in TYPES
    }
    | {
        "positions_vlen": lambda file: replace(
            *(file, "position", DIMS), shape=SHAPE, dtype=h5py.vlen_dtype("f4")
        ),
        "scale_factor": lambda file: file["position"].attrs.update(scale_factor=0.5),
    },
)


def _put(place: Any, value: float) -> Callable[[h5py.File], object]:
    def change(file: h5py.File) -> None:
        values = positions(file)
        values[place] = value
        store(file, values)

    return change


def _permute(file: h5py.File) -> None:
    order = np.random.Generator(np.random.PCG64(1)).permutation(PARTICLES)
    store(file, positions(file)[:, :, order])


def _mark(*marks: int, dim: str = "scenario") -> Callable[[h5py.File], object]:
    def change(file: h5py.File) -> None:
        if dim not in file:
            file.create_dataset(dim, data=np.arange(len(marks))).make_scale(dim)
        replace(file, "diverged_at", (dim,), np.array(marks, np.int32))

    return change


register_changes(
    "finite",
    {
        "one_nan": _put((1, 2, 3, 1), np.nan),
        "one_infinity": _put((2, 7, 0, 0), np.inf),
        # what netCDF leaves where a frame was skipped while writing
        "frame_never_written": _put((slice(None), 4), netCDF4.default_fillvals["f4"]),
    },
)
register_changes("start", {"particles_permuted": _permute})
register_changes(
    "in_domain",
    {
        "one_huge_value": _put((1, 2, 3, 1), 3e38),
        "eleven_boxes_away": _put((1, 2, 3, 0), -11.0),
    },
)
register_changes(
    "diverged_at",
    {
        "marks_on_their_own_dimension": _mark(-1, -1, -1, dim="mark"),
        "mark_beyond_the_horizon": _mark(-1, 100_000, -1),
        "mark_at_a_given_frame": _mark(2, -1, -1),
        "moves_after_its_mark": _mark(-1, 7, -1),
    },
)
