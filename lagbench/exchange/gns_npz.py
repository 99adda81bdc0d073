"""The format of the PyTorch GNS code bases: npz files of pickled pairs, and
metadata.json.

``train.npz``, ``valid.npz``, ``test.npz`` hold one object array per trajectory:
positions [frame, particle, space] and the kind of each particle. NumPy stores such an
array as a pickle: a program for a small machine, which can be made to call any
function.

The reader lets a program name what NumPy writes for arrays and nothing else, and
NumPy's own constructors are not among what it may call: told a type's flags by a file,
they take bytes for addresses of objects. Stand-ins note what the file says, and arrays
of numbers are made of it.
"""

from __future__ import annotations

import pickle
import pickletools
import re
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.errors import UnreadableFileError

from .metadata import Format, materials_of
from .trajectory import Run, Trajectory, check_array, check_inflation, read_header

JOINT = "gns_data"  # key under which some files hold all trajectories together
# codes of the types of numbers that may be in a file
_NUMBERS = re.compile("[iu][1248]|f[248]|b1")
# steps of a pickle, each makes one object; NumPy takes about fifty for a trajectory
_MOST_STEPS = 1 << 18
_PARTS = 3  # parts of a trajectory at the most: positions, kinds, a material property
# how deep arrays may lie in each other: trajectories in a joint array, parts, and a
# spare
_DEPTH = 3


def write(path: Path, runs: Iterable[Run]) -> list[tuple[int, int]]:
    """Write one subset, whole or not at all; return frames and particles of each
    trajectory.
    """
    shapes: list[tuple[int, int]] = []
    with (
        atomic_path(path, option="--output") as temporary,
        zipfile.ZipFile(temporary, "w") as archive,
    ):
        for frames, position, kinds in runs:
            pair = np.empty(2, dtype=object)
            pair[0] = np.empty((frames, len(kinds), 2), np.float32)
            pair[1] = kinds
            for number in range(frames):
                pair[0][number] = position(number)
            # Equal data give equal bytes: the time is zip's earliest, as by default,
            # and members are stored as numpy.savez stores them, since compressed bytes
            # would change with the version of zlib.
            member = zipfile.ZipInfo(f"simulation_{len(shapes)}.npy")
            member.external_attr = 0o644 << 16
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array_header_1_0(
                    stream, {"descr": "|O", "fortran_order": False, "shape": (2,)}
                )
                pickle.dump(pair, stream, protocol=4)
            shapes.append((frames, len(kinds)))
    return shapes


def trajectories(path: Path, kinds: Mapping[int, str]) -> Iterator[Trajectory]:
    """Yield the trajectories of a file, one in memory at a time; its pickles are
    rebuilt.
    """
    try:
        archive = zipfile.ZipFile(path)
    except (OSError, zipfile.BadZipFile) as error:
        got = f"{type(error).__name__}: {error}"
        raise UnreadableFileError(
            "cannot read an npz file", where=str(path), got=got
        ) from error
    with archive:
        for member in archive.namelist():
            key = member.removesuffix(".npy")
            name = f"{path}, key {key!r}"
            array = _load(archive, member, name)
            if key == JOINT and array.ndim:
                yield from (
                    _trajectory(f"{name}, item {i}", item, kinds)
                    for i, item in enumerate(array)
                )
            else:
                yield _trajectory(name, array, kinds)


def _trajectory(name: str, item: object, given: Mapping[int, str]) -> Trajectory:
    """Return the trajectory of a pair (positions, kinds) or a triple with a material
    property.
    """
    several = isinstance(item, tuple) or (
        isinstance(item, np.ndarray) and item.ndim == 1
    )
    parts = list(item) if several else []  # type: ignore[call-overload]
    if len(parts) not in (2, 3) or not isinstance(parts[0], np.ndarray):
        raise UnreadableFileError(
            "this is no trajectory",
            where=name,
            expected="positions, kinds[, a material property]",
            got=f"{type(item).__name__} of {len(parts)}"
            if several
            else type(item).__name__,
        )
    position = parts[0]
    check_array(name, position.shape, position.dtype)
    try:
        numbers = np.asarray(parts[1])
        values = np.unique(np.asarray(parts[2:], dtype=np.float64))
    except (ValueError, TypeError, OverflowError) as error:
        raise UnreadableFileError(
            "these are no kinds and no material property",
            where=name,
            expected="numbers",
            got=error,
        ) from error
    material, kept = materials_of(
        Format.GNS_NPZ, numbers, position.shape[1], given=given, where=name
    )
    if len(values) == 1 and not np.isfinite(values[0]):
        raise UnreadableFileError(
            "the material property is not finite", where=name, got=values[0]
        )
    if kept.all():
        chosen = position
    else:
        chosen = position[:, kept]
    return Trajectory(
        name=name,
        frames=len(position),
        material=material,
        read=lambda: ((frame, None) for frame in chosen),
        parameters={"material_property": values[0]} if len(values) == 1 else {},
    )


