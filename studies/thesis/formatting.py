"""Numbers and intervals as the tables print them."""

from __future__ import annotations

import math


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits, a dash where there is none.

    >>> number(0.00012345), number(None), number(12345678.0)
    ('0.000123', '-', '1.23e+07')
    """
    if value is None or math.isnan(value):
        return "-"
    return f"{value:.{digits}g}"


def interval(mean: float, bounds: tuple[float, float]) -> str:
    """Return a mean with its 95 % interval.

    >>> interval(0.12, (0.1, 0.15))
    '0.12 (0.1 to 0.15)'
    """
    low, high = bounds
    if math.isnan(low):
        return number(mean)
    return f"{number(mean)} ({number(low)} to {number(high)})"
