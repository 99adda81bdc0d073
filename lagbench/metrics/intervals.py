"""Seeded bootstrap intervals of a mean over scenarios."""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["LEVEL", "RESAMPLES", "bootstrap_interval"]

LEVEL = 0.95
"""Share of the resampled means that an interval holds."""

RESAMPLES = 10_000
"""Resamples of the scenarios."""

SEED = 0
"""Seed of the draws: the same scenarios always give the same interval."""


@functools.cache
def _draws(scenarios: int) -> NDArray[np.intp]:
    """Return scenario numbers drawn with replacement, shape [resample, scenario]."""
    # Generator.random is the one distribution whose stream NumPy keeps across versions
    uniform = np.random.Generator(np.random.PCG64(SEED)).random((RESAMPLES, scenarios))
    return np.floor(uniform * scenarios).astype(np.intp)


def bootstrap_interval(values: ArrayLike) -> tuple[float, float]:
    """Return the 95 % percentile interval of the mean over scenarios.

    With few scenarios it is too narrow (6 give about 85 % coverage): read it as a hint.

    Args:
        values: one value per scenario, NaN where undefined (left out), shape [scenario].

    Returns:
        Lower and upper bound; NaN when fewer than two scenarios are defined.
    """
    x = np.asarray(values, np.float64)
    defined = x[~np.isnan(x)]
    if defined.size < 2:
        return math.nan, math.nan
    means = np.mean(defined[_draws(defined.size)], axis=1)
    low, high = np.quantile(means, [(1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0])
    return float(low), float(high)
