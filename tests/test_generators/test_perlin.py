"""Derivatives, Perlin noise and the stream function by other routes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from lagbench.generators import curl_noise, draws, noise
from lagbench.generators.periodic_noise import Smooth, coordinate

LOW = 0.0375
HIGH = 0.9625
NUMBERS = st.floats(-2, 2, allow_subnormal=False)

Array = NDArray[np.float64]


def points(
    count: int,
    low: float = 0.0,
    high: float = 1.0,
) -> Array:
    """Return reproducible points of a square."""
    rng = np.random.Generator(np.random.PCG64(5))
    share = rng.random((count, 2))
    return low + (high - low) * share


def noise_by_hand(x: float, y: float, lattice: Array) -> float:
    """Perlin noise as thesis Eqs. 5.40 and 5.41 spell it, one point at a time."""
    last_cell = len(lattice) - 2
    i = min(int(x), last_cell)
    j = min(int(y), last_cell)

    def dot(k: int, m: int) -> float:
        slope_x, slope_y = lattice[i + k, j + m]
        offset_x = x - i - k
        offset_y = y - j - m
        return float(slope_x * offset_x + slope_y * offset_y)

    def fade(t: float) -> float:
        return 6 * t**5 - 15 * t**4 + 10 * t**3

    def lerp(t: float, a: float, b: float) -> float:
        return a + t * (b - a)

    u = fade(x - i)
    w = fade(y - j)
    left = lerp(w, dot(0, 0), dot(0, 1))
    right = lerp(w, dot(1, 0), dot(1, 1))
    return lerp(u, left, right)


def psi_by_hand(
    position: Array,
    lattice: Array,
    scale: float,
) -> float:
    """The windowed stream function at one point, from its definition."""
    frequency = len(lattice) - 1
    width = HIGH - LOW
    x, y = (position - LOW) / width
    value = noise_by_hand(x * frequency, y * frequency, lattice)
    value *= scale * width
    distances = [x, 1 - x, y, 1 - y]
    for wall in distances:
        t = 2 * frequency * wall
        if t < 1:
            ramp = 15 * t - 10 * t**3 + 3 * t**5
            value *= ramp / 8
    return float(value)


def axes_of(position: Array) -> list[Smooth]:
    """Return both coordinates as functions of the position."""
    return [coordinate(position[:, axis], axis, 2) for axis in range(2)]


def lattice_of(frequency: int) -> Array:
    """Return the gradients of a test lattice."""
    rng = draws.generator("curl-noise", "test", 1, frequency)
    return np.asarray(noise.gradients(rng, frequency))


def stream(position: Array, lattice: Array) -> Smooth:
    """Return the stream function of scale 0.01 and its derivatives."""
    return curl_noise.stream_function(
        position,
        lattice,
        low=LOW,
        high=HIGH,
        scale=0.01,
    )


@given(
    coefficients=st.lists(NUMBERS, min_size=1, max_size=6),
    x=NUMBERS,
    y=NUMBERS,
)
def test_products_differentiate_polynomials(
    coefficients: list[float],
    x: float,
    y: float,
) -> None:
    """The Hessian of p(x y) follows from p' and p'' by hand (chain rule)."""
    point = np.array([[x, y]])
    jet_x, jet_y = axes_of(point)
    product = jet_x * jet_y
    p = product.polynomial(*coefficients)
    exact = Polynomial(coefficients)
    first = exact.deriv(1)(x * y)
    second = exact.deriv(2)(x * y)
    across = first + x * y * second
    hessian = np.array([[y * y * second, across], [across, x * x * second]])
    assert p.value == pytest.approx(exact(x * y), rel=1e-9, abs=1e-9)
    assert p.gradient[0] == pytest.approx([y * first, x * first], rel=1e-9, abs=1e-9)
    assert p.hessian[0] == pytest.approx(hessian, rel=1e-9, abs=1e-9)


def test_noise_is_zero_with_the_drawn_slope_at_every_node() -> None:
    """Gradient noise: value 0 and gradient g at the nodes, the far corner included."""
    lattice = lattice_of(3)
    node = np.array(list(np.ndindex(4, 4)), float)
    x, y = axes_of(node)
    field = noise.noise(x, y, lattice)
    assert_allclose(field.value, 0.0, atol=1e-15)
    expected = lattice.reshape(-1, 2)
    assert_allclose(field.gradient, expected, atol=1e-14)
    large = lattice_of(13).reshape(-1, 2)  # unit vectors, no two alike
    length = np.hypot(*large.T)
    assert_allclose(length, 1.0, rtol=3e-16)
    distinct = np.unique(large, axis=0)
    assert len(distinct) == 14 * 14


@given(
    x=st.floats(0.0, 5.0),
    y=st.floats(0.0, 5.0),
)
def test_noise_equals_the_thesis_formula(x: float, y: float) -> None:
    """The vectorised jet and a scalar transcription of Eqs. 5.40 and 5.41 agree."""
    lattice = lattice_of(5)
    position = np.array([[x, y]])
    point = axes_of(position)
    field = noise.noise(*point, lattice)
    expected = noise_by_hand(x, y, lattice)
    value = field.value[0]
    assert value == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize("frequency", [1, 2, 4, 13])
def test_flow_is_the_rotated_gradient_by_numerical_differentiation(
    frequency: int,
) -> None:
    """Velocity: u = dpsi/dy and v = -dpsi/dx of the formula, differenced over 2e-6."""
    lattice = lattice_of(frequency)
    step = 1e-6
    position = points(60, LOW + 0.001, HIGH - 0.001)
    psi = stream(position, lattice)
    steps = step * np.eye(2)
    for term, offset in zip(psi.gradient.T, steps, strict=True):
        slopes = []
        for point in position:
            above = psi_by_hand(point + offset, lattice, 0.01)
            below = psi_by_hand(point - offset, lattice, 0.01)
            rise = above - below
            slopes.append(rise / (2 * step))
        assert_allclose(term, slopes, atol=2e-9 * frequency)


@pytest.mark.parametrize("frequency", [1, 4, 13])
def test_no_flow_crosses_the_walls(frequency: int) -> None:
    """The normal velocity is exactly 0 on each wall; the flow along it is not."""
    share = np.arange(101) / 100
    along = LOW + (HIGH - LOW) * share
    lattice = lattice_of(frequency)
    for wall in (LOW, HIGH):
        across = np.full(101, wall)
        upright = np.stack([across, along], axis=-1)
        level = np.stack([along, across], axis=-1)
        side = stream(upright, lattice).gradient
        floor = stream(level, lattice).gradient
        assert not side[:, 1].any()
        assert not floor[:, 0].any()
        speed_at_side = np.abs(side[:, 0])
        speed_at_floor = np.abs(floor[:, 1])
        assert speed_at_side.max() > 1e-4
        assert speed_at_floor.max() > 1e-4
