"""Files of other programs as datasets with names, one short reader for each format.

A reader returns a :class:`Source` for each trajectory that a file or folder holds. Its
dataset has the names of its file; :mod:`.names` finds what they mean.
"""

from __future__ import annotations

import fnmatch
import io
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import numpy as np
import pandas as pd
import xarray as xr

from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    require,
)

from . import gns_npz, lagrangebench_h5

EXTRA = "formats"
"""Extra of the libraries that read these formats."""

AXES = ("frame", "particle", "space")
"""Order of the axes of arrays without names, where the user states no other."""

H5_POSITIONS = ("position", "*/position", "particles")
"""Where HDF5 files of LagrangeBench, NeuralMPM and others keep positions."""

TIMES = ("time", "times", "t")
"""Names of times, in the order of preference."""

STEPS = ("timestep", "step", "frame")
"""Names of numbers of steps, which say no time."""

IDS = ("id", "ids", "particle_id", "particleid", "idp", "global_id", "tag")
"""Names of the identity of particles."""

Frame = dict[str, Any]
"""Arrays of one frame by name, [particle, ...], and perhaps a number, time."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A trajectory that is read when it is opened."""

    name: str  # file, and the trajectory in it
    open: Callable[[], xr.Dataset]


@dataclass(frozen=True, kw_only=True)
class Reading:
    """How arrays without names are read."""

    axes: Sequence[str] = ()  # order of the axes; AXES where none are stated
    positions: str | None = None  # name of the positions, in HDF5 a path


@dataclass(frozen=True, kw_only=True)
class Listing:
    """What a file or folder holds."""

    sources: list[Source] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)  # files that are not read


def list_sources(path: Path, options: Reading) -> Listing:
    """Return the trajectories of a file, or of the files of a folder.

    A folder of files of one frame each (VTK, PLY, and tables or dumps that hold one
    frame) is one trajectory, in the natural order of their names.

    Raises:
        UnreadableFileError: nothing there can be read.
    """
    if not path.exists():
        raise UnreadableFileError(f"{path}: there is no such file; check the path")
    if path.is_file() or path.suffix == ".zarr":
        reader = _reader_of(path)
        if reader is None:
            raise UnreadableFileError(
                f"{path}: no format that is read; known are {', '.join(READERS)}"
            )
        with reading(str(path)):
            return Listing(sources=reader(path, options))

    files = []
    folders = []
    skipped = []
    for entry in sorted(path.iterdir(), key=natural_key):
        if entry.name.startswith(".") or entry.name == "metadata.json":
            continue
        if entry.is_dir() and entry.suffix != ".zarr":
            folders.append(entry)
        elif _reader_of(entry) is not None:
            files.append(entry)
        else:
            skipped.append(entry.name)
    collections = [file for file in files if file.suffix.lower() == ".pvd"]
    if collections:
        skipped += [file.name for file in files if file.suffix.lower() not in FRAMES]
        files = collections
    if files:
        skipped += [f"{folder.name}/" for folder in folders]
        if len(files) > 1 and all(map(_holds_one_frame, files)):
            return Listing(sources=[_series(path, files)], skipped=skipped)
        sources = []
        faults = []
        for file in files:
            try:
                sources += list_sources(file, options).sources
            except UnreadableFileError as error:
                faults.append(str(error).removeprefix(f"{path}/"))
        if faults:
            others = f"; not read are {', '.join(skipped)}" if skipped else ""
            raise UnreadableFileError(f"{path}: {', '.join(faults)}{others}")
        return Listing(sources=sources, skipped=skipped)

    sources = []
    for folder in folders:
        below = list_sources(folder, options)
        sources += below.sources
        skipped += [f"{folder.name}/{name}" for name in below.skipped]
    if not sources:
        raise UnreadableFileError(
            f"{path}: the folder holds no file that is read; known are "
            f"{', '.join(READERS)}"
        )
    return Listing(sources=sources, skipped=skipped)


@contextmanager
def reading(name: str) -> Iterator[None]:
    """Turn what damaged bytes raise, nearly any type, into an UnreadableFileError."""
    try:
        yield
    except LagbenchError:
        raise
    except Exception as error:
        raise UnreadableFileError(
            f"{name} cannot be read ({error}); write it again, or leave it out"
        ) from error


