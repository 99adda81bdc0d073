"""Encode the data of the page: arrays as 16-bit integers, bytes as text.

A value is ``zero + step * level``, or the exponential of that, with integer levels. An
array is stored as the differences of its rows, which are small where rows are frames;
differences wrap around at 16 bits. Each difference is replaced by its place in the
sequence 0, -1, 1, -2, 2, ..., so that small ones have an upper byte of 0. Arrays of a
kind, such as films, stand together, and all lower bytes before all upper bytes: alike
bytes side by side compress to three quarters. page/data.js reads all of it.
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

LARGEST_LEVEL = 2**15 - 1

SMALLEST_SHARE = 1e-9
"""A logarithmic range reaches no lower than this share of its top."""

SMALLEST_TOP = sys.float_info.min / SMALLEST_SHARE
"""Smaller tops have no logarithmic range: its ends may read back as zero."""

DIGITS = 9  # most digits of a zero, unless the range is narrower than they tell
# Values are divided by the rounded step, so its rounding moves no value.
STEP_DIGITS = 3

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
    if abs(zero - low) > high - low > 0.0:
        # a range so narrow needs all digits: else its levels would not fit into 16 bits
        zero = low
    step = (high - low) / levels
    if step == 0.0:
        step = 1.0
    else:
        # to a tenth of a step: the least value then has a level next to 0
        zero = round(zero, 1 - math.floor(math.log10(step)))
    return Scale(
        zero=zero,
        step=round_digits(step, STEP_DIGITS),
        is_logarithmic=is_logarithmic,
    )


Reference = dict[str, float | bool | str | list[int]]
"""What page/data.js reads an array by: its kind, place, shape and scale, or its numbers
where 16 bits cannot hold them.
"""


@dataclass
class _Group:
    """Arrays of one kind, one after the other."""

    parts: list[bytes] = field(default_factory=list)
    length: int = 0  # numbers so far
    starts: dict[bytes, int] = field(default_factory=dict)

    def add(self, data: bytes) -> int:
        """Return where an array starts; equal arrays stand there once."""
        if data not in self.starts:
            self.starts[data] = self.length
            self.length += len(data) // 2
            self.parts.append(data)
        return self.starts[data]


@dataclass
class ArrayStore:
    """Arrays of numbers in groups of one kind, one after the other."""

    _groups: dict[str, _Group] = field(default_factory=dict)

    def add(
        self,
        values: ArrayLike,
        *,
        kind: str,
        prefer_logarithmic: bool = False,
        levels: int = LEVELS,
    ) -> Reference:
        """Add an array, shape [row] or [row, column], NaN where values are missing.

        Args:
            values: the array.
            kind: arrays of a kind stand together; equal ones stand there once.
            prefer_logarithmic: whether levels are those of the logarithm, where no
                value is negative.
            levels: steps between the least and the greatest value.

        Returns:
            The reference that page/data.js reads.
        """
        array = np.asarray(values, np.float64)
        scale = scale_for(array, prefer_logarithmic=prefer_logarithmic, levels=levels)
        return self._store(array, scale, kind)

    def add_whole(self, numbers: ArrayLike, *, kind: str) -> Reference:
        """Add a row of whole numbers, which stay exact: frames or materials."""
        array = np.asarray(numbers, np.float64)
        if np.abs(array).max(initial=0.0) > LARGEST_LEVEL:
            return {"numbers": array.astype(np.int64).tolist()}
        return self._store(array, WHOLE_NUMBERS, kind)

    def starts(self) -> dict[str, int]:
        """Return the place of the first number of each kind."""
        places = {}
        place = 0
        for kind, group in self._groups.items():
            places[kind] = place
            place += group.length
        return places

    def to_bytes(self) -> bytes:
        """Return the lower bytes of all 16-bit numbers, then their upper bytes."""
        parts = []
        for group in self._groups.values():
            parts += group.parts
        data = np.frombuffer(b"".join(parts), np.uint8)
        return data.reshape(-1, 2).T.tobytes()

    def _store(self, array: NDArray[np.float64], scale: Scale, kind: str) -> Reference:
        levels = scale.levels_of(array).reshape(len(array), -1)
        first_row = np.zeros((1, levels.shape[1]), np.int16)
        differences = np.diff(levels, axis=0, prepend=first_row)
        data = _fold_signs(differences).astype("<u2").tobytes()
        group = self._groups.setdefault(kind, _Group())
        rows, columns = levels.shape
        return {
            "kind": kind,
            "start": group.add(data),
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
