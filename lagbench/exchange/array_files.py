"""Trajectories in a user's own arrays: .npy, .npz and netCDF files.

They are read frame by frame where the format allows it. The files come from strangers:
nothing is unpickled, no link is followed, and no more memory is taken than their bytes
can fill.
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
from numpy.lib.format import MAGIC_PREFIX
from numpy.typing import NDArray

from lagbench.data import MATERIALS
from lagbench.data.hdf5 import open_hdf5, open_netcdf
from lagbench.data.layout import MAX_ID
from lagbench.data.structure import Structure, check_structure
from lagbench.errors import DataError, LagbenchError, UnreadableFileError

from .axis_order import ORDER, OrderedArray, check_order
from .trajectory import (
    Frame,
    Trajectory,
    check_array,
    check_inflation,
    check_names,
    describe_archive,
    describe_file,
    read_header,
)

READABLE = (".npy", ".npz", ".nc")
"""Files that are adopted: an array, named arrays, netCDF."""

SAVE_AGAIN = f"save it again, as a file {', '.join(READABLE)}"
"""What to do about a file that cannot be read."""

POSITION = "position"
VELOCITY = "velocity"
MATERIAL = "material"
WALLS = "wall_velocity"
ARRAYS = (POSITION, VELOCITY, MATERIAL, WALLS)
"""Names of the arrays that are read."""

CLASSIC = b"CDF"
"""First bytes of the older netCDF formats, which cannot point to other files."""

NETCDF = Structure(groups=None, texts=True, cache=1 << 30)
"""What may be in a netCDF-4 file.

