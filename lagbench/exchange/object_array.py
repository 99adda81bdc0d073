"""Object arrays of gns-npz files: written without pickling, read without running anything.

A trajectory in that format is a NumPy array of Python objects, and NumPy stores those as a
pickle: a program for a small machine, which can be made to call any function. The writer here
emits the one program that rebuilds two arrays, its bytes fixed by this file alone: the same with
every version of NumPy, readable by old and new ones, and frame by frame, so that no trajectory
has to be in memory.

The reader runs a program only as far as it names what NumPy writes, and NumPy's own constructors
are not among what it may call: told a type's flags by a file, they take bytes for addresses of
objects. Stand-ins note what the file says, and arrays of numbers are made of it afterwards.
"""

from __future__ import annotations

import pickle
import re
import struct
from collections.abc import Callable, Iterable
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UnreadableFileError

__all__ = ["read_objects", "write_pair"]

_MODULE = "numpy.core.multiarray"
"""Home of ``_reconstruct`` for NumPy 1; NumPy 2 keeps it reachable there."""

_NUMBERS = re.compile("[iu][1248]|f[248]|b1")
"""Codes of the types of numbers that may be in a file."""

_OBJECT = "O"
_PARTS = 3
"""Parts of a trajectory at the most: positions, kinds, a material property."""

_DEPTH = 3
"""How deep arrays may lie in each other: trajectories in a joint array, parts, and a spare."""


class _Call:
    """A call that a pickle may make, and cannot change."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., object]) -> None:
        self._function = function

    def __call__(self, *arguments: object) -> object:
        return self._function(*arguments)

    def __setstate__(self, state: object) -> None:
        message = "the pickle wants to change a function"
        raise pickle.UnpicklingError(message)


class _Type:
    """What a pickle says of a type: its code and its order of bytes; never its flags."""

    def __init__(self, code: str, *_: object) -> None:
        self.code, self.order = str(code), "|"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = str(state[1])

    @property
    def holds_objects(self) -> bool:
        """Whether the elements are objects."""
        return self.code[:1] == _OBJECT

    def numbers(self) -> np.dtype[Any]:
        """Return the type where it is one of numbers."""
        if not _NUMBERS.fullmatch(self.code) or self.order not in ("<", ">", "|", "="):
            message = f"the pickle holds values of type {self.code!r}"
            raise pickle.UnpicklingError(message)
        return np.dtype(self.order + self.code)


class _Array:
    """What a pickle says of an array; the state comes after the array, without its version."""

    def __init__(self, *state: Any) -> None:  # noqa: ANN401
        self._state = state
        self._value: NDArray[Any] | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._state, self._value = state[1:], None

    def value(self, depth: int = _DEPTH) -> NDArray[Any]:
        """Return the array, made once however often it is named."""
        if self._value is None:
            shape, kind, fortran, data = self._state
            flat = _objects(data, depth) if kind.holds_objects else _numbers(data, kind)
            self._value = flat.reshape(shape, order="F" if fortran else "C")
        return self._value


def _objects(items: object, depth: int) -> NDArray[Any]:
    """Return the elements of an object array, which NumPy pickles as a list."""
    if not isinstance(items, list):
        message = f"the pickle has a {type(items).__name__} for the objects of an array"
        raise pickle.UnpicklingError(message)
    flat = np.empty(len(items), dtype=object)
    for number, item in enumerate(items):
        flat[number] = _resolved(item, depth - 1)
    return flat


def _numbers(data: object, kind: _Type) -> NDArray[Any]:
    """Return raw values; Python 2 pickled them as text, a letter for a byte."""
    raw = data.encode("latin1") if isinstance(data, str) else data
    if not isinstance(raw, bytes | bytearray):
        message = f"the pickle has a {type(data).__name__} for the values of an array"
        raise pickle.UnpicklingError(message)
    return np.frombuffer(raw, kind.numbers())


def _resolved(item: object, depth: int) -> object:
    """Return an element of an object array: an array, a number, or a few of both."""
    if depth < 0:
        message = "the pickle holds arrays in arrays without end"
        raise pickle.UnpicklingError(message)
    if isinstance(item, _Array):
        return item.value(depth)
    if isinstance(item, tuple | list) and len(item) <= _PARTS:
        return tuple(_resolved(part, depth - 1) for part in item)
    if isinstance(item, int | float | np.generic):
        return item
    message = f"the pickle holds a {type(item).__name__}"
    raise pickle.UnpicklingError(message)


def _encoded(text: str, encoding: str) -> bytes:
    if encoding not in ("latin1", "latin-1"):
        message = f"the pickle wants to encode a text as {encoding}"
        raise pickle.UnpicklingError(message)
    return text.encode("latin1")


def _from_buffer(data: object, kind: object, shape: object, order: object) -> _Array:
    return _Array(shape, kind, order == "F", data)


def _refused(*_: object) -> None:
    message = "the pickle wants to make an array by itself"
    raise pickle.UnpicklingError(message)


def _calls() -> dict[tuple[str, str], _Call]:
    """Return all that a pickle of arrays calls, as stand-ins."""
    calls: dict[tuple[str, str], Callable[..., object]] = {
        ("numpy", "ndarray"): _refused,  # named, and never called
        ("numpy", "dtype"): _Type,
        ("_codecs", "encode"): _encoded,
    }
    for package in ("numpy.core", "numpy._core"):
        calls[f"{package}.multiarray", "_reconstruct"] = lambda *_: _Array()
        calls[f"{package}.multiarray", "scalar"] = lambda kind, data: _numbers(data, kind)[0]
        calls[f"{package}.numeric", "_frombuffer"] = _from_buffer
    return {name: _Call(function) for name, function in calls.items()}


class _Arrays(pickle.Unpickler):
    """Unpickler that notes arrays and calls nothing but its own stand-ins."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        call = _calls().get((module, name))
        if call is None:
            message = f"the pickle wants to call {module}.{name}"
            raise pickle.UnpicklingError(message)
        return call