def natural_key(path: Path | str) -> list[tuple[int, str]]:
    """Return a key that sorts names with numbers in them by value: 2 before 10."""
    parts = []
    for part in re.split(r"(\d+)", str(path)):
        parts.append((int(part), part) if part.isdecimal() else (-1, part))
    return parts


def _reader_of(path: Path) -> Callable[[Path, Reading], list[Source]] | None:
    """Return the reader of a file by its suffix; that of dumps by the first line."""
    reader = READERS.get(path.suffix.lower())
    if reader is None and path.is_file():
        with path.open("rb") as stream:
            if stream.read(14) == b"ITEM: TIMESTEP":
                return READERS[".dump"]
    return reader


# --- arrays ---------------------------------------------------------------------------


def as_dataset(arrays: Mapping[str, Any], options: Reading) -> xr.Dataset:
    """Return a dataset of arrays, or variables, without named axes.

    The array of positions has the stated axes, others take theirs by their lengths.
    """
    known = ("position", "positions", "particles")
    name = options.positions or next((key for key in known if key in arrays), None)
    if name is None or name not in arrays:
        raise UnreadableFileError(
            f"no array is named position, but {', '.join(arrays) or 'none'}; name the "
            "one of the positions: --positions NAME"
        )
    shape = arrays[name].shape
    axes = tuple(options.axes)
    if not axes and len(shape) == len(AXES):
        axes = AXES
    if len(axes) != len(shape):
        raise UsageError(
            f"positions have {len(shape)} axes, of shape {shape}; state their order: "
            "--axes, as in trajectory,frame,particle,space"
        )
    lengths = dict(zip(axes, shape, strict=True))
    variables = {}
    for key, array in arrays.items():
        names = ["trajectory", "frame", "particle", "space"]
        if array.ndim == 1 and key.lower() not in (*TIMES, *STEPS):
            names = ["trajectory", "particle", "frame", "space"]
        dims: list[str] = []
        for length in array.shape:
            fitting = [one for one in names if lengths.get(one) == length]
            dims.append(fitting[0] if fitting else f"{key}_{len(dims)}")
            names = names[names.index(fitting[0]) + 1 :] if fitting else names
        if array.shape == shape:
            dims = list(axes)
        if isinstance(array, xr.Variable):
            variables[key] = array.copy(deep=False)
            variables[key].dims = dims
        else:
            variables[key] = xr.Variable(dims, array)
    return xr.Dataset(variables).rename({name: "position"})


def _split_trajectories(
    path: Path, open_dataset: Callable[[], xr.Dataset]
) -> list[Source]:
    """Return a source for each trajectory of a dataset."""
    with open_dataset() as dataset:
        dims = [dim for dim in ("trajectory", "run") if dim in dataset.dims]
        if not dims:
            return [Source(name=str(path), open=open_dataset)]
        count = dataset.sizes[dims[0]]

    def open_one(number: int) -> xr.Dataset:
        dataset = open_dataset()
        trajectory = dataset.isel({dims[0]: number})
        trajectory.set_close(dataset.close)
        return trajectory

    sources = []
    for number in range(count):
        name = f"{path}, trajectory {number}"
        sources.append(Source(name=name, open=partial(open_one, number)))
    return sources


def _read_numpy(path: Path, options: Reading) -> list[Source]:
    is_archive = path.suffix.lower() == ".npz"
    if is_archive and gns_npz.is_pickled(path):
        return [
            Source(name=f"{path}, {name}", open=open_dataset)
            for name, open_dataset in gns_npz.list_trajectories(path)
        ]

    def open_dataset() -> xr.Dataset:
        if not is_archive:
            array = np.load(path, mmap_mode="r")
            return as_dataset({"position": array}, Reading(axes=options.axes))
        with np.load(path) as file:
            return as_dataset({name: file[name] for name in file.files}, options)

    return _split_trajectories(path, open_dataset)


def _read_netcdf(path: Path, options: Reading) -> list[Source]:
    def open_dataset() -> xr.Dataset:
        engine = "zarr" if path.suffix == ".zarr" else None
        dataset = _open_in_chunks(path, engine=engine)
        if options.positions is not None:
            dataset = dataset.rename({options.positions: "position"})
        if options.axes and "position" in dataset:
            dims = zip(dataset["position"].dims, options.axes, strict=True)
            changed = {old: new for old, new in dims if old != new}
            dataset = dataset.rename(changed)
        return dataset

    return _split_trajectories(path, open_dataset)


