"""The format of the PyTorch GNS code bases: npz files of pickled pairs.

``train.npz``, ``valid.npz``, ``test.npz`` hold one object array per trajectory:
positions [frame, particle, space] and the kind of each particle. NumPy stores such an
array as a pickle: a program for a small machine, which can be made to call any
function.

No such program is run here. The reader lets a pickle name what NumPy writes for arrays
and nothing else, and calls none of NumPy's own constructors: told a type's flags by a
file, they take bytes for addresses of objects. Stand-ins note what the file says, and
arrays of numbers are made of it.
"""

from __future__ import annotations

import pickle
import pickletools
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.errors import UnreadableFileError

from .metadata import Format, find_materials
from .trajectory import (
    Run,
    Trajectory,
    check_array,
    check_inflation,
    check_names,
    describe_archive,
    read_header,
)

JOINT = "gns_data"
"""Key under which some files hold all trajectories together."""

NUMBER_CODES = re.compile("[iu][1248]|f[248]|b1")
"""Codes of the types of numbers that may be in a file."""

BYTE_ORDERS = ("<", ">", "|", "=")

MOST_STEPS = 1 << 18
"""Steps of a pickle, each makes one object; NumPy takes about fifty per trajectory."""

MOST_PARTS = 3
"""Parts of a trajectory: positions, kinds, a material property."""

MOST_DEPTH = 3
"""How deep arrays may lie in each other.

Trajectories in a joint array, their parts, and a spare.
"""

EXTERNAL_ATTRIBUTES = 0o644 << 16
"""File mode of a member of a zip file."""


def write(path: Path, runs: Iterable[Run]) -> list[tuple[int, int]]:
    """Write one subset, whole or not at all.

    Returns frames and particles of each trajectory.
    """
    shapes: list[tuple[int, int]] = []
    with (
        atomic_path(path, option="--output") as temporary,
        zipfile.ZipFile(temporary, "w") as archive,
    ):
        for frame_count, read_position, kinds in runs:
            first = read_position(0)
            position = np.empty((frame_count, *first.shape), np.float32)
            position[0] = first
            for frame in range(1, frame_count):
                position[frame] = read_position(frame)
            pair = np.empty(2, dtype=object)
            pair[0] = position
            pair[1] = kinds
            _write_member(archive, f"simulation_{len(shapes)}.npy", pair)
            shapes.append((frame_count, len(kinds)))
    return shapes


def _write_member(archive: zipfile.ZipFile, name: str, pair: NDArray[Any]) -> None:
    """Write an object array.

    Equal data give equal bytes: the time is zip's earliest, as by default, and members
    are stored as numpy.savez stores them, since compressed bytes would change with the
    version of zlib.
    """
    member = zipfile.ZipInfo(name)
    member.external_attr = EXTERNAL_ATTRIBUTES
    header = {"descr": "|O", "fortran_order": False, "shape": pair.shape}
    with archive.open(member, "w", force_zip64=True) as stream:
        np.lib.format.write_array_header_1_0(stream, header)
        pickle.dump(pair, stream, protocol=4)


def read_trajectories(path: Path, kinds: Mapping[int, str]) -> Iterator[Trajectory]:
    """Yield the trajectories of a file, one in memory at a time.

    ``kinds`` maps numbers of particles to materials, as the user says.

    Raises:
        UnreadableFileError: the file is damaged, or holds more than arrays.
    """
    try:
        archive = zipfile.ZipFile(path)
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile) as error:
        # A name that is no text is a ValueError, an unknown version is not implemented.
        raise UnreadableFileError(
            "cannot read an npz file",
            where=str(path),
            expected="a file of numpy.savez",
            got=describe_archive(path, error),
            fix="fetch it again, or name the format that it has: --format",
        ) from error
    with archive:
        check_names(path, archive)
        for member in archive.namelist():
            key = member.removesuffix(".npy")
            name = f"{path}, key {key!r}"
            array = _load(archive, member, name)
            if key == JOINT and array.ndim:
                for number, item in enumerate(array):
                    yield _parse_trajectory(f"{name}, item {number}", item, kinds)
            else:
                yield _parse_trajectory(name, array, kinds)


