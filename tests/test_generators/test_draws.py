"""Draws: seeds, distributions and bits against independent routes and published
laws.
"""

from __future__ import annotations

import hashlib
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from lagbench.errors import WorkFailedError
from lagbench.generators import draws


class Script:
    """A random source that says what it is told to, in order."""

    def __init__(self, *values: float) -> None:
        """Take what to say."""
        self.values = list(values)

    def random(
        self,
        size: tuple[int, ...],
    ) -> NDArray[np.float64]:
        """Return the next values in the wanted shape."""
        count = math.prod(size)
        first = self.values[:count]
        del self.values[:count]
        numbers = np.array(first, dtype=np.float64)
        return numbers.reshape(size)


def source(name: str = "test") -> np.random.Generator:
    """Return a stream of its own for one test."""
    stream: np.random.Generator = draws.generator("cavity", name, 1, 0)
    return stream


MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645


def pcg64(
    state: int,
    increment: int,
    count: int,
) -> list[float]:
    """Return doubles of PCG64 XSL-RR 128/64 as O'Neill (2014) defines it."""
    values = []
    for _ in range(count):
        state = (state * MULTIPLIER + increment) % 2**128
        high = state >> 64
        low = state % 2**64
        word = high ^ low
        turn = state >> 122
        right = word >> turn
        left = word << (64 - turn)
        turned = (right | left) % 2**64
        values.append((turned >> 11) * 2.0**-53)
    return values


def test_generator_is_pcg64_as_published() -> None:
    """The stream equals a second implementation of the published generator."""
    rng = draws.generator("cavity", "full", 1, 7)
    inner = rng.bit_generator.state["state"]
    expected = pcg64(inner["state"], inner["inc"], 20)
    assert rng.random(20).tolist() == expected


def test_seed_text_rebuilds_the_stream() -> None:
    """A reader gets the generator back from a file's seed: 16 hex digits of SHA-256,
    MAJOR and scenario.
    """
    digest = hashlib.sha256(b"curl-noise/mini").hexdigest()
    first_word = int(digest[:16], 16)
    entropy = draws.entropy("curl-noise", "mini", 2, 11)
    assert entropy == (first_word, 2, 11)

    seed_text = draws.seed_text("fluid", "tiny", 1, 3)
    words = [int(word) for word in seed_text.split(", ")]
    seed = np.random.SeedSequence(words)
    again = np.random.Generator(np.random.PCG64(seed))
    stream = draws.generator("fluid", "tiny", 1, 3)
    expected = stream.random(5)
    assert again.random(5).tolist() == expected.tolist()


def test_every_name_changes_the_stream() -> None:
    """Split, size, MAJOR and scenario each lead to other numbers."""
    keys = [
        ("cavity", "full", 1, 0),
        ("fluid", "full", 1, 0),
        ("cavity", "mini", 1, 0),
        ("cavity", "full", 2, 0),
        ("cavity", "full", 1, 1),
    ]
    streams = [draws.generator(*key) for key in keys]
    numbers = {stream.random() for stream in streams}
    assert len(numbers) == len(keys)


@given(st.floats(-15.9, 15.9, allow_subnormal=False))
def test_quantise_rounds_to_the_nearest_exact_float32(value: float) -> None:
    """The result is a multiple of 2^-20, the nearest one, halves to even, exact in
    float32 and stable.
    """
    quantum = 2.0**-20
    two_halves = [0.5 * quantum, 1.5 * quantum]
    halves = draws.quantise(two_halves)
    assert halves.tolist() == [0.0, 2.0 * quantum]
    result = float(draws.quantise(value))
    assert (result * 2**20).is_integer()
    assert abs(result - value) <= 2.0**-21
    assert float(np.float32(result)) == result
    assert float(draws.quantise(result)) == result
    sign = math.copysign(1.0, result)
    assert sign == 1.0 or result < 0.0


@pytest.mark.parametrize(
    "value",
    [
        16.0,
        -16.0,
        math.inf,
        math.nan,
    ],
)
def test_quantise_refuses_what_float32_would_round(value: float) -> None:
    """Too large or not finite is an error that says where to look."""
    with pytest.raises(WorkFailedError) as caught:
        draws.quantise([0.0, value])
    assert caught.value.exit_code == 5