Chunks by default span many frames, so that more of them stay unpacked.
"""

MOST_NAMES = 5
"""Most names of arrays that a message lists."""

MAX_NAME = 80
"""Longest name of an array in a message [characters]."""

INTEGER_KINDS = "iu"
NUMBER_KINDS = "iuf"

Row = tuple[Path, int | None]
"""A file and, where it holds several, the number of the trajectory in it."""


def sort_naturally(paths: Sequence[Path]) -> list[Path]:
    """Return paths in the order of their names, numbers in them by value."""
    return sorted(paths, key=_natural_key)


def _natural_key(path: Path) -> tuple[list[tuple[int, str]], str]:
    parts = []
    for part in re.split(r"(\d+)", str(path)):
        number = int(part) if part.isdecimal() else -1
        parts.append((number, part))
    return parts, str(path)


def list_trajectories(path: Path) -> list[Row]:
    """Return the trajectories of a file, or of the files of a folder by name.

    Raises:
        UnreadableFileError: there are no such files, or one is empty or damaged.
        DataError: there are too many trajectories.
    """
    if path.is_dir():
        files = []
        for file in path.iterdir():
            if file.suffix in READABLE and file.is_file():
                files.append(file)
        if files:
            rows = []
            for file in sort_naturally(files):
                rows += list_trajectories(file)
            return rows

    if path.suffix not in READABLE or not path.is_file():
        got = f"a file {path.suffix}" if path.suffix else "a file without suffix"
        if path.is_dir():
            got = "a folder without such files"
        elif not path.exists():
            got = "no such file"
        raise UnreadableFileError(
            "no trajectories are there",
            where=str(path),
            expected=f"a file {', '.join(READABLE)}, or a folder of them",
            got=got,
            fix="save each trajectory with np.save, shape [frame, particle, space]; "
            "docs/exchange.md describes all forms",
        )
    if path.stat().st_size == 0:
        raise UnreadableFileError(
            "the file is empty",
            where=str(path),
            expected="a trajectory",
            got="0 bytes",
            fix="save it again, or leave it out",
        )
    if path.suffix != ".npy":
        return [(path, None)]

    array = _read_npy(path)
    shape = array.shape
    if len(shape) != 4:
        if len(shape) != 3:
            # before trajectories are counted: a user would look for more of them
            check_array(str(path), shape, array.dtype)
        return [(path, None)]
    if shape[0] > MAX_ID + 1:
        raise DataError(
            "too many trajectories",
            where=str(path),
            expected=f"at most {MAX_ID + 1}",
            got=shape[0],
            fix="save fewer in a file, and adopt two splits",
        )
    return [(path, number) for number in range(shape[0])]


def open_trajectory(row: Row, order: tuple[str, ...] | None = None) -> Trajectory:
    """Return a trajectory, after a look at types and shapes of its arrays.

    Args:
        row: the file, and the number of the trajectory in it.
        order: names of the axes of positions and velocities in their order; when None,
            frame, particle, space, and arrays that look otherwise are refused.
    """
    path, number = row
    name = str(path)
    if number is not None:
        name = f"{path}, trajectory {number}"
    with _reading(path):
        arrays: Mapping[str, Any]
        if path.suffix == ".npz":
            arrays = _read_npz(path)
        elif path.suffix == ".nc":
            arrays = _read_netcdf(path)
        else:
            array = _read_npy(path)
            arrays = {POSITION: array if number is None else array[number]}
        return _parse_trajectory(path, name, arrays, order)


def _require_positions(path: Path, names: Sequence[str]) -> None:
    """Refuse a file without positions, by the names of its arrays."""
    if POSITION in names:
        return
    present = [ascii(name)[:MAX_NAME] for name in names[:MOST_NAMES]]
    if len(names) > MOST_NAMES:
        present.append(f"{len(names) - MOST_NAMES} more")
    raise UnreadableFileError(
        "there are no positions",
        where=str(path),
        expected=f"an array {POSITION!r}",
        got=", ".join(present) or "no array",
        fix=f"save them as {POSITION!r}, shape [frame, particle, axis]",
    )


def _parse_trajectory(
    path: Path,
    name: str,
    arrays: Mapping[str, Any],
    order: tuple[str, ...] | None,
) -> Trajectory:
    """Return the trajectory of named arrays."""
    position = OrderedArray(arrays[POSITION], order or ORDER)
    shape = position.shape
    check_array(name, shape, position.dtype)
    if order is None:
        check_order(position, where=name)
    frame_count, particle_count, dimension = shape
    velocity = None
    if VELOCITY in arrays:
        velocity = OrderedArray(arrays[VELOCITY], order or ORDER)
        where = f"{name}, {VELOCITY}"
        _check_numbers(velocity, "velocities", shape, where=where)

    def read() -> Iterator[Frame]:
        with _reading(path):
            for frame in range(frame_count):
                frame_velocity = None
                if velocity is not None:
                    frame_velocity = velocity[frame]
                yield position[frame], frame_velocity

    return Trajectory(
        name=name,
        frames=frame_count,
        material=_parse_material(name, arrays.get(MATERIAL), particle_count),
        read=read,
        dimension=dimension,
        wall_velocity=_parse_walls(
            name, arrays.get(WALLS), frame_count, dimension=dimension
        ),
    )


def _parse_material(
    name: str,
    array: Any,  # noqa: ANN401 (arrays, also netCDF's)
    particle_count: int,
) -> NDArray[np.int8]:
    """Return the material of each particle, shape [particle]; all liquid if None."""
    if array is None:
        return np.zeros(particle_count, np.int8)
    where = f"{name}, {MATERIAL}"
    numbers = [f"{number} {material}" for number, material in enumerate(MATERIALS)]
    meaning = f"materials: {', '.join(numbers)}"
    _check_numbers(array, meaning, (particle_count,), where=where, kinds=INTEGER_KINDS)
    material = np.asarray(array[...])
    if not np.isin(material, range(len(MATERIALS))).all():
        unknown = np.unique(material[~np.isin(material, range(len(MATERIALS)))])
        raise DataError(
            f"these are no {meaning}",
            where=where,
            expected=f"numbers from 0 to {len(MATERIALS) - 1}",
            got=", ".join(map(str, unknown[:10].tolist())),
            fix="number them so, or leave materials out: all are liquid then",
        )
    return material.astype(np.int8)


def _parse_walls(
    name: str,
    array: Any,  # noqa: ANN401 (arrays, also netCDF's)
    frame_count: int,
    *,
    dimension: int,
) -> NDArray[np.float64] | None:
    """Return velocities of walls [length/s], if any.

    The shape is [wall, axis] or [frame, wall, axis], with two walls for each axis.
    """
    if array is None:
        return None
    where = f"{name}, {WALLS}"
    shape = (2 * dimension, dimension)
    _check_numbers(array, "walls", shape, (frame_count, *shape), where=where)
    walls = np.asarray(array[...], np.float64)
    with np.errstate(over="ignore"):  # they are stored as float32
        is_finite = np.isfinite(walls.astype(np.float32)).all()
    if not is_finite:
        raise DataError(
            "a velocity of a wall is not finite",
            where=where,
            expected="numbers",
            got="NaN, infinity, or a number beyond float32",
            fix="give zeros where walls rest",
        )
    return walls


def _check_numbers(
    array: Any,  # noqa: ANN401 (arrays, also netCDF's)
    kind: str,
    *shapes: tuple[int, ...],
    where: str,
    kinds: str = NUMBER_KINDS,
) -> None:
    """Refuse an array of another shape or type of values, by what its file declares."""
    shape = tuple(array.shape)
    dtype = _dtype_of(array)
    if shape in shapes and dtype.kind in kinds:
        return
    expected = "real numbers"
    if kinds == INTEGER_KINDS:
        expected = "integers"
    raise DataError(
        f"these are no {kind}",
        where=where,
        expected=f"{expected} of shape {' or '.join(map(str, shapes))}",
        got=f"{dtype} of shape {shape}",
        fix="save them in that shape, or leave them out",
    )


def _dtype_of(array: Any) -> np.dtype[Any]:  # noqa: ANN401
    """Return the type of values; netCDF's types of texts and lists are objects."""
    stored = getattr(array, "datatype", array.dtype)
    if isinstance(stored, np.dtype):
        return stored
    return np.dtype(object)