def _parse_trajectory(name: str, item: object, kinds: Mapping[int, str]) -> Trajectory:
    """Return the trajectory of a pair (positions, kinds), or of a triple.

    The third part is a material property; it is kept where it has one value for all.
    """
    parts = _split_parts(item)
    if len(parts) not in (2, 3) or not isinstance(parts[0], np.ndarray):
        raise UnreadableFileError(
            "this is no trajectory",
            where=name,
            expected="positions, kinds[, a material property]",
            got=f"{type(item).__name__} of {len(parts)} parts",
            fix="save a tuple for each trajectory; `lagbench adopt` takes plain arrays",
        )
    position = parts[0]
    check_array(name, position.shape, position.dtype)
    try:
        numbers = np.asarray(parts[1])
        properties = np.unique(np.asarray(parts[2:], dtype=np.float64))
    except (ValueError, TypeError, OverflowError) as error:
        raise UnreadableFileError(
            "these are no kinds and no material property",
            where=name,
            expected="numbers",
            got=error,
            fix="save one number for each particle, and one property",
        ) from error

    material, is_kept = find_materials(
        Format.GNS_NPZ, numbers, position.shape[1], user_kinds=kinds, where=name
    )
    if not is_kept.all():
        position = position[:, is_kept]
    parameters = {}
    if len(properties) == 1:
        parameters["material_property"] = properties[0]
        if not np.isfinite(properties[0]):
            raise UnreadableFileError(
                "the material property is not finite",
                where=name,
                expected="a number",
                got=properties[0],
                fix="save it again, or leave it out",
            )
    return Trajectory(
        name=name,
        frames=len(position),
        material=material,
        read=lambda: ((frame, None) for frame in position),
        dimension=position.shape[2],
        parameters=parameters,
    )


def _split_parts(item: object) -> list[Any]:
    """Return the parts of a tuple or of an array of one dimension; else none."""
    if isinstance(item, tuple):
        return list(item)
    if isinstance(item, np.ndarray) and item.ndim == 1:
        return list(item)
    return []


def _load(archive: zipfile.ZipFile, member: str, name: str) -> NDArray[Any]:
    """Return the array of a member, whose objects may be arrays and numbers only."""
    entry = archive.getinfo(member)
    check_inflation(name, packed=entry.compress_size, unpacked=entry.file_size)
    try:
        with archive.open(member) as stream:
            shape, is_fortran, dtype = read_header(stream)
            if not dtype.hasobject:
                values = np.frombuffer(stream.read(), dtype)
                return _reshape(values, shape, is_fortran)
            _check_steps(stream)
        with archive.open(member) as stream:
            read_header(stream)
            array = ArrayUnpickler(stream, encoding="latin1").load()
        if not isinstance(array, PickledArray):
            raise pickle.UnpicklingError(f"the pickle holds a {type(array).__name__}")
        return array.build().reshape(shape)
    except Exception as error:  # damaged pickles and zip files raise nearly any type
        raise UnreadableFileError(
            "an npz file is damaged, or holds more than arrays",
            where=name,
            expected="an object array of arrays",
            got=f"{type(error).__name__}: {error}",
            fix="fetch it again, or save it with numpy.savez",
        ) from error


def _reshape(
    values: NDArray[Any], shape: tuple[int, ...], is_fortran: bool
) -> NDArray[Any]:
    return values.reshape(shape, order="F" if is_fortran else "C")


def _check_steps(stream: IO[bytes]) -> None:
    """Refuse a pickle that makes the unpickler reserve far more than the file holds.

    Reading it as text finds lengths beyond the end. A memo is reserved up to its
    highest index. A byte is enough to make an empty list.
    """
    for step, (code, argument, place) in enumerate(pickletools.genops(stream)):
        if step > MOST_STEPS:
            raise pickle.UnpicklingError(f"the pickle has more than {MOST_STEPS} steps")
        if not code.name.endswith("PUT") or not isinstance(argument, int):
            continue
        if argument > (place or 0):
            raise pickle.UnpicklingError("the pickle wants a memo larger than itself")


