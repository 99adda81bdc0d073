"""Axes: from values to pixels, with round ticks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .numbers import decimals, power

__all__ = ["Scale", "Tick", "linear", "logarithmic", "spanning"]

Floats = NDArray[np.float64]

WIDE = 60.0
"""From this ratio of greatest to least value an axis of errors is logarithmic."""

DEEPEST = 1e-6
"""A logarithmic axis reaches no lower than this share of its top."""

_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)


@dataclass(frozen=True)
class Tick:
    """A mark of an axis.

    Attributes:
        value: where it stands.
        label: its text.
    """

    value: float
    label: str


@dataclass(frozen=True)
class Scale:
    """One axis.

    Attributes:
        low: value at its start.
        high: value at its end.
        log: whether it is logarithmic.
        exponent: the labels are in units of this power of ten.
        ticks: its marks.
    """

    low: float
    high: float
    log: bool
    exponent: int
    ticks: tuple[Tick, ...]

    def share(self, values: ArrayLike) -> Floats:
        """Return where values lie between low (0) and high (1); NaN where they have no place."""
        x = np.asarray(values, np.float64)
        if not self.log:
            return (x - self.low) / (self.high - self.low)
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = np.where(x > 0.0, np.log10(np.where(x > 0.0, x, 1.0)), np.nan)
        low, high = math.log10(self.low), math.log10(self.high)
        return np.asarray((logs - low) / (high - low), np.float64)

    @property
    def factor(self) -> str:
        """What the labels are to be multiplied by, empty for 1."""
        return f"×{power(self.exponent)}" if self.exponent else ""


def linear(low: float, high: float, *, count: int = 5, tight: bool = False) -> Scale:
    """Return a linear axis that covers a range.

    Args:
        low: least value.
        high: greatest value.
        count: about how many ticks.
        tight: end at the range itself, not at the next tick.
    """
    if not high > low:
        middle = abs(low) or 1.0
        low, high = low - 0.5 * middle, low + 0.5 * middle
    step = _round_step((high - low) / count)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    numbers = [k * step for k in range(first, last + 1)]
    if tight:
        numbers = [value for value in numbers if low - 1e-9 * step <= value <= high + 1e-9 * step]
    else:
        low, high = numbers[0], numbers[-1]
    largest = max(abs(low), abs(high))
    order = math.floor(math.log10(largest))
    exponent = order if order < -2 or order > 4 else 0
    unit = 10.0**exponent
    labels = decimals([value / unit for value in numbers], step / unit)
    return Scale(low, high, False, exponent, tuple(map(Tick, numbers, labels)))


def _round_step(rough: float) -> float:
    """Return the round number next above."""
    unit = 10.0 ** math.floor(math.log10(rough))
    return next(factor * unit for factor in _STEPS if factor * unit >= rough * (1 - 1e-9))


def logarithmic(low: float, high: float) -> Scale:
    """Return a logarithmic axis over whole decades; few decades have ticks between, many skip some."""
    first, last = math.floor(math.log10(low) + 1e-9), math.ceil(math.log10(high) - 1e-9)
    last = max(last, first + 1)
    every = 1 + (last - first) // 7
    ticks = [Tick(10.0**k, power(k)) for k in range(first, last + 1, every)]
    if last - first == 1:
        ticks += [Tick(factor * 10.0**first, f"{factor}×{power(first)}") for factor in (2, 5)]
    return Scale(10.0**first, 10.0**last, True, 0, tuple(ticks))


def spanning(series: Sequence[ArrayLike], *, zero: bool = True, log: bool | None = None) -> Scale:
    """Return an axis for series of values; what is not finite is left out.

    Args:
        series: arrays of values.
        zero: whether a linear axis starts at 0.
        log: whether it is logarithmic; when None, if all is at least 0 and the range is wide.
    """
    values = np.concatenate([np.asarray(s, np.float64).ravel() for s in series] or [np.zeros(0)])
    values = values[np.isfinite(values) & (np.abs(values) < 1e300)]
    if not values.size:
        return linear(0.0, 1.0)
    low, high = float(values.min()), float(values.max())
    positive = values[values > DEEPEST * high] if high > 0.0 else values[:0]
    if log is None:
        log = low >= 0.0 and positive.size > 0 and float(np.percentile(positive, 5)) * WIDE < high
    if log and positive.size and high > 1e-300:
        return logarithmic(float(positive.min()), high)
    return linear(min(low, 0.0) if zero else low, max(high, 0.0) if zero else high)
