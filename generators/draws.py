"""Seeded draws whose bits are the same on every x86-64 Linux CPU.

Two rules keep them so. Random bits come only from ``Generator.random``, the one
distribution of NumPy that never changes for PCG64. What is done with them is + - * /
sqrt, floor and comparison, which IEEE 754 rounds in one way only, or ``decimal``, whose
``exp`` and ``ln`` are correctly rounded by its specification; ``exp``, ``log`` and
``pow`` of a C library are not.

Jittered lattices fill a square box with particles (thesis Eq. 5.44).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable
from decimal import Context, Decimal
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.errors import WorkFailedError

Array = NDArray[np.float64]

# grain of everything that enters the solver; multiples below 16 are exact in float32
QUANTUM = 2.0**-20
_LARGEST = 16.0
_PRECISE = Context(prec=50)


class RandomSource(Protocol):
    """The part of ``numpy.random.Generator`` that draws may use."""

    def random(self, size: tuple[int, ...]) -> Array:
        """Return uniform variates on [0, 1), multiples of 2^-53."""


def entropy(
    split: str,
    size: str,
    major: int,
    scenario: int,
    draw_seed: str | None = None,
) -> tuple[int, ...]:
    """Return what seeds a scenario: a word of its data set, its version and its id.

    The word is the first eight bytes of SHA-256("split/size"), big-endian. The seed of
    a blind test, four words of eight bytes, takes the place of that word and the
    version.

    Args:
        split: name of the split.
        size: name of the size.
        major: MAJOR of the version.
        scenario: id of the scenario.
        draw_seed: seed of a blind test [64 hex digits].

    >>> entropy("cavity", "tiny", 1, 3)[1:]
    (1, 3)
    >>> entropy("cavity", "tiny", 1, 3, draw_seed=64 * "1")[3:]
    (1229782938247303441, 3)
    """
    if draw_seed is not None:
        seed_bytes = bytes.fromhex(draw_seed)
        words = []
        for start in range(0, len(seed_bytes), 8):
            word = int.from_bytes(seed_bytes[start : start + 8], "big")
            words.append(word)
        return (*words, scenario)
    name = f"{split}/{size}"
    name_hash = hashlib.sha256(name.encode())
    digest = name_hash.digest()
    eight_bytes = digest[:8]
    word = int.from_bytes(eight_bytes, "big")
    return word, major, scenario


def generator(
    split: str,
    size: str,
    major: int,
    scenario: int,
    draw_seed: str | None = None,
) -> np.random.Generator:
    """Return the PCG64 stream of one scenario, a function of its names only."""
    words = entropy(split, size, major, scenario, draw_seed)
    seed = np.random.SeedSequence(words)
    return np.random.Generator(np.random.PCG64(seed))


def seed_text(
    split: str,
    size: str,
    major: int,
    scenario: int,
    draw_seed: str | None = None,
) -> str:
    """Return the seed as the files state it, for ``SeedSequence([...])``."""
    words = entropy(split, size, major, scenario, draw_seed)
    return ", ".join(str(word) for word in words)


def quantise(values: ArrayLike) -> Array:
    """Round to the nearest multiple of 2^-20, halves to even.

    Such a number below 16 in magnitude is exact in float32, so that nothing is rounded
    again on its way into the solver. Negative zero becomes zero.
    """
    exact = np.asarray(values, dtype=np.float64)
    magnitude = np.abs(exact)
    if not np.all(magnitude < _LARGEST):
        raise WorkFailedError(
            f"a drawn value has no exact float32 form: got {float(np.max(magnitude))}, "
            f"expected finite, magnitude below {_LARGEST}; check the ranges and scales "
            "in the file of the split",
            where="a draw",
        )
    rounded = np.rint(exact / QUANTUM) * QUANTUM
    # rint keeps the sign of -0.0, the addition of zero does not
    return np.asarray(rounded + 0.0, dtype=np.float64)


def add_in_order(values: Iterable[float]) -> float:
    """Return the sum of some numbers, added one after the other and rounded each time.

    The built-in ``sum`` does so in Python 3.11 only: later ones carry the rounding
    errors along, and would give other bits.

    >>> add_in_order([1e16, 1.0, -1e16])
    0.0
    """
    total = 0.0
    for value in values:
        total += value
    return total


def draw_offsets(
    rng: RandomSource, shape: tuple[int, int], *, subdivision: int
) -> Array:
    """Draw offsets from the places of a lattice, in [-1/2, 1/2).

    A lattice that is finer by a factor takes its numbers from a stream of its own, and
    the scenario's stream goes on as if the lattice were not finer. So a scenario is the
    same at every refinement.

    Args:
        rng: the scenario's stream.
        shape: particles and axes.
        subdivision: the factor by which the lattice is finer along each axis.
    """
    coarse_count, dimension = shape
    for _ in range(dimension):
        coarse_count //= subdivision
    unit = rng.random((coarse_count, dimension))
    if subdivision > 1:
        # four words of 53 bits seed the finer stream
        words = [int(value * 2.0**53) for value in unit.ravel()[:4].tolist()]
        seed = np.random.SeedSequence(words)
        unit = np.random.Generator(np.random.PCG64(seed)).random(shape)
    return unit - 0.5


def _draw_unit(rng: RandomSource) -> float:
    """Draw from the uniform distribution on [0, 1)."""
    (share,) = rng.random((1,))
    return float(share)


def uniform(rng: RandomSource, low: float, high: float) -> float:
    """Draw uniformly from [low, high), rounded to a multiple of 2^-20."""
    share = _draw_unit(rng)
    value = low + (high - low) * share
    return float(quantise(value))


def log_uniform(rng: RandomSource, low: float, high: float) -> float:
    """Draw x = low exp(u ln(high / low)), uniform in its logarithm.

    It is computed in 50 decimal digits and rounded once.
    """
    if not 0.0 < low <= high:
        raise WorkFailedError(
            f"a log-uniform range is empty: got {(low, high)}, expected 0 < low <= "
            "high; check the ranges in the file of the split",
            where="a draw",
        )
    exact_low = Decimal(low)
    exact_high = Decimal(high)
    ratio = _PRECISE.divide(exact_high, exact_low)
    span = _PRECISE.ln(ratio)
    share = Decimal(_draw_unit(rng))
    exponent = _PRECISE.multiply(span, share)
    growth = _PRECISE.exp(exponent)
    value = _PRECISE.multiply(exact_low, growth)
    return float(value)


def normal(rng: RandomSource, deviation: float, shape: tuple[int, ...]) -> Array:
    """Draw nearly normal variates of mean 0: twelve uniforms, minus six (Irwin-Hall).

    Mean, variance and skewness are the normal ones, the excess kurtosis is -0.1, and
    nothing lies beyond six deviations, which suits an initial velocity.
    """
    total = np.full(shape, -6.0)
    for _ in range(12):
        unit = rng.random(shape)
        total = total + unit
    return deviation * total


def choice(rng: RandomSource, count: int) -> int:
    """Draw an integer from 0 to ``count - 1``, each equally likely (to 2^-53)."""
    share = _draw_unit(rng)
    return math.floor(share * count)


def draw_integer(rng: RandomSource, low: float, high: float) -> int:
    """Draw an integer, end points included."""
    first = int(low)
    count = int(high) - first + 1
    return first + choice(rng, count)


def draw_direction(rng: RandomSource, dimension: int) -> tuple[float, ...]:
    """Draw a unit vector, uniform over the circle or sphere, without sine or cosine."""
    # until a point of the cube lies in the unit ball, and not at its very centre
    while True:
        vector = 2.0 * rng.random((dimension,)) - 1.0
        square = square_sum(vector)
        if 2.0**-20 <= square <= 1.0:
            return tuple((vector / math.sqrt(square)).tolist())


def square_sum(values: Array) -> float:
    """Return the sum of the squares of all numbers, rounded once."""
    return math.fsum([number * number for number in values.ravel().tolist()])


def draw_program(
    rng: RandomSource,
    frame_count: int,
    *,
    amplitude: float,
    knot_gap: tuple[float, float],
) -> Array:
    """Draw the values of a program towards each frame, shape [frame].

    A program is smooth: the speed of a wall, or a body force. Its knots have values
    from [-A, A], of the other sign at each knot. Between two knots, at frames t0 and t1
    with values a and b, the value is

        f(t) = a + (b - a) s^2 (3 - 2 s),    s = (t - t0) / (t1 - t0).

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
        gap = draw_integer(rng, *knot_gap)
        end = start + gap
        end_value = uniform(rng, 0.0, amplitude)
        if start_value > 0.0:
            end_value = -end_value
        values_end = min(end, frame_count)
        frames = np.arange(values_end - start)  # since the knot
        s = frames / (end - start)
        gain = (end_value - start_value) * (s * s * (3.0 - 2.0 * s))
        values[start:end] = start_value + gain
        start = end
        start_value = end_value
    return quantise(values)


