"""The fringe of a full box: the part in which the velocity is drawn to a stream.

There the fluid has the acceleration sigma (U - v) more, with the stream U and the rate

    sigma(x) = 16 s^2 (1 - s)^2 sigma_max,    s = (x - start) / length from 0 to 1,

and 0 elsewhere (Nordstrom, Nordin and Henningson, SIAM J. Sci. Comput. 20 (1999) 1365).
A wake dies in it, so that a box that is periodic along x has an even stream at its
start.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["fringe_rates"]


def fringe_rates(
    place: NDArray[np.float64], *, end: float, length: float, rate: float
) -> NDArray[np.float64]:
    """Return the rate at which the fringe draws to the stream [1/s].

    >>> fringe_rates(np.array([0.5, 0.875, 1.0]), end=1.0, length=0.25, rate=20.0)
    array([ 0., 20.,  0.])

    Args:
        place: coordinates along x [length].
        end: coordinate at which the fringe ends [length].
        length: of the fringe [length].
        rate: in the middle of the fringe [1/s]; 0 for no fringe, whatever the length.
    """
    if rate == 0.0:
        return np.zeros_like(place)
    share = np.clip((place - (end - length)) / length, 0.0, 1.0)
    rest = 1.0 - share
    return 16.0 * rate * (share * share) * (rest * rest)
