"""Arrays as short text: twelve bits a number, two letters each, read back by the page.

>>> pack([0.0, 0.5, 1.0, float("nan")])
['AAf__-__', 0.0, 1.0, 0]
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["LEVELS", "MISSING", "coarse", "pack", "rounded", "spaced"]

DIGITS = np.frombuffer(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_", np.uint8)
"""Letters that need no escape in HTML, JSON or a URL."""

LEVELS = 4094
"""Greatest packed value."""

MISSING = 4095
"""What stands for NaN."""

DEEPEST = 1e-9
"""A logarithmic range reaches no lower than this share of its top."""

Packed = list[str | float | int]
"""Text, least value, greatest value, and 1 where the steps are those of the logarithm."""


def pack(values: ArrayLike, *, limits: tuple[float, float] | None = None, log: bool = False) -> Packed:
    """Return values in 4094 equal steps between the least and the greatest."""
    x = np.asarray(values, np.float64).ravel()
    known = x[np.isfinite(x)]
    low, high = limits or ((float(known.min()), float(known.max())) if known.size else (0.0, 1.0))
    logarithmic = log and bool(known.size) and low >= 0.0 and high > 0.0
    if logarithmic:
        positive = known[known > DEEPEST * high]
        low = float(positive.min())
        share = _share(np.log(np.clip(x, low, high)), math.log(low), math.log(high))
    else:
        share = _share(np.clip(x, low, high), low, high)
    steps = np.where(np.isfinite(x), np.rint(np.nan_to_num(share) * LEVELS), MISSING).astype(np.int64)
    return [_text(steps), rounded(low), rounded(high), int(logarithmic)]


def _share(x: NDArray[np.float64], low: float, high: float) -> NDArray[np.float64]:
    return (x - low) / (high - low) if high > low else np.zeros_like(x)


def _text(steps: NDArray[np.int64]) -> str:
    letters = np.stack([DIGITS[steps >> 6], DIGITS[steps & 63]], axis=-1)
    return letters.tobytes().decode("ascii")


def rounded(value: float, digits: int = 6) -> float:
    """Return a number with so many significant digits; what is not finite stays.

    >>> rounded(0.123456789), rounded(float("inf"))
    (0.123457, inf)
    """
    return float(f"{value:.{digits}g}") if math.isfinite(value) else value


def spaced(length: int, count: int) -> list[int]:
    """Return at most so many evenly spaced indices, first and last included.

    >>> spaced(10, 4), spaced(3, 5), spaced(7, 1)
    ([0, 3, 6, 9], [0, 1, 2], [6])
    """
    if length <= count:
        return list(range(length))
    if count == 1:
        return [length - 1]
    return [i * (length - 1) // (count - 1) for i in range(count)]


def coarse(field: NDArray[np.floating], nodes: int) -> NDArray[np.float64]:
    """Return a square field with at most so many nodes a side, as means over blocks.

    Args:
        field: values at nodes, NaN where there is none, shape [..., x node, y node].
        nodes: most nodes a side.

    Returns:
        Means of the known nodes of each block, NaN where none is known.
    """
    side = -(-field.shape[-1] // nodes)
    if side == 1:
        return field.astype(np.float64)
    count = -(-field.shape[-1] // side)
    room = count * side - field.shape[-1]
    pad = [(0, 0)] * (field.ndim - 2) + [(0, room)] * 2
    whole = np.pad(field.astype(np.float64), pad, constant_values=np.nan)
    blocks = whole.reshape(*field.shape[:-2], count, side, count, side)
    known = np.isfinite(blocks)
    number = known.sum(axis=(-3, -1))
    total = np.where(known, blocks, 0.0).sum(axis=(-3, -1))
    return np.where(number > 0, total / np.maximum(number, 1), np.nan)