def _open_in_chunks(path: Path, **options: Any) -> xr.Dataset:  # noqa: ANN401
    """Open a file whose numbers are read when needed, in chunks of some 100 MB."""
    # times stay numbers with units, which say how many seconds they are
    dataset = xr.open_dataset(path, decode_times=False, **options)
    for name, variable in dataset.data_vars.items():
        if variable.dtype.kind in "iuf":
            dataset[name] = variable.chunk("auto")
    return dataset


def _read_hdf5(path: Path, options: Reading) -> list[Source]:
    with h5py.File(path) as file:
        if "VTKHDF" in file:
            frames = partial(_vtkhdf_frames, path)
            return [Source(name=str(path), open=partial(_join, str(path), frames))]
        names: list[str] = []
        file.visit(names.append)
        arrays = [name for name in names if isinstance(file[name], h5py.Dataset)]
    patterns = H5_POSITIONS if options.positions is None else (options.positions,)
    for pattern in patterns:
        matches = fnmatch.filter(arrays, pattern.strip("/"))
        if matches:
            break
    else:
        raise UnreadableFileError(
            f"{path} holds {', '.join(arrays[:5]) or 'no array'}; say which are the "
            "positions: --positions GROUP/NAME, where * stands for any name"
        )
    sources = []
    for match in sorted(matches, key=natural_key):
        group, _, name = match.rpartition("/")
        open_dataset = partial(_open_group, path, group, name, options.axes)
        sources.append(Source(name=f"{path}, {match}", open=open_dataset))
    return sources


def _open_group(path: Path, group: str, name: str, axes: Sequence[str]) -> xr.Dataset:
    """Return the numbers in a group, which are read when they are needed."""
    file = _open_in_chunks(path, engine="h5netcdf", group=group, phony_dims="sort")
    arrays = {}
    for key, variable in file.variables.items():
        if variable.dtype.kind in "iuf":
            arrays[str(key)] = variable
    is_neural_mpm = name == "particles"
    boundary = arrays.pop("boundary", None) if is_neural_mpm else None
    dataset = as_dataset(arrays, Reading(axes=axes, positions=name))
    numbers = gns_npz.KINDS if is_neural_mpm else lagrangebench_h5.KINDS
    if is_neural_mpm or (path.parent / "metadata.json").is_file():
        dataset.attrs["kinds"] = {value: word for word, value in numbers.items()}
    dataset.attrs["boundary_particles"] = 0 if boundary is None else boundary.shape[-2]
    dataset.set_close(file.close)
    return dataset


# --- frames ---------------------------------------------------------------------------


def _join(name: str, read_frames: Callable[[], Iterator[Frame]]) -> xr.Dataset:
    """Return the dataset of frames, in which the particles must be the same."""
    columns: dict[str, list[Any]] = {}
    attributes: dict[str, Any] = {}
    count = 0
    frame_count = 0
    for number, frame in enumerate(read_frames()):
        attributes |= frame.pop("attributes", {})
        particles = max((len(one) for one in frame.values() if np.ndim(one)), default=0)
        if number == 0:
            count = particles
        if particles != count:
            raise DataError(
                f"{name}, frame {number}: {particles} particles, and {count} in "
                "the frames before: particles enter or leave, which no model or score "
                "of lagbench knows; cut the trajectory where their number changes, or "
                "keep the particles that are in all frames"
            )
        for key, values in frame.items():
            columns.setdefault(key, []).append(values)
        frame_count += 1
    variables: dict[str, Any] = {}
    for key, values in columns.items():
        if len(values) != frame_count or len({np.shape(one) for one in values}) > 1:
            continue  # not in all frames
        array = np.stack(values)
        dims = ("time", "particle", "space")[: array.ndim]
        if array.ndim == 3 and key not in ("position", "velocity"):
            dims = ("time", "particle", key)
        variables[key] = (dims, array)
    return xr.Dataset(variables, attrs=attributes)


