"""Jittered lattices that fill a square box with particles (thesis Eq. 5.44)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .draws import RandomSource, quantise

__all__ = ["fill", "fill_grid"]


def fill(rng: RandomSource, count: int, *, low: float, high: float, jitter: float) -> NDArray[np.float64]:
    """Fill a square with any number of particles, in columns of nearly equal counts.

    The columns number floor(sqrt(count)), their counts differ by one at the most, and each
    spreads its own particles evenly over the height.

    Args:
        rng: source of the jitter.
        count: particles.
        low: coordinate of the left and bottom walls [length].
        high: coordinate of the right and top walls [length].
        jitter: width of the uniform displacement, in spacings [1].

    Returns:
        Positions, multiples of 2^-20 [length], shape [particle, 2].
    """
    columns = math.isqrt(count)
    ends = [count * column // columns for column in range(columns + 1)]
    sizes = np.diff(ends)
    column = np.repeat(np.arange(columns), sizes)
    row = np.arange(count) - np.repeat(ends[:-1], sizes)
    cell = np.stack([column, row], axis=-1)
    cells = np.stack([np.full(count, columns), np.repeat(sizes, sizes)], axis=-1)
    return _place(rng, cell, cells, low=low, high=high, jitter=jitter)


def fill_grid(
    rng: RandomSource, columns: int, rows: int, *, low: float, high: float, jitter: float
) -> NDArray[np.float64]:
    """Fill a square with columns x rows particles; arguments as in :func:`fill`."""
    index = np.arange(columns * rows)
    cell = np.stack([index // rows, index % rows], axis=-1)
    cells = np.broadcast_to(np.array([columns, rows]), cell.shape)
    return _place(rng, cell, cells, low=low, high=high, jitter=jitter)


def _place(
    rng: RandomSource,
    cell: NDArray[np.integer],
    cells: NDArray[np.integer],
    *,
    low: float,
    high: float,
    jitter: float,
) -> NDArray[np.float64]:
    """Put a particle near the middle of its cell: base position + (r - 1/2) jitter spacing."""
    displacement = (rng.random(cell.shape) - 0.5) * jitter
    return quantise(low + (high - low) * (cell + 0.5 + displacement) / cells)