def fill(
    rng: RandomSource,
    count: int,
    *,
    low: float,
    high: float,
    jitter: float,
    subdivision: int = 1,
) -> Array:
    """Fill a square with any number of particles, in columns of nearly equal counts.

    There are floor(sqrt(count)) columns. The numbers of their particles differ by one
    at the most. Each column spreads its particles evenly over the height.

    Args:
        rng: source of the jitter.
        count: number of particles, at least one.
        low: coordinate of the left and bottom walls [length].
        high: coordinate of the right and top walls [length].
        jitter: width of the uniform displacement, in spacings [1].
        subdivision: as in :func:`draw_offsets`.

    Returns:
        Positions [length], multiples of 2^-20, shape [particle, 2].
    """
    columns = math.isqrt(count)
    ends = count * np.arange(columns + 1) // columns
    column_sizes = np.diff(ends)
    # column and row of each particle's cell, shape [particle]
    column = np.repeat(np.arange(columns), column_sizes)
    row = np.arange(count) - np.repeat(ends[:-1], column_sizes)
    cell = np.stack([column, row], axis=-1)
    # cells across the square each way, shape [particle, 2]
    rows_across = np.repeat(column_sizes, column_sizes)
    cell_counts = np.stack([np.full(count, columns), rows_across], axis=-1)

    centred = draw_offsets(rng, cell.shape, subdivision=subdivision)
    place = cell + 0.5 + centred * jitter  # [cells]
    return quantise(low + (high - low) * place / cell_counts)