def read_objects(stream: IO[bytes], where: str) -> NDArray[Any]:
    """Return the array of a .npy stream, whose objects may be arrays and numbers only."""
    try:
        version = np.lib.format.read_magic(stream)
        read_header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, fortran, dtype = read_header(stream)
        if not dtype.hasobject:
            return _plain(stream, shape, fortran, dtype)
        found = _Arrays(stream, encoding="latin1").load()
        if not isinstance(found, _Array):
            message = f"the pickle holds a {type(found).__name__}"
            raise pickle.UnpicklingError(message)
        return found.value().reshape(shape)
    except Exception as error:  # damaged pickles raise nearly any type
        raise UnreadableFileError(
            "the stored objects are damaged, or more than arrays",
            where=where,
            expected="an object array of arrays",
            got=f"{type(error).__name__}: {error}",
        ) from error


def _plain(stream: IO[bytes], shape: tuple[int, ...], fortran: bool, dtype: np.dtype[Any]) -> NDArray[Any]:
    data = stream.read()
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


def write_pair(
    stream: IO[bytes],
    frames: Iterable[NDArray[np.float32]],
    shape: tuple[int, int, int],
    kinds: NDArray[np.int64],
) -> None:
    """Write the .npy of an object array of two: positions and kinds of particles.

    Args:
        stream: where it goes.
        frames: positions, one frame at a time, each of shape [particle, space].
        shape: frames, particles, components.
        kinds: number of each particle's kind, shape [particle].
    """
    np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": (2,)})
    stream.write(pickle.PROTO + b"\x04")
    _open_array(stream, (2,), "O8", "|")
    stream.write(pickle.EMPTY_LIST + pickle.MARK)
    _open_array(stream, shape, "f4", "<")
    _bytes(stream, 4 * shape[0] * shape[1] * shape[2], (frame.astype("<f4").tobytes() for frame in frames))
    stream.write(pickle.TUPLE + pickle.BUILD)
    _open_array(stream, kinds.shape, "i8", "<")
    _bytes(stream, kinds.nbytes, [kinds.astype("<i8").tobytes()])
    stream.write(pickle.TUPLE + pickle.BUILD)
    stream.write(pickle.APPENDS + pickle.TUPLE + pickle.BUILD + pickle.STOP)


def _open_array(stream: IO[bytes], shape: tuple[int, ...], kind: str, order: str) -> None:
    """Write an empty array and its state up to the values: ``(1, shape, dtype, False, ...``."""
    stream.write(_call(_MODULE, "_reconstruct"))
    stream.write(_call("numpy", "ndarray") + _number(0) + pickle.TUPLE1 + _short_bytes(b"b"))
    stream.write(pickle.TUPLE3 + pickle.REDUCE)
    stream.write(pickle.MARK + _number(1) + pickle.MARK + b"".join(map(_number, shape)) + pickle.TUPLE)
    stream.write(_dtype(kind, order) + pickle.NEWFALSE)


def _dtype(kind: str, order: str) -> bytes:
    """Return the program for a type: ``dtype(kind, False, True)`` and its state."""
    flags = 63 if kind == "O8" else 0  # NumPy's own flags: objects are counted, listed, initialised
    made = _call("numpy", "dtype") + _text(kind) + pickle.NEWFALSE + pickle.NEWTRUE
    state = [_number(3), _text(order), *[pickle.NONE] * 3, *[_number(-1)] * 2, _number(flags)]
    return made + pickle.TUPLE3 + pickle.REDUCE + pickle.MARK + b"".join(state) + pickle.TUPLE + pickle.BUILD


def _bytes(stream: IO[bytes], length: int, parts: Iterable[bytes]) -> None:
    stream.write(pickle.BINBYTES8 + struct.pack("<Q", length))
    for part in parts:
        stream.write(part)


def _call(module: str, name: str) -> bytes:
    return pickle.GLOBAL + f"{module}\n{name}\n".encode("ascii")


def _number(value: int) -> bytes:
    return pickle.BININT + struct.pack("<i", value)


def _text(value: str) -> bytes:
    data = value.encode("ascii")
    return pickle.SHORT_BINUNICODE + bytes([len(data)]) + data


def _short_bytes(value: bytes) -> bytes:
    return pickle.SHORT_BINBYTES + bytes([len(value)]) + value
