"""From a value per frame to one number of a scenario.

NaN marks a frame that was not measured or is undefined. The means leave it out; with no
frame left the result is NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["STABLE_PEARSON", "FirstFrames", "frames_before_fall", "last", "mean", "root_mean_square"]

Floats = NDArray[np.float64]

STABLE_PEARSON = 0.8
"""A rollout is stable until the vorticity correlation falls below this."""


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
    """A reduction of the first predicted frames only; NaN when there are fewer.

    Attributes:
        count: predicted frames that are taken.
        end: whether to return the last of them instead of their mean.
    """

    count: int
    end: bool = False

    def __call__(self, values: Floats) -> float:
        """Return the mean over those frames, or the last one."""
        if len(values) < self.count:
            return math.nan
        return (last if self.end else mean)(values[: self.count])


def frames_before_fall(values: Floats) -> float:
    """Return how many frames pass before a value first lies below :data:`STABLE_PEARSON`.

    Undefined frames do not end the count but pass like others; with none defined the
    answer is NaN. A rollout that never falls gets the whole horizon.
    """
    if np.isnan(values).all():
        return math.nan
    fallen = np.flatnonzero(values < STABLE_PEARSON)
    return float(fallen[0] if fallen.size else len(values))
