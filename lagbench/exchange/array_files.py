"""Trajectories in arrays of one's own: .npy, .npz and netCDF files, read frame by frame
where they allow it.

The files come from strangers: nothing is unpickled, no link is followed, and no more
memory is taken than their bytes can fill.
"""

from __future__ import annotations

import math
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS
from lagbench.data.hdf5 import open_hdf5
from lagbench.data.registry import MAX_ID
from lagbench.data.structure import Structure, check_structure
from lagbench.errors import DataError, LagbenchError, UnreadableFileError

from .mistakes import check_meaning
from .trajectory import Frame, Trajectory, check_array, check_inflation, read_header

# files that are adopted: an array, named arrays, netCDF
READABLE = ".npy", ".npz", ".nc"
ARRAYS = POSITION, VELOCITY, MATERIAL, WALLS = (
    "position",
    "velocity",
    "material",
    "wall_velocity",
)
# first bytes of the older netCDF formats, which cannot point to other files
CLASSIC = b"CDF"

# What may be in a netCDF-4 file; chunks by default span many frames, so that more of
# them stay unpacked.
NETCDF = Structure(groups=None, texts=True, cache=1 << 30)
# a file and, where it holds several, the number of the trajectory in it
Row = tuple[Path, int | None]


def natural(paths: Sequence[Path]) -> list[Path]:
    """Return paths in the order of their names, numbers in them by value."""

    def key(path: Path) -> tuple[list[tuple[int, str]], str]:
        parts = re.split(r"(\d+)", str(path))
        return [(int(part) if part.isdecimal() else -1, part) for part in parts], str(
            path
        )

    return sorted(paths, key=key)


def rows_of(path: Path) -> list[Row]:
    """Return the trajectories of a file, or of the files of a folder by name."""
    if path.is_dir():
        found = natural(
            [
                file
                for file in path.iterdir()
                if file.suffix in READABLE and file.is_file()
            ]
        )
        if found:
            return [row for file in found for row in rows_of(file)]
    if path.suffix not in READABLE or not path.is_file():
        raise UnreadableFileError(
            "no trajectories are there",
            where=str(path),
            expected=f"a file {', '.join(READABLE)}, or a folder of them",
            got="a folder without such files" if path.is_dir() else None,
        )
    if path.stat().st_size == 0:
        raise UnreadableFileError(
            "the file is empty", where=str(path), expected="a trajectory"
        )
    if path.suffix != ".npy" or len(shape := _array(path).shape) != 4:
        return [(path, None)]
    if shape[0] > MAX_ID + 1:
        expected = f"at most {MAX_ID + 1}"
        raise DataError(
            "too many trajectories", where=str(path), expected=expected, got=shape[0]
        )
    return [(path, row) for row in range(shape[0])]


def open_row(which: Row, interval: float | None) -> Trajectory:
    """Return a trajectory; what its arrays mean is looked at where the time between
    frames is given [s].
    """
    path, row = which
    if row is None:
        name = str(path)
    else:
        name = f"{path}, trajectory {row}"
    with _reading(path):
        if path.suffix == ".npy":
            array = _array(path)
            arrays = {POSITION: array if row is None else array[row]}
        else:
            if path.suffix == ".npz":
                arrays = _npz(path)
            else:
                arrays = _netcdf(path)
        return _trajectory(path, name, arrays, interval)


def _trajectory(
    path: Path, name: str, arrays: Mapping[str, Any], interval: float | None
) -> Trajectory:
    """Return the trajectory of named arrays after a look at their shapes and, given an
    interval, meaning.
    """
    if POSITION not in arrays:
        raise UnreadableFileError(
            "there are no positions",
            where=name,
            expected=f"an array {POSITION!r}",
            got=", ".join(arrays) or f"none of {', '.join(ARRAYS)}",
        )
    shape = tuple(arrays[POSITION].shape)
    check_array(name, shape, _dtype(arrays[POSITION]))
    frames, particles = shape[:2]
    if VELOCITY in arrays:
        _check_numbers(f"{name}, {VELOCITY}", arrays[VELOCITY], "velocities", shape)
    material = np.zeros(particles, np.int8)
    if MATERIAL in arrays:
        what = "materials: " + ", ".join(f"{i} {m}" for i, m in enumerate(MATERIALS))
        _check_numbers(
            f"{name}, {MATERIAL}", arrays[MATERIAL], what, (particles,), kinds="iu"
        )
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

    def read() -> Iterator[Frame]:
        velocity = arrays.get(VELOCITY)
        with _reading(path):
            for number in range(frames):
                frame = np.asarray(arrays[POSITION][number])
                yield frame, None if velocity is None else np.asarray(velocity[number])

    return Trajectory(
        name=name,
        frames=frames,
        material=material.astype(np.int8),
        read=read,
        wall_velocity=walls,
    )


def _check_numbers(
    where: str,
    array: Any,  # noqa: ANN401 (arrays, also netCDF's)
    what: str,
    *shapes: tuple[int, ...],
    kinds: str = "iuf",
) -> None:
    """Refuse an array of another shape or other kinds of values, by what its file
    declares.
    """
    if tuple(array.shape) not in shapes or _dtype(array).kind not in kinds:
        raise DataError(
            f"these are no {what}",
            where=where,
            expected=("integers" if kinds == "iu" else "real numbers")
            + f" of shape {' or '.join(map(str, shapes))}",
            got=f"{_dtype(array)} of shape {tuple(array.shape)}",
        )


def _dtype(array: Any) -> np.dtype[Any]:  # noqa: ANN401
    """Return the type of values; netCDF has types of its own for texts and lists, here
    objects.
    """
    stored = getattr(array, "datatype", array.dtype)
    if isinstance(stored, np.dtype):
        return stored
    return np.dtype(object)


def _array(path: Path) -> NDArray[Any]:
    with _reading(path):
        with path.open("rb") as stream:
            _check_header(str(path), stream, path.stat().st_size)
        array: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
    return array


def _check_header(name: str, stream: IO[bytes], length: int) -> None:
    """Refuse objects, and more values than a .npy stream of some length [bytes] can
    hold.
    """
    shape, _, dtype = read_header(stream)
    if dtype.hasobject:
        raise UnreadableFileError(
            "the file holds pickled objects",
            where=name,
            expected="arrays of numbers",
            fix="lagbench import --format gns-npz reads trajectories of GNS code bases",
        )
    held = length - stream.tell()
    # NumPy reserves memory for what the header claims before it reads.
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize > held:
        raise UnreadableFileError(
            "the array claims more than the file holds",
            where=name,
            expected=f"{held} bytes",
            got=f"{dtype} of shape {shape}",
        )


def _npz(path: Path) -> dict[str, NDArray[Any]]:
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            name = f"{path}, {member.filename}"
            check_inflation(
                name, packed=member.compress_size, unpacked=member.file_size
            )
            if member.filename.removesuffix(".npy") in ARRAYS:
                with archive.open(member) as stream:
                    _check_header(name, stream, member.file_size)
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in ARRAYS if name in file}


def _netcdf(path: Path) -> dict[str, Any]:
    import netCDF4

    with path.open("rb") as stream:
        classic = stream.read(len(CLASSIC)) == CLASSIC
    if not classic:  # netCDF would follow links and read other files
        with open_hdf5(path) as held:
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
    return arrays


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn what damaged bytes raise, which is nearly any type, into an
    UnreadableFileError.
    """
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
