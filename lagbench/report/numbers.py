"""Numbers as readers like them: few digits, real minus signs, powers of ten raised."""

from __future__ import annotations

import math
from collections.abc import Sequence

from .markup import Markup, join, tag

__all__ = ["MISSING", "decimals", "html", "interval", "power", "text"]

MISSING = "–"
"""What stands where there is no number."""

DIGITS = 3
"""Significant digits."""

PLAIN = (-3, 5)
"""Powers of ten between which numbers are written out."""

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def power(exponent: int) -> str:
    """Return a power of ten.

    >>> power(-4)
    '10⁻⁴'
    """
    return f"10{str(exponent).translate(_RAISED)}"


def text(value: float, digits: int = DIGITS) -> str:
    """Return a number with so many significant digits.

    >>> text(0.012345), text(-2.5e-7), text(1200000.0), text(20.0), text(math.nan)
    ('0.0123', '−2.50×10⁻⁷', '1.20×10⁶', '20', '–')
    """
    if not math.isfinite(value):
        return MISSING if math.isnan(value) else ("∞" if value > 0 else "−∞")
    if value == 0.0:
        return "0"
    if value == int(value) and abs(value) < 10.0 ** PLAIN[1]:
        return _minus(str(int(value)))
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    order = int(exponent)
    if PLAIN[0] <= order < PLAIN[1]:
        return _minus(f"{float(f'{mantissa}e{order}'):.{max(0, digits - 1 - order)}f}")
    return f"{_minus(mantissa)}×{power(order)}"


def html(value: float) -> Markup:
    """Return a number as markup that keeps together."""
    return tag("span", text(value), class_="n")


def interval(bounds: tuple[float, float]) -> Markup:
    """Return an interval as markup; nothing where there is none."""
    low, high = bounds
    if math.isnan(low) or math.isnan(high):
        return Markup("")
    return tag("span", join([text(low), text(high)], " … "), class_="ci")


def decimals(values: Sequence[float], step: float) -> list[str]:
    """Return multiples of a step with just the decimals that the step needs.

    >>> decimals([-0.5, 0.0, 0.5], 0.5)
    ['−0.5', '0', '0.5']
    """
    places = max(0, -math.floor(math.log10(step) + 1e-9))
    while places < 9 and abs(round(step, places) - step) > 1e-9 * step:
        places += 1
    return [_minus(f"{value:.{places}f}") if abs(value) > step / 1e6 else "0" for value in values]


def _minus(written: str) -> str:
    return written.replace("-", "−")