def test_uniform_follows_its_law() -> None:
    """Kolmogorov-Smirnov against the uniform law, and both ends hold."""
    rng = source()
    values = [draws.uniform(rng, -0.3, 0.5) for _ in range(2000)]
    law = stats.uniform(-0.3, 0.8)
    test = stats.kstest(values, law.cdf)
    assert test.pvalue > 0.01
    least = draws.uniform(Script(0.0), -0.25, 0.5)
    middle = draws.uniform(Script(0.5), -0.25, 0.75)
    assert least == -0.25
    assert middle == 0.25


@given(
    u=st.floats(0.0, 1.0, exclude_max=True),
    low=st.floats(1e-3, 10.0),
    ratio=st.floats(1.0, 1e4),
)
def test_log_uniform_agrees_with_extended_precision(
    u: float,
    low: float,
    ratio: float,
) -> None:
    """It is the 80-bit result of low (high/low)^u to one unit in the last place."""
    high = low * ratio
    least = np.longdouble(low)
    most = np.longdouble(high)
    span = np.log(most / least)
    wide = least * np.exp(span * np.longdouble(u))
    expected = float(wide)
    drawn = draws.log_uniform(Script(u), low, high)
    assert drawn == pytest.approx(expected, rel=2.3e-16, abs=0.0)


def test_normal_has_the_moments_of_twelve_uniforms() -> None:
    """Mean 0, variance 1, skewness 0, excess kurtosis -6/5/12 = -0.1, nothing beyond
    six.
    """
    values = draws.normal(source(), 1.0, (100_000,))
    kurtosis = stats.kurtosis(values)
    test = stats.kstest(values[:2000], stats.norm.cdf)
    assert abs(values.mean()) < 0.01
    assert values.var() == pytest.approx(1.0, abs=0.015)
    assert abs(stats.skew(values)) < 0.03
    assert kurtosis == pytest.approx(-0.1, abs=0.05)
    assert test.pvalue > 0.01
    zeros = Script(*([0.0] * 12))
    least = draws.normal(zeros, 0.5, (1,))
    assert least.tolist() == [-3.0]
    narrow = draws.normal(source(), 0.35, (50, 2))
    wide = draws.normal(source(), 0.7, (50, 2))
    assert (2.0 * narrow == wide).all()


def test_sums_round_after_each_number() -> None:
    """Python 3.12 gives 1.0, by compensation; NumPy's running sum rounds each time."""
    values = [1e16, 1.0, -1e16]
    assert draws.add_in_order(values) == 0.0
    thirds = np.full(1000, 1.0 / 3.0)
    assert draws.add_in_order(thirds.tolist()) == np.cumsum(thirds)[-1]


def test_choice_is_fair_and_never_reaches_its_count() -> None:
    """Chi-squared over six; the largest variate below 1 gives the last choice, the
    least the first.
    """
    counts = [*range(1, 40), 10**6, 2**40 - 1, 2**40]
    for count in counts:
        largest = Script(1.0 - 2.0**-53)
        assert draws.choice(largest, count) == count - 1
        assert draws.choice(Script(0.0), count) == 0
    rng = source()
    choices = [draws.choice(rng, 6) for _ in range(3000)]
    counts_of_choices = np.bincount(choices, minlength=6)
    test = stats.chisquare(counts_of_choices)
    assert test.pvalue > 0.01


def test_direction_is_uniform_over_the_circle() -> None:
    """Unit length to rounding, angle uniform by Kolmogorov-Smirnov."""
    rng = source()
    vectors = [draws.draw_direction(rng, 2) for _ in range(2000)]
    x, y = np.transpose(vectors)
    length = np.hypot(x, y)
    np.testing.assert_allclose(length, 1.0, rtol=3e-16)
    turns = np.arctan2(x, y) / (2.0 * np.pi) + 0.5
    test = stats.kstest(turns, stats.uniform.cdf)
    assert test.pvalue > 0.01
    # Corners and the very centre are refused; (0.6, 0.8) x 1/2 is normalised.
    script = Script(0.0, 0.0, 0.5, 0.5, 0.65, 0.7)
    direction = draws.draw_direction(script, 2)
    assert direction == pytest.approx((0.6, 0.8))
    assert script.values == []
