"""Encode the data of the page: arrays as 16-bit integers, bytes as text.

A value is ``zero + step * level``, or the exponential of that, with integer levels. An
array is stored as the differences of its rows, which are small where rows are frames;
differences wrap around at 16 bits. Each difference is replaced by its place in the
sequence 0, -1, 1, -2, 2, ..., so that small ones have an upper byte of 0. All lower
bytes stand before all upper bytes, which compresses to four fifths. page/data.js reads
all of it.
"""

from __future__ import annotations

import base64
import gzip
import math
import sys
import zlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.data.checksums import round_digits

LEVELS = 4000
"""Steps between the least and the greatest value of an array, unless told otherwise."""

MISSING = -(2**15)
"""Level that stands for NaN."""

SMALLEST_SHARE = 1e-9
"""A logarithmic range reaches no lower than this share of its top."""

SMALLEST_TOP = sys.float_info.min / SMALLEST_SHARE
"""Smaller tops have no logarithmic range: its ends may read back as zero."""

DIGITS = 9  # most digits of a zero
STEP_DIGITS = 6  # 4000 steps are then off by at most a fiftieth of one

HARMLESS = bytes.maketrans(b"<>&", b",/.")
"""Digits of base 85 that mean something in HTML, and those that stand for them."""

HARMFUL = bytes.maketrans(b",/.", b"<>&")

GZIP = 16 + zlib.MAX_WBITS  # window bits that mean gzip


@dataclass(frozen=True, kw_only=True)
class Scale:
    """How levels become values."""

    zero: float
    step: float
    is_logarithmic: bool

    def levels_of(self, values: NDArray[np.float64]) -> NDArray[np.int16]:
        """Return the nearest levels; MISSING for what is not finite."""
        is_known = np.isfinite(values)
        numbers = np.where(is_known, values, 0.0)
        if self.is_logarithmic:
            numbers = np.log(np.maximum(numbers, math.exp(self.zero)))
        levels = np.rint((numbers - self.zero) / self.step)
        return np.where(is_known, levels, MISSING).astype(np.int16)


WHOLE_NUMBERS = Scale(zero=0.0, step=1.0, is_logarithmic=False)


def scale_for(
    values: NDArray[np.float64],
    *,
    prefer_logarithmic: bool = False,
    levels: int = LEVELS,
) -> Scale:
    """Return a scale of so many steps that spans some values.

    A logarithmic one needs values >= 0; zeros and very small values become the least
    value of its range.
    """
    finite_values = values[np.isfinite(values)]
    if not finite_values.size:
        return WHOLE_NUMBERS
    low = float(finite_values.min())
    high = float(finite_values.max())
    is_logarithmic = prefer_logarithmic and low >= 0.0 and high > SMALLEST_TOP
    if is_logarithmic:
        low = math.log(finite_values[finite_values > SMALLEST_SHARE * high].min())
        high = math.log(high)
    zero = round_digits(low, DIGITS)
    step = (high - low) / levels
    if step == 0.0:
        step = 1.0
    else:
        # to a hundredth of a step: more digits change no level
        zero = round(zero, 2 - math.floor(math.log10(step)))
    return Scale(
        zero=zero,
        step=round_digits(step, STEP_DIGITS),
        is_logarithmic=is_logarithmic,
    )


@dataclass
class ArrayStore:
    """Arrays of numbers one after the other; equal arrays stand there once."""

    _parts: list[bytes] = field(default_factory=list)
    _length: int = 0  # numbers so far
    _starts: dict[bytes, int] = field(default_factory=dict)

    def add(
        self,
        values: ArrayLike,
        *,
        prefer_logarithmic: bool = False,
        levels: int = LEVELS,
    ) -> dict[str, float | bool]:
        """Add an array, shape [row] or [row, column], NaN where values are missing.

        Returns:
            The reference that page/data.js reads: place, shape and scale.
        """
        array = np.asarray(values, np.float64)
        scale = scale_for(array, prefer_logarithmic=prefer_logarithmic, levels=levels)
        return self._store(array, scale)

    def add_whole(self, numbers: ArrayLike) -> dict[str, float | bool]:
        """Add whole numbers, which stay exact: frames or materials."""
        return self._store(np.asarray(numbers, np.float64), WHOLE_NUMBERS)

    def to_bytes(self) -> bytes:
        """Return the lower bytes of all numbers, then the upper ones."""
        data = np.frombuffer(b"".join(self._parts), np.uint8)
        return data.reshape(-1, 2).T.tobytes()

    def _store(
        self, array: NDArray[np.float64], scale: Scale
    ) -> dict[str, float | bool]:
        levels = scale.levels_of(array).reshape(len(array), -1)
        first_row = np.zeros((1, levels.shape[1]), np.int16)
        differences = np.diff(levels, axis=0, prepend=first_row)
        data = _fold_signs(differences).astype("<u2").tobytes()
        if data not in self._starts:
            self._starts[data] = self._length
            self._length += differences.size
            self._parts.append(data)
        rows, columns = levels.shape
        return {
            "start": self._starts[data],
            "rows": rows,
            "columns": columns,
            "zero": scale.zero,
            "step": scale.step,
            "log": scale.is_logarithmic,
        }


def _fold_signs(numbers: NDArray[np.int16]) -> NDArray[np.uint16]:
    """Return the places of numbers in the order 0, -1, 1, -2, 2, ...

    >>> _fold_signs(np.array([0, -1, 1, -2, 2, -32768], np.int16)).tolist()
    [0, 1, 2, 3, 4, 65535]
    """
    folded = (numbers << 1) ^ (numbers >> 15)
    return np.asarray(folded, np.int16).view(np.uint16)


def encode(data: bytes) -> str:
    """Return bytes as text that may stand in an HTML element: gzip, then base 85.

    >>> decode(encode(b"abc"), longest=3)
    b'abc'
    """
    text = base64.b85encode(gzip.compress(data, mtime=0))
    return text.translate(HARMLESS).decode("ascii")


def decode(text: str, *, longest: int) -> bytes:
    """Return the bytes that a text encodes.

    Raises:
        ValueError: the text encodes nothing, or more than ``longest`` bytes.
    """
    if not text.isascii():
        raise ValueError("no digits of base 85")
    compressed = base64.b85decode(text.encode("ascii").translate(HARMFUL))
    decompressor = zlib.decompressobj(wbits=GZIP)
    try:
        data = decompressor.decompress(compressed, longest + 1)
    except zlib.error as error:
        raise ValueError("no gzip") from error
    if len(data) > longest or not decompressor.eof:
        raise ValueError("too long, or cut short")
    return data
