"""Smooth random programs of what drives a flow: the speed of a wall, a body force.

A program has knots with values drawn from [-A, A], of the other sign at each knot.
Between two knots, at frames t0 and t1 with values a and b, the value is

    f(t) = a + (b - a) s^2 (3 - 2 s),    s = (t - t0) / (t1 - t0).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .draws import RandomSource, choice, quantise, uniform

__all__ = ["draw_integer", "draw_program"]


def draw_integer(rng: RandomSource, low: float, high: float) -> int:
    """Draw an integer, end points included."""
    return int(low) + choice(rng, int(high) - int(low) + 1)


def draw_program(
    rng: RandomSource,
    frame_count: int,
    *,
    amplitude: float,
    knot_gap: tuple[float, float],
) -> NDArray[np.float64]:
    """Draw the values of a program towards each frame, shape [frame].

    Args:
        rng: source of the knots.
        frame_count: frames that the program lasts.
        amplitude: A, the largest absolute value of a knot.
        knot_gap: least and greatest distance between two knots [frame].
    """
    values = np.empty(frame_count)
    start = 0
    start_value = uniform(rng, -amplitude, amplitude)
    while start < frame_count:
        end = start + draw_integer(rng, *knot_gap)
        end_value = uniform(rng, 0.0, amplitude)
        if start_value > 0.0:
            end_value = -end_value
        s = np.arange(min(end, frame_count) - start) / (end - start)
        rise = s * s * (3.0 - 2.0 * s)
        values[start:end] = start_value + (end_value - start_value) * rise
        start = end
        start_value = end_value
    return quantise(values)
