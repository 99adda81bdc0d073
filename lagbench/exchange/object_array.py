"""Object arrays of gns-npz files: written without pickling, read without running anything.

A trajectory in that format is a NumPy array of Python objects, and NumPy stores those as a
pickle: a program for a small machine, which can be made to call any function. The writer here
emits the one program that rebuilds two arrays, its bytes fixed by this file alone: the same with
every version of NumPy, readable by old and new ones, and frame by frame, so that no trajectory
has to be in memory. The reader accepts what rebuilds arrays and refuses all other calls.
"""

from __future__ import annotations

import pickle
import struct
from collections.abc import Iterable
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UnreadableFileError

__all__ = ["read_objects", "write_pair"]

_MODULE = "numpy.core.multiarray"
"""Home of ``_reconstruct`` for NumPy 1; NumPy 2 keeps it reachable there."""

_ALLOWED = {
    *((module, "_reconstruct") for module in (_MODULE, "numpy._core.multiarray")),
    *((module, "scalar") for module in (_MODULE, "numpy._core.multiarray")),
    *((module, "_frombuffer") for module in ("numpy.core.numeric", "numpy._core.numeric")),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
}
"""All that a pickle of arrays calls."""


class _Arrays(pickle.Unpickler):
    """Unpickler that rebuilds arrays and calls nothing else."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        if (module, name) not in _ALLOWED:
            message = f"the pickle wants to call {module}.{name}"
            raise pickle.UnpicklingError(message)
        return super().find_class(module, name)


def read_objects(stream: IO[bytes], where: str) -> NDArray[Any]:
    """Return the array of a .npy stream, whose objects may be arrays and numbers only.

    Args:
        stream: a .npy file at its start.
        where: file and key, for messages.

    Raises:
        UnreadableFileError: no .npy file, or a pickle that does more than rebuild arrays.
    """
    try:
        version = np.lib.format.read_magic(stream)
        read_header = (
            np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        )
        shape, fortran, dtype = read_header(stream)
        if not dtype.hasobject:
            return _plain(stream, shape, fortran, dtype)
        array = _Arrays(stream, encoding="latin1").load()
        if not isinstance(array, np.ndarray):
            message = f"the pickle holds a {type(array).__name__}"
            raise pickle.UnpicklingError(message)
        return array.reshape(shape)
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
