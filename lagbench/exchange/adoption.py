"""Trajectories from elsewhere in, a hashed local split out: a user's own, or another code base's."""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, Unpack

import numpy as np
from numpy.typing import NDArray

from lagbench.data.checksums import HASHED_SUBSETS, file_sha256
from lagbench.data.hdf5 import Structure, check_structure, opened
from lagbench.data.registry import MAX_ID
from lagbench.data.scenario import MATERIALS
from lagbench.errors import DataError, LagbenchError, UnreadableFileError, UsageError
from lagbench.work.progress import Progress

from . import gns_npz, lagrangebench_h5
from .exporting import ENDINGS
from .local_split import LocalSplit, make_local_split, output_name
from .metadata import DROP, Format, Source, parse_format, read_source
from .mistakes import check_meaning
from .trajectory import Description, Frame, Trajectory, Wishes, check_array, check_inflation

READABLE = (".npy", ".npz", ".nc")  # files that are adopted: an array, named arrays, netCDF
ARRAYS = POSITION, VELOCITY, MATERIAL, WALLS = "position", "velocity", "material", "wall_velocity"
CLASSIC = b"CDF"
"""First bytes of the older netCDF formats, which cannot point to other files."""

NETCDF = Structure(groups=None, texts=True, cache=1 << 30)
"""What may be in a netCDF-4 file; chunks by default span many frames, so that more of them stay unpacked."""

Read = Callable[[str], NDArray[Any]]


def adopt(
    sources: str | Path | Sequence[str | Path],
    *,
    output: str | Path,
    valid: int | None = None,
    test: int | None = None,
    as_is: bool = False,
    progress: Callable[[Progress], None] | None = None,
    **wishes: Unpack[Wishes],
) -> LocalSplit:
    """Make a local split of trajectories in .npy, .npz or netCDF files.

    A .npy file holds positions [frame, particle, 2], or several trajectories [trajectory, frame,
    particle, 2]; .npz and netCDF files hold ``position`` and, if they like, ``velocity`` of the
    same shape, ``material`` [particle] (0 liquid, 1 jelly, 2 snow, 3 rope; liquid when absent)
    and ``wall_velocity`` [4, 2] or [frame, 4, 2] (left, right, bottom, top). Nothing is unpickled.

    Args:
        sources: a folder with subfolders ``train``, ``valid`` and ``test``; or files, or a
            folder of files, which are sorted by name and of which the last are taken for
            test, those before for valid.
        output: folder to make; its last part is the name of the split.
        valid: trajectories for valid; a tenth, at least one, when None.
        test: trajectories for test; a tenth, at least one, when None.
        as_is: whether to take arrays that look transposed, and velocities of another frame, axis or unit.
        progress: called as the work advances.
        **wishes: ``radius`` and ``frame_interval``, which must be given, and what else is known,
            see :class:`lagbench.exchange.trajectory.Description`.

    Raises:
        UsageError: no radius or frame interval, too few trajectories, a folder that is there, a
            task that does not fit the data.
        UnreadableFileError: a file is damaged, pickled, or holds no positions.
        DataError: positions are not plane, not finite, or outside the unit box; another reading explains
            the axes or the velocities far better.
        WorkFailedError: the disk is full or not writable.
    """
    for name in ("radius", "frame_interval"):
        if wishes.get(name) is None:
            raise UsageError(f"the {name.replace('_', ' ')} is not known", fix=f"--{name.replace('_', '-')}")
    given = [Path(sources)] if isinstance(sources, str | Path) else [Path(source) for source in sources]
    files = _by_subset(given, valid=valid, test=test)
    counts = {subset: len(rows) for subset, rows in files.items()}
    source = f"{sum(counts.values())} trajectories of the user's own"
    about = Description(name=output_name(output), source=source, **wishes)
    interval = None if as_is else about.frame_interval
    subsets = {subset: (_open(path, row, interval) for path, row in rows) for subset, rows in files.items()}
    return make_local_split(about, subsets, output, command="adopt", counts=counts, progress=progress)


