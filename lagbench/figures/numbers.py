"""Numbers and names of metrics as readers like them: few digits, real minus signs,
words.
"""

from __future__ import annotations

import math

from lagbench.metrics.metric import Metric

MISSING = "–"  # stands where there is no number
DIGITS = 3  # significant digits
PLAIN_POWERS = range(-3, 5)  # powers of ten of numbers that are written out

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def format_power(exponent: int) -> str:
    """Return a power of ten.

    >>> format_power(-4)
    '10⁻⁴'
    """
    return f"10{str(exponent).translate(_RAISED)}"


def text(value: float, digits: int = DIGITS) -> str:
    """Return a number with so many significant digits.

    >>> text(0.012345), text(-2.5e-7), text(1200000.0), text(20.0), text(math.nan)
    ('0.0123', '−2.50×10⁻⁷', '1.20×10⁶', '20', '–')
    """
    if math.isnan(value):
        return MISSING
    if math.isinf(value):
        return _format_minus(f"{value}".replace("inf", "∞"))
    if value == 0.0:
        return "0"
    if value == int(value) and abs(value) < 10.0**PLAIN_POWERS.stop:
        return _format_minus(str(int(value)))
    # rounding may raise the power: 0.99999 is 1.00
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    order = int(exponent)
    if order in PLAIN_POWERS:
        rounded = float(f"{mantissa}e{order}")
        return _format_minus(f"{rounded:.{max(0, digits - 1 - order)}f}")
    return f"{_format_minus(mantissa)}×{format_power(order)}"


def _format_minus(number: str) -> str:
    return number.replace("-", "−")


_PARTS_OF_NAMES = {
    "mse": "MSE",
    "mae": "MAE",
    "rmse": "RMSE",
    "nrmse": "NRMSE",
    "kl": "KL",
    "w1": "W1",
    "w2": "W2",
    "pearson": "correlation",
    "avg": "average",
    "hist": "histogram",
    "abs": "magnitudes",
}


def words(name: str, *, capital: bool = False) -> str:
    """Return the name of a metric as words.

    >>> words("vorticity_rmse"), words("mse_avg"), words("energy_error", capital=True)
    ('vorticity RMSE', 'MSE average', 'Energy error')
    """
    parts = [_PARTS_OF_NAMES.get(part, part) for part in name.split("_")]
    phrase = " ".join(parts)
    if capital:
        return phrase[0].upper() + phrase[1:]
    return phrase


def format_unit(metric: Metric) -> str:
    """Return the unit in brackets with a space before it, nothing for pure numbers."""
    if metric.unit == "1":
        return ""
    return f" [{metric.unit.replace('^2', '²')}]"


def format_quantity(metric: Metric) -> str:
    """Return the label of an axis: name and unit."""
    return words(metric.name) + format_unit(metric)


def sentence(metric: Metric) -> str:
    """Return a metric's summary, unit and source as one sentence."""
    summary = metric.summary[0].upper() + metric.summary[1:]
    return f"{summary}{format_unit(metric)} ({metric.source})."
