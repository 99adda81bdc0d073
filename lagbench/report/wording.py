"""Names of metrics and frames as readers read them."""

from __future__ import annotations

from unicodedata import east_asian_width

from lagbench.metrics import Metric

__all__ = ["clipped", "quantity", "sentence", "unit", "words"]

_CAPITALS = {"mse": "MSE", "mae": "MAE", "rmse": "RMSE", "kl": "KL", "w1": "W1", "w2": "W2"}
_OTHERS = {"pearson": "correlation", "avg": "average", "hist": "histogram", "abs": "magnitudes"}


def words(name: str, *, capital: bool = False) -> str:
    """Return the name of a metric as words.

    >>> words("vorticity_rmse"), words("mse_avg", capital=True), words("energy_error", capital=True)
    ('vorticity RMSE', 'MSE average', 'Energy error')
    """
    written = " ".join(_CAPITALS.get(part) or _OTHERS.get(part, part) for part in name.split("_"))
    return written[0].upper() + written[1:] if capital else written


def clipped(name: str, room: int = 34) -> str:
    """Return a name that takes no more room than so many narrow letters.

    >>> clipped("SuperGAT with a loss of six terms", room=12)
    'SuperGAT wi…'
    """
    widths = [2 if east_asian_width(letter) in "WF" else 1 for letter in name]
    if sum(widths) <= room:
        return name
    kept = 0
    while sum(widths[: kept + 1]) < room:
        kept += 1
    return f"{name[:kept]}…"


def unit(metric: Metric) -> str:
    """Return the unit in brackets with a space before it, nothing for pure numbers."""
    return "" if metric.unit == "1" else f" [{metric.unit.replace('^2', '²')}]"


def quantity(metric: Metric) -> str:
    """Return what an axis shows: name and unit."""
    return words(metric.name) + unit(metric)


def sentence(metric: Metric) -> str:
    """Return what a metric says, its unit and where it is defined, as one sentence."""
    return f"{metric.summary[0].upper()}{metric.summary[1:]}{unit(metric)} ({metric.source})."