def import_split(
    source: str | Path,
    *,
    format: str,
    output: str | Path,
    allow_pickle: bool = False,
    kinds: Mapping[int, str] | None = None,
    progress: Callable[[Progress], None] | None = None,
    **wishes: Unpack[Wishes],
) -> LocalSplit:
    """Make a local split of train, valid and test in another code base's format.

    Positions are taken over as they are, as float32; velocities are their differences over the
    frame interval. A ``force.py`` beside the data is left alone.

    Args:
        source: folder of the three files and metadata.json.
        format: "gns-npz" or "lagrangebench-h5".
        output: folder to make; its last part is the name of the split.
        allow_pickle: whether arrays that are stored as pickled objects (all of gns-npz) may be
            rebuilt; whatever else a pickle calls is refused even then.
        kinds: number of a kind of particles to the material that it stands for, or to "drop".
        progress: called as the work advances.
        **wishes: what shall hold instead of what the metadata say, see
            :class:`lagbench.exchange.trajectory.Description`.

    Raises:
        UsageError: unknown format, pickled objects that may not be rebuilt, a folder that is
            there, a task that does not fit the data.
        UnreadableFileError: a file is missing, damaged or laid out otherwise, or holds particles
            of a kind that no material is known for.
        DataError: positions are not plane, not finite, outside the unit box, or cross a
            periodic one.
        WorkFailedError: the disk is full or not writable.
    """
    form, folder = parse_format(format), Path(source)
    files = {subset: folder / f"{subset}{ENDINGS[form]}" for subset in HASHED_SUBSETS}
    missing = [path.name for path in files.values() if not path.is_file()]
    if missing:
        there = (
            f"the folder holds {HASHED_SUBSETS[0]}{ending}: --format {other.value}"
            for other, ending in ENDINGS.items()
            if all((folder / f"{subset}{ending}").is_file() for subset in HASHED_SUBSETS)
        )
        raise UnreadableFileError(
            "files are missing",
            where=str(folder),
            expected=", ".join(p.name for p in files.values()),
            got=f"no {', no '.join(missing)}",
            fix=next(there, None),
        )
    if form is Format.GNS_NPZ and not allow_pickle:
        next(gns_npz.trajectories(files["train"], allow_pickle=False, kinds={}))
    stated = read_source(folder, form)
    hints = stated.hints
    if wishes.keys() & {"input_frames", "horizon"}:  # the frames belong to the exported task
        hints = hints.model_copy(update={"frames_of_interest": None})
    # What the metadata say, over it what our own exports add, over both what the user says.
    facts: dict[str, Any] = {
        "radius": stated.radius,
        "frame_interval": stated.frame_interval,
        "bounds": hints.bounds or stated.bounds,
        "spacing": hints.spacing or stated.spacing,
        "density": hints.density,
        "input_frames": hints.input_frames,
        "horizon": hints.horizon,
        "frames_of_interest": hints.frames_of_interest,
        "cells": hints.cells,
        "full_box": hints.placement == "cell_centres",
        **wishes,
    }
    if facts["frame_interval"] is None:
        raise UsageError("the metadata state no time between frames", fix="say it: --frame-interval SECONDS")
    about = Description(
        name=output_name(output),
        source=f"{form.value}: " + ", ".join(f"{p.name} {file_sha256(p)[:16]}" for p in files.values()),
        **{name: value for name, value in facts.items() if value is not None},
    )
    walls = dict.fromkeys(stated.hints.wall_particle_type, DROP)
    given = {**walls, **(kinds or {})}

    def read(path: Path) -> Iterator[Trajectory]:
        if form is Format.GNS_NPZ:
            return gns_npz.trajectories(path, allow_pickle=allow_pickle, kinds=given)
        found = lagrangebench_h5.trajectories(path, kinds=given, origin=stated.hints.origin)
        return (_unbroken(trajectory, stated) for trajectory in found)

    subsets = {subset: read(path) for subset, path in files.items()}
    return make_local_split(about, subsets, output, command="import", progress=progress)


Row = tuple[Path, int | None]
"""A file and, where it holds several, the number of the trajectory in it."""