def _series(folder: Path, files: Sequence[Path]) -> Source:
    """Return the trajectory of files that hold a frame each."""
    stems = {re.sub(r"\d+", "", file.stem) for file in files}
    kinds = {file.suffix.lower() for file in files}
    if len(stems) > 1 or len(kinds) > 1:
        names = ", ".join(sorted(stems | kinds)[:5])
        raise UsageError(
            f"{folder}: the files of frames belong to several series ({names}); put "
            "each trajectory into a folder of its own, and join files of one frame"
        )

    def frames() -> Iterator[Frame]:
        for file in files:
            yield from FRAMES[file.suffix.lower()](file)

    name = f"{folder} ({len(files)} files, each taken for a frame)"
    return Source(name=name, open=partial(_join, name, frames))


def _holds_one_frame(path: Path) -> bool:
    """Return whether a file holds a single frame."""
    suffix = path.suffix.lower()
    if suffix in (".vtk", ".vtu", ".vtp", ".ply"):
        return True
    read = FRAMES.get(suffix)
    return read is not None and len(list(islice(read(path), 2))) == 1


def _read_frames(path: Path, options: Reading) -> list[Source]:
    read = FRAMES.get(path.suffix.lower(), _lammps_frames)
    return [Source(name=str(path), open=partial(_join, str(path), partial(read, path)))]


def _vtk_frames(path: Path) -> Iterator[Frame]:
    yield _frame_of_mesh(require("pyvista", extra=EXTRA).read(path))


def _vtkhdf_frames(path: Path) -> Iterator[Frame]:
    file = require("pyvista", extra=EXTRA).HDFReader(path)
    for step in range(max(1, file.reader.GetNumberOfSteps())):
        file.reader.SetStep(step)
        frame = _frame_of_mesh(file.read())
        if file.reader.GetHasTemporalData():
            frame["time"] = file.reader.GetTimeValue()
        yield frame


def _frame_of_mesh(mesh: Any) -> Frame:  # noqa: ANN401 (pyvista is optional)
    frame: Frame = {"position": np.asarray(mesh.points)}
    for name in mesh.point_data.keys():  # noqa: SIM118 (no mapping)
        frame[name] = np.asarray(mesh.point_data[name])
    for name in ("TimeValue", "TIME", "time"):
        if name in mesh.field_data:
            frame["time"] = float(mesh.field_data[name][0])
    return frame


def _ply_frames(path: Path) -> Iterator[Frame]:
    mesh = require("meshio", extra=EXTRA).read(path)
    yield {"position": mesh.points, **mesh.point_data}


def _pvd_frames(path: Path) -> Iterator[Frame]:
    """Yield the files that a collection of ParaView lists, with their times."""
    for entry in ElementTree.parse(path).iter("DataSet"):
        for frame in _vtk_frames(path.parent / entry.attrib["file"]):
            yield {**frame, "time": float(entry.attrib["timestep"])}


def _table_frames(path: Path) -> Iterator[Frame]:
    """Yield the frames of a table with a row for each particle and time."""
    if path.suffix.lower() == ".parquet":
        require("pyarrow", extra=EXTRA)
        table = pd.read_parquet(path)
    else:
        table = pd.read_csv(path, skipinitialspace=True)
    table.columns = table.columns.astype(str).str.strip()
    names = {name.lower(): name for name in table.columns}
    time = next((names[word] for word in (*TIMES, *STEPS) if word in names), None)
    particle = next((names[word] for word in IDS if word in names), None)
    if particle is not None:
        keys = [key for key in (time, particle) if key is not None]
        double = table.loc[table.duplicated(keys), keys]
        if len(double):
            row = " and ".join(f"{key} {double[key].iloc[0]}" for key in keys)
            way_out = "keep one of them"
            if time is None:
                way_out += "; a table of several frames needs a column time"
            raise DataError(f"{path}: two rows have {row}; {way_out}")
    if time is None:
        yield _columns_of(table)
        return
    for value, rows in table.groupby(time, sort=False):
        yield {**_columns_of(rows), time: value}


def _columns_of(table: pd.DataFrame) -> Frame:
    return {name: table[name].to_numpy() for name in table.columns}


