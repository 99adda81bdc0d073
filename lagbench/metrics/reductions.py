"""From values per frame to other values per frame, or to one number of a scenario.

NaN marks a frame that was not measured or is undefined. The means leave it out; with no
frame left the result is NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "SCALE_FLOOR",
    "STABLE_PEARSON",
    "FirstFrames",
    "floored_quotient",
    "frames_before_fall",
    "last",
    "mean",
    "quotient",
    "root_mean_square",
]

Floats = NDArray[np.float64]

STABLE_PEARSON = 0.8
"""A rollout is stable until the vorticity correlation falls below this."""

SCALE_FLOOR = 1e-3
"""Share of the truth's greatest value below which errors are no longer scaled by its value."""


def quotient(numerator: Floats, denominator: Floats) -> Floats:
    """Return the ratio of two series, NaN where the denominator is 0, shape [frame]."""
    ratio = np.full(len(numerator), np.nan)
    np.divide(numerator, denominator, out=ratio, where=denominator != 0.0)
    return ratio


def floored_quotient(error: Floats, scale: Floats) -> Floats:
    """Return ``error / max(scale, 1e-3 max(scale))``, shape [frame]; NaN where all scales are 0.

    The floor keeps frames in which the truth rests from ruling the mean.
    """
    greatest = np.max(scale, initial=0.0, where=~np.isnan(scale))
    return quotient(error, np.maximum(scale, SCALE_FLOOR * greatest))


def mean(values: Floats) -> float:
    """Return the mean over the defined frames."""
    defined = values[~np.isnan(values)]
    return float(np.mean(defined)) if defined.size else math.nan


def root_mean_square(values: Floats) -> float:
    """Return ``sqrt(mean(values^2))``: for RMSE per frame, the root of the frame mean of MSE."""
    return math.sqrt(mean(values**2))


def last(values: Floats) -> float:
    """Return the value at the last frame (Eq. 4.18)."""
    return float(values[-1])


@dataclass(frozen=True)
class FirstFrames:
    """A reduction of the first predicted frames only; NaN when there are fewer."""

    count: int  # predicted frames that are taken
    end: bool = False  # whether to return the last of them instead of their mean

    def __call__(self, values: Floats) -> float:
        """Return the mean over those frames, or the last one."""
        if len(values) < self.count:
            return math.nan
        return (last if self.end else mean)(values[: self.count])


def frames_before_fall(values: Floats) -> float:
    """Return how many defined frames pass before one first lies below :data:`STABLE_PEARSON`.

    Undefined frames neither end the count nor count: standing still is no merit. With none
    defined the answer is NaN. A rollout that is always defined and never falls gets the whole
    horizon.
    """
    defined = values[~np.isnan(values)]
    if not defined.size:
        return math.nan
    fallen = np.flatnonzero(defined < STABLE_PEARSON)
    return float(fallen[0] if fallen.size else defined.size)