def _load(archive: zipfile.ZipFile, member: str, name: str) -> NDArray[Any]:
    """Return the array of a member, whose objects may be arrays and numbers only."""
    about = archive.getinfo(member)
    check_inflation(name, packed=about.compress_size, unpacked=about.file_size)
    try:
        with archive.open(member) as stream:
            shape, fortran, dtype = read_header(stream)
            if not dtype.hasobject:
                return np.frombuffer(stream.read(), dtype).reshape(
                    shape, order="F" if fortran else "C"
                )
            # A pickle can make the unpickler reserve far more memory than the file
            # holds. Reading it as text finds lengths beyond the end; a memo is reserved
            # up to its highest index; and a byte is enough to make an empty list.
            for step, (code, argument, place) in enumerate(pickletools.genops(stream)):
                if step > _MOST_STEPS:
                    raise pickle.UnpicklingError(
                        f"the pickle has more than {_MOST_STEPS} steps"
                    )
                if (
                    code.name.endswith("PUT")
                    and isinstance(argument, int)
                    and argument > (place or 0)
                ):
                    raise pickle.UnpicklingError(
                        "the pickle wants a memo larger than itself"
                    )
        with archive.open(member) as stream:
            read_header(stream)
            found = _Arrays(stream, encoding="latin1").load()
        if not isinstance(found, _Array):
            raise pickle.UnpicklingError(f"the pickle holds a {type(found).__name__}")
        return found.value().reshape(shape)
    except Exception as error:  # damaged pickles and zip files raise nearly any type
        raise UnreadableFileError(
            "an npz file is damaged, or holds more than arrays",
            where=name,
            expected="an object array of arrays",
            got=f"{type(error).__name__}: {error}",
        ) from error


class _Type:
    """What a pickle says of a type: its code and its order of bytes; never its
    flags.
    """

    def __init__(self, code: str, *_: object) -> None:
        self.code = str(code)
        self.order = "|"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = str(state[1])

    def numbers(self) -> np.dtype[Any]:
        """Return the type where it is one of numbers."""
        if not _NUMBERS.fullmatch(self.code) or self.order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError(
                f"the pickle holds values of type {self.code!r}"
            )
        return np.dtype(self.order + self.code)


class _Array:
    """What a pickle says of an array; its state comes later: version, shape, type,
    order, values.
    """

    def __init__(self, *_: object) -> None:
        self._state: tuple[Any, ...] = ()
        self._value: NDArray[Any] | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._state = state[1:]
        self._value = None

    def value(self, depth: int = _DEPTH) -> NDArray[Any]:
        """Return the array, made once however often it is named."""
        if self._value is None:
            shape, kind, fortran, data = self._state
            if kind.code.startswith("O"):  # NumPy pickles the elements as a list
                if not isinstance(data, list):
                    found = type(data).__name__
                    raise pickle.UnpicklingError(
                        f"the pickle has a {found} for the objects of an array"
                    )
                flat = np.empty(len(data), dtype=object)
                for number, item in enumerate(data):
                    flat[number] = _resolved(item, depth - 1)
            else:
                # Python 2 pickled raw values as text, a letter for a byte.
                raw: object
                if isinstance(data, str):
                    raw = data.encode("latin1")
                else:
                    raw = data
                if not isinstance(raw, bytes):
                    found = type(data).__name__
                    raise pickle.UnpicklingError(
                        f"the pickle has a {found} for the values of an array"
                    )
                flat = np.frombuffer(raw, kind.numbers())
            self._value = flat.reshape(shape, order="F" if fortran else "C")
        return self._value


def _resolved(item: object, depth: int) -> object:
    """Return an element of an object array: an array, a number, or a few of both."""
    if depth < 0:
        raise pickle.UnpicklingError("the pickle holds arrays in arrays without end")
    if isinstance(item, _Array):
        return item.value(depth)
    if isinstance(item, tuple | list) and len(item) <= _PARTS:
        return tuple(_resolved(part, depth - 1) for part in item)
    if isinstance(item, int | float):
        return item
    raise pickle.UnpicklingError(f"the pickle holds a {type(item).__name__}")


class _Maker:
    """What a name of a pickle stands for: a call that makes a stand-in, and that no
    pickle can change.
    """

    __slots__ = ("_kind",)

    def __init__(self, kind: type[_Array | _Type] | None) -> None:
        self._kind = kind

    def __call__(self, *arguments: Any) -> object:  # noqa: ANN401
        if self._kind is None:
            raise pickle.UnpicklingError("the pickle wants to make an array by itself")
        return self._kind(*arguments)

    def __setstate__(self, state: object) -> None:
        raise pickle.UnpicklingError("the pickle wants to change a function")


class _Arrays(pickle.Unpickler):
    """Unpickler for what NumPy writes of arrays: three names, all of them stand-ins."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        if name == "_reconstruct" and module in (
            "numpy.core.multiarray",
            "numpy._core.multiarray",
        ):
            return _Maker(_Array)
        if module == "numpy" and name in ("ndarray", "dtype"):
            # ndarray is named, and never called
            return _Maker(_Type if name == "dtype" else None)
        raise pickle.UnpicklingError(f"the pickle wants to call {module}.{name}")