def _by_subset(given: Sequence[Path], *, valid: int | None, test: int | None) -> Mapping[str, list[Row]]:
    """Return the trajectories of each subset."""
    if len(given) == 1 and (given[0] / HASHED_SUBSETS[0]).is_dir():
        if valid is not None or test is not None:
            raise UsageError("the folders say what is valid and test", where="--valid and --test")
        return {subset: _rows(given[0] / subset) for subset in HASHED_SUBSETS}
    # A shell lists run10 before run2; an order that is not the shell's is the user's own.
    in_order = _natural(given) if list(given) == sorted(given) else given
    rows = [row for path in in_order for row in _rows(path)]
    tenth = max(1, len(rows) // 10)
    for_valid, for_test = (tenth if n is None else n for n in (valid, test))
    for_train = len(rows) - for_valid - for_test
    if min(for_train, for_valid, for_test) < 1:
        raise UsageError(
            "each subset needs a trajectory",
            where="--valid and --test",
            expected="at least one each, and one left for train",
            got=f"{len(rows)} trajectories, {for_valid} for valid, {for_test} for test",
        )
    return {
        "train": rows[:for_train],
        "valid": rows[for_train : for_train + for_valid],
        "test": rows[for_train + for_valid :],
    }


def _natural(paths: Sequence[Path]) -> list[Path]:
    """Return paths in the order of their names, numbers in them by value."""

    def key(path: Path) -> tuple[list[tuple[int, str]], str]:
        parts = re.split(r"(\d+)", str(path))
        return [(int(part) if part.isdecimal() else -1, part) for part in parts], str(path)

    return sorted(paths, key=key)


def _rows(path: Path) -> list[Row]:
    """Return the trajectories of a file, or of the files of a folder by name."""
    if path.is_dir():
        found = _natural([file for file in path.iterdir() if file.suffix in READABLE and file.is_file()])
        if found:
            return [row for file in found for row in _rows(file)]
    if path.suffix not in READABLE or not path.is_file():
        raise UnreadableFileError(
            "no trajectories are there",
            where=str(path),
            expected=f"a file {', '.join(READABLE)}, or a folder of them",
            got="a folder without such files" if path.is_dir() else None,
        )
    if path.suffix != ".npy":
        return [(path, None)]
    shape = _array(path).shape
    if len(shape) != 4:
        return [(path, None)]
    if shape[0] > MAX_ID + 1:
        raise DataError(
            "too many trajectories", where=str(path), expected=f"at most {MAX_ID + 1}", got=shape[0]
        )
    return [(path, row) for row in range(shape[0])]


def _open(path: Path, row: int | None, interval: float | None) -> Trajectory:
    """Return a trajectory whose arrays are read frame by frame where the file allows it.

    What they mean is looked at where the time between frames is given.
    """
    if path.suffix == ".npy":
        array = _array(path)
        name = str(path) if row is None else f"{path}, trajectory {row}"
        held = {POSITION: array if row is None else array[row]}
        return _trajectory(name, held, lambda: _frames(held), interval)
    if path.suffix == ".npz":
        with _reading(path):
            with zipfile.ZipFile(path) as archive:
                for member in archive.infolist():
                    name = f"{path}, {member.filename}"
                    check_inflation(name, packed=member.compress_size, unpacked=member.file_size)
                    if member.filename.removesuffix(".npy") in ARRAYS:
                        with archive.open(member) as stream:
                            _check_header(name, stream, member.file_size)
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: file[name] for name in ARRAYS if name in file}
        return _trajectory(str(path), arrays, lambda: _frames(arrays), interval)
    return _netcdf(path, interval)


def _frames(arrays: Mapping[str, Any]) -> Iterator[Frame]:
    """Yield the frames of arrays, in memory or mapped or in a file, of shape [frame, particle, 2]."""
    velocity = arrays.get(VELOCITY)
    for number in range(arrays[POSITION].shape[0]):
        frame = np.asarray(arrays[POSITION][number])
        yield frame, None if velocity is None else np.asarray(velocity[number])


def _trajectory(
    name: str, arrays: Mapping[str, Any], read: Callable[[], Iterator[Frame]], interval: float | None
) -> Trajectory:
    """Return the trajectory of named arrays after a look at their shapes and, given an interval, meaning."""
    if POSITION not in arrays:
        raise UnreadableFileError(
            "there are no positions", where=name, expected=f"an array {POSITION!r}", got=", ".join(arrays)
        )
    shape = tuple(arrays[POSITION].shape)
    check_array(name, shape, _dtype(arrays[POSITION]))
    frames, particles = shape[:2]
    if VELOCITY in arrays:
        _check_numbers(f"{name}, {VELOCITY}", arrays[VELOCITY], "velocities", shape)
    material = np.zeros(particles, np.int8)
    if MATERIAL in arrays:
        what = "materials: " + ", ".join(f"{i} {m}" for i, m in enumerate(MATERIALS))
        _check_numbers(f"{name}, {MATERIAL}", arrays[MATERIAL], what, (particles,), kinds="iu")
        material = np.asarray(arrays[MATERIAL][...])
        if not np.isin(material, range(len(MATERIALS))).all():
            raise DataError(f"these are no {what}", where=f"{name}, {MATERIAL}")
    walls = None
    if WALLS in arrays:
        where = f"{name}, {WALLS}"
        _check_numbers(where, arrays[WALLS], "walls", (4, 2), (frames, 4, 2))
        walls = np.asarray(arrays[WALLS][...], np.float64)
        with np.errstate(over="ignore"):  # they are stored as float32
            if not np.isfinite(walls.astype(np.float32)).all():
                raise DataError("a velocity of a wall is not finite", where=where)
    if interval is not None:
        check_meaning(name, arrays[POSITION], arrays.get(VELOCITY), interval)
    return Trajectory(
        name=name, frames=frames, material=material.astype(np.int8), read=read, wall_velocity=walls
    )