def _lammps_frames(path: Path) -> Iterator[Frame]:
    """Yield the frames of a text dump of LAMMPS, with its box."""
    frame: Frame = {}
    count = 0
    with path.open() as stream:
        for line in stream:
            if line.startswith("ITEM: TIMESTEP"):
                frame = {"time": int(next(stream))}
            elif line.startswith("ITEM: TIME"):
                frame["time"] = float(next(stream))
            elif line.startswith("ITEM: NUMBER OF ATOMS"):
                count = int(next(stream))
            elif line.startswith("ITEM: BOX BOUNDS"):
                if "xy" in line:
                    raise UnreadableFileError(f"{path}: the box is tilted; turn it")
                ends = [next(stream).split()[:2] for _ in "xyz"]
                bounds = np.array(ends, float)
                flags = zip("xyz", line.split()[3:], strict=False)
                periodic = [axis for axis, flag in flags if flag == "pp"]
                frame["attributes"] = {"bounds": bounds, "periodic": periodic}
            elif line.startswith("ITEM: ATOMS"):
                text = io.StringIO("".join(islice(stream, count)))
                table = pd.read_csv(text, sep=r"\s+", names=line.split()[2:])
                for axis, (low, high) in zip("xyz", bounds, strict=True):
                    for scaled in (f"{axis}s", f"{axis}su"):
                        if scaled in table:
                            table[axis] = low + (high - low) * table.pop(scaled)
                    if f"{axis}u" in table:
                        table[axis] = table.pop(f"{axis}u")
                yield {**frame, **_columns_of(table)}


def _xyz_frames(path: Path) -> Iterator[Frame]:
    """Yield the frames of an extended XYZ file, with its cell."""
    require("ase", extra=EXTRA)
    for atoms in require("ase.io", extra=EXTRA).iread(path, format="extxyz"):
        frame = dict(atoms.arrays)
        frame["position"] = frame.pop("positions")
        numbers = frame.pop("numbers")
        if not {"type", "material", "particle_type"} & set(frame):
            frame["type"] = numbers
        for name, value in atoms.info.items():
            if name.lower() == "time":
                frame["time"] = float(value)
        lengths = atoms.cell.lengths()
        if lengths.all() and np.allclose(np.diag(lengths), atoms.cell[:]):
            flags = zip("xyz", atoms.pbc, strict=True)
            frame["attributes"] = {
                "bounds": [(0.0, length) for length in lengths],
                "periodic": [axis for axis, is_periodic in flags if is_periodic],
            }
        yield frame


FRAMES: dict[str, Callable[[Path], Iterator[Frame]]] = {
    ".vtk": _vtk_frames,
    ".vtu": _vtk_frames,
    ".vtp": _vtk_frames,
    ".pvd": _pvd_frames,
    ".vtkhdf": _vtkhdf_frames,
    ".ply": _ply_frames,
    ".csv": _table_frames,
    ".parquet": _table_frames,
    ".dump": _lammps_frames,
    ".lammpstrj": _lammps_frames,
    ".xyz": _xyz_frames,
    ".extxyz": _xyz_frames,
}
"""Readers of the frames of a file, by its suffix."""

READERS: dict[str, Callable[[Path, Reading], list[Source]]] = {
    ".npy": _read_numpy,
    ".npz": _read_numpy,
    ".nc": _read_netcdf,
    ".zarr": _read_netcdf,
    ".h5": _read_hdf5,
    ".hdf5": _read_hdf5,
    ".hdf": _read_hdf5,
    **dict.fromkeys(FRAMES, _read_frames),
}
"""Readers of the trajectories of a file, by its suffix."""


def read_metadata(folder: Path) -> dict[str, Any]:
    """Return what a metadata.json of GNS programs or LagrangeBench says, by our names.

    Raises:
        UnreadableFileError: it is no JSON object.
    """
    path = folder / "metadata.json"
    if not path.is_file():
        return {}
    try:
        values = json.loads(path.read_bytes())
        block = values.get("train")  # newer GNS programs keep one for each purpose
        values = block if isinstance(block, dict) else values
        stated: dict[str, Any] = {
            "bounds": values.get("bounds"),
            "radius": values.get("default_connectivity_radius"),
            "spacing": values.get("dx"),
        }
        if values.get("dt"):
            stated["frame_interval"] = values["dt"] * values.get("write_every", 1)
        flags = values.get("periodic_boundary_conditions") or ()
        axes = zip("xyz", flags, strict=False)
        stated["periodic"] = [axis for axis, is_periodic in axes if is_periodic]
        return {name: value for name, value in stated.items() if value is not None}
    except (ValueError, AttributeError, TypeError) as error:
        raise UnreadableFileError(
            f"{path} cannot be read ({error}); fetch or correct it"
        ) from error