def _read_npy(path: Path) -> NDArray[Any]:
    with _reading(path):
        with path.open("rb") as stream:
            if stream.read(len(MAGIC_PREFIX)) != MAGIC_PREFIX:
                raise UnreadableFileError(
                    "not a .npy file of NumPy",
                    where=str(path),
                    expected="an array, written by np.save",
                    got=describe_file(path),
                    fix=SAVE_AGAIN,
                )
            stream.seek(0)
            _check_header(str(path), stream, path.stat().st_size)
        array: NDArray[Any] = np.lib.format.open_memmap(path, mode="r")
    return array


def _check_header(name: str, stream: IO[bytes], length: int) -> None:
    """Refuse objects, and more values than a .npy stream can hold.

    ``length`` is that of the stream [bytes].
    """
    shape, _, dtype = read_header(stream)
    if dtype.hasobject:
        raise UnreadableFileError(
            "the file holds pickled objects",
            where=name,
            expected="arrays of numbers",
            got=dtype,
            fix="save plain arrays: np.save(FILE, array.astype('float32')); "
            "lagbench import --format gns-npz reads trajectories of GNS code bases",
        )
    # NumPy reserves memory for what the header claims before it reads.
    available_bytes = length - stream.tell()
    claimed_bytes = math.prod(shape) * dtype.itemsize
    if min(shape, default=0) < 0 or claimed_bytes > available_bytes:
        raise UnreadableFileError(
            "the array claims more than the file holds",
            where=name,
            expected=f"{available_bytes} bytes",
            got=f"{dtype} of shape {shape}",
            fix="save it again: it was cut",
        )


def _open_archive(path: Path) -> zipfile.ZipFile:
    """Return a zip archive; refuse a file that is none."""
    try:
        return zipfile.ZipFile(path)
    except zipfile.BadZipFile as error:
        raise UnreadableFileError(
            "cannot read an npz file",
            where=str(path),
            expected="named arrays, written by np.savez",
            got=describe_archive(path, error),
            fix=SAVE_AGAIN,
        ) from error


def _read_npz(path: Path) -> dict[str, NDArray[Any]]:
    with _open_archive(path) as archive:
        check_names(path, archive)
        for member in archive.infolist():
            if member.filename.removesuffix(".npy") not in ARRAYS:
                continue  # it is never read
            name = f"{path}, {member.filename}"
            check_inflation(
                name, packed=member.compress_size, unpacked=member.file_size
            )
            with archive.open(member) as stream:
                _check_header(name, stream, member.file_size)
    with np.load(path, allow_pickle=False) as file:
        _require_positions(path, file.files)
        arrays = {}
        for name in ARRAYS:
            if name in file:
                arrays[name] = file[name]
        return arrays


def _read_netcdf(path: Path) -> dict[str, Any]:
    with path.open("rb") as stream:
        is_classic = stream.read(len(CLASSIC)) == CLASSIC
    if not is_classic:  # netCDF would follow links and read other files
        with open_hdf5(path) as hdf5:
            check_structure(hdf5, path, NETCDF)

    file = open_netcdf(path)
    file.set_auto_maskandscale(False)
    _require_positions(path, list(file.variables))
    arrays = {}
    for name in ARRAYS:
        if name not in file.variables:
            continue
        variable = file.variables[name]
        # Values are read as they are stored: those that stand for others are refused.
        packing = {"scale_factor", "add_offset"}.intersection(variable.ncattrs())
        if packing and name != MATERIAL:
            raise UnreadableFileError(
                "the values are packed",
                where=f"{path}, {name}, {', '.join(sorted(packing))}",
                expected="positions as they are, float32 or float64",
                got="values that stand for others",
                fix="write them again without scale_factor and add_offset",
            )
        arrays[name] = variable
    return arrays


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn what damaged bytes raise, nearly any type, into an UnreadableFileError."""
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
            fix=SAVE_AGAIN,
        ) from error