def _check_numbers(
    where: str,
    array: Any,  # noqa: ANN401 (arrays, also netCDF's)
    what: str,
    *shapes: tuple[int, ...],
    kinds: str = "iuf",
) -> None:
    """Refuse an array of another shape or other kinds of values, by what its file declares."""
    if tuple(array.shape) not in shapes or _dtype(array).kind not in kinds:
        raise DataError(
            f"these are no {what}",
            where=where,
            expected=("integers" if kinds == "iu" else "real numbers")
            + f" of shape {' or '.join(map(str, shapes))}",
            got=f"{_dtype(array)} of shape {tuple(array.shape)}",
        )


def _dtype(array: Any) -> np.dtype[Any]:  # noqa: ANN401
    """Return the type of values; netCDF has types of its own for texts and lists, here objects."""
    stored = getattr(array, "datatype", array.dtype)
    return stored if isinstance(stored, np.dtype) else np.dtype(object)


def _array(path: Path) -> NDArray[Any]:
    """Return the mapped array of a .npy file."""
    with _reading(path):
        with path.open("rb") as stream:
            _check_header(str(path), stream, path.stat().st_size)
        array: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
    return array


def _check_header(name: str, stream: IO[bytes], length: int) -> None:
    """Refuse objects, and more values than a .npy stream of some length [bytes] can hold.

    NumPy reserves memory for what the header claims before it reads.
    """
    shape, _, dtype = gns_npz.read_header(stream)
    if dtype.hasobject:
        raise UnreadableFileError(
            "the file holds pickled objects",
            where=name,
            expected="arrays of numbers",
            fix="lagbench import --format gns-npz reads trajectories of GNS code bases",
        )
    held = length - stream.tell()
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > held:
        raise UnreadableFileError(
            "the array claims more than the file holds",
            where=name,
            expected=f"{held} bytes",
            got=f"{dtype} of shape {shape}",
        )


def _netcdf(path: Path, interval: float | None) -> Trajectory:
    import netCDF4

    with _reading(path):
        with path.open("rb") as stream:
            classic = stream.read(len(CLASSIC)) == CLASSIC
        if not classic:  # netCDF would follow links and read other files
            with opened(path) as held:
                check_structure(held, path, NETCDF)
        file = netCDF4.Dataset(path, "r")
        file.set_auto_maskandscale(False)
        arrays = {name: file.variables[name] for name in ARRAYS if name in file.variables}
        # Values that stand for others are refused: they are read as they are stored.
        for name, stored in arrays.items():
            packed = {"scale_factor", "add_offset"} & set(stored.ncattrs())
            if packed and name != MATERIAL:
                raise UnreadableFileError(
                    "the values are packed",
                    where=f"{path}, {name}, {', '.join(sorted(packed))}",
                    expected="positions as they are, float32 or float64",
                    fix="write them again without scale_factor and add_offset",
                )

    def read() -> Iterator[Frame]:
        with _reading(path):
            yield from _frames(arrays)

    with _reading(path):
        return _trajectory(str(path), arrays, read, interval)


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn what damaged bytes raise, which is nearly any type, into an UnreadableFileError."""
    try:
        yield
    except LagbenchError:
        raise
    except Exception as error:
        raise UnreadableFileError(
            "cannot read the file",
            where=str(path),
            expected="arrays of numbers",
            got=f"{type(error).__name__}: {error}",
        ) from error


def _unbroken(trajectory: Trajectory, stated: Source) -> Trajectory:
    """Return a trajectory that raises where particles cross a periodic boundary."""
    if not any(stated.periodic):
        return trajectory
    sides = np.array([high - low for low, high in stated.bounds])
    half = np.where(stated.periodic, sides / 2.0, np.inf)

    def read() -> Iterator[Frame]:
        before: NDArray[np.floating] | None = None
        for number, (position, velocity) in enumerate(trajectory.read()):
            if before is not None and (np.abs(position - before) > half).any():
                raise DataError(
                    "particles cross a periodic boundary",
                    where=f"{trajectory.name}, frame {number}",
                    expected="positions that move on: velocities are their differences",
                    got="a jump of more than half the box",
                    fix="lagbench has no periodic boxes: leave such data out",
                )
            before = position
            yield position, velocity

    return replace(trajectory, read=read)
