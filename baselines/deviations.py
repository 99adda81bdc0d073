"""Standard deviations by which models divide."""

from __future__ import annotations

import math
from collections.abc import Sequence


def replace_zeros(deviations: Sequence[float]) -> tuple[float, ...]:
    """Return deviations by which numbers can be divided.

    The deviation of a component that never varies is exactly 0. The root mean square of
    all stands in its place, and 1 where nothing varies.
    """
    if all(deviation != 0.0 for deviation in deviations):
        return tuple(deviations)
    mean_square = math.fsum(std * std for std in deviations) / len(deviations)
    typical = math.sqrt(mean_square) or 1.0
    return tuple(std or typical for std in deviations)