class PickledType:
    """What a pickle says of a type: its code and byte order, and never its flags."""

    def __init__(self, code: str, *_: object) -> None:
        self.code = str(code)
        self.order = "|"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        """Note the order of bytes."""
        self.order = str(state[1])

    @property
    def is_object(self) -> bool:
        """Whether the values are Python objects."""
        return self.code.startswith("O")

    def build(self) -> np.dtype[Any]:
        """Return the type where it is one of numbers."""
        if not NUMBER_CODES.fullmatch(self.code) or self.order not in BYTE_ORDERS:
            raise pickle.UnpicklingError(
                f"the pickle holds values of type {self.code!r}"
            )
        return np.dtype(self.order + self.code)


class PickledArray:
    """What a pickle says of an array.

    Its state comes later: version, shape, type, order, values.
    """

    def __init__(self, *_: object) -> None:
        self._state: tuple[Any, ...] = ()
        self._array: NDArray[Any] | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        """Note shape, type, order and values."""
        self._state = state[1:]
        self._array = None

    def build(self, depth: int = MOST_DEPTH) -> NDArray[Any]:
        """Return the array, made once however often it is named."""
        if self._array is None:
            shape, dtype, is_fortran, data = self._state
            if dtype.is_object:
                # NumPy lists objects in the order of C, whatever the array's own order
                values = _build_objects(data, depth - 1)
                self._array = values.reshape(shape)
            else:
                values = np.frombuffer(_raw_bytes(data), dtype.build())
                self._array = _reshape(values, shape, is_fortran)
        return self._array


def _build_objects(data: object, depth: int) -> NDArray[Any]:
    """Return the elements of an object array, which NumPy pickles as a list."""
    if not isinstance(data, list):
        raise pickle.UnpicklingError(
            f"the pickle has a {type(data).__name__} for the objects of an array"
        )
    values = np.empty(len(data), dtype=object)
    for number, item in enumerate(data):
        values[number] = _build_element(item, depth)
    return values


def _raw_bytes(data: object) -> bytes:
    """Return the raw values; Python 2 pickled them as text, a letter for a byte."""
    if isinstance(data, str):
        return data.encode("latin1")
    if isinstance(data, bytes):
        return data
    raise pickle.UnpicklingError(
        f"the pickle has a {type(data).__name__} for the values of an array"
    )


def _build_element(item: object, depth: int) -> object:
    """Return an element of an object array: an array, a number, or a few of both."""
    if depth < 0:
        raise pickle.UnpicklingError("the pickle holds arrays in arrays without end")
    if isinstance(item, PickledArray):
        return item.build(depth)
    if isinstance(item, tuple | list) and len(item) <= MOST_PARTS:
        return tuple(_build_element(part, depth - 1) for part in item)
    if isinstance(item, int | float):
        return item
    raise pickle.UnpicklingError(f"the pickle holds a {type(item).__name__}")


class StandIn:
    """What a name in a pickle stands for: a call that makes a stand-in.

    No pickle can change it.
    """

    __slots__ = ("_kind",)

    def __init__(self, kind: type[PickledArray | PickledType] | None) -> None:
        self._kind = kind

    def __call__(self, *arguments: Any) -> object:  # noqa: ANN401
        """Return a stand-in for what NumPy would make."""
        if self._kind is None:
            raise pickle.UnpicklingError("the pickle wants to make an array by itself")
        return self._kind(*arguments)

    def __setstate__(self, state: object) -> None:
        """Refuse a change."""
        raise pickle.UnpicklingError("the pickle wants to change a function")


STAND_INS = {
    ("numpy.core.multiarray", "_reconstruct"): StandIn(PickledArray),
    ("numpy._core.multiarray", "_reconstruct"): StandIn(PickledArray),
    ("numpy", "dtype"): StandIn(PickledType),
    ("numpy", "ndarray"): StandIn(None),  # it is named, and never called
}
"""All names that a pickle may use."""


class ArrayUnpickler(pickle.Unpickler):
    """Unpickler for what NumPy writes of arrays: a few names, all of them stand-ins."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        """Return the stand-in for a name; refuse all others."""
        stand_in = STAND_INS.get((module, name))
        if stand_in is None:
            raise pickle.UnpicklingError(f"the pickle wants to call {module}.{name}")
        return stand_in
