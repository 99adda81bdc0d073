"""B-spline weights against SciPy, and the exactness and range of the fixed-point
sums.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.interpolate import BSpline

from lagbench.generators import backend, transfer
from lagbench.generators.language import ti
from lagbench.generators.split import Device

DX = 1.0 / 32.0


@ti.kernel
def evaluate_stencil(  # type: ignore[no-untyped-def] # noqa: ANN201
    x: ti.types.ndarray(),  # type: ignore[valid-type]
    rows: ti.types.ndarray(),  # type: ignore[valid-type]
    base: ti.types.ndarray(),  # type: ignore[valid-type]
):
    for p in range(x.shape[0]):
        place = ti.Vector([x[p, 0], x[p, 1], 0.0, 0.0])
        row = transfer.stencil(place, 32.0, 33)
        base[p] = ti.bit_cast(row[0][3], ti.i32)
        for i, j in ti.static(ti.ndrange(3, 4)):
            rows[p, i, j] = row[i][j]


@ti.kernel
def evaluate(  # type: ignore[no-untyped-def] # noqa: ANN201
    value: ti.types.ndarray(),  # type: ignore[valid-type]
    fixed: ti.types.ndarray(),  # type: ignore[valid-type]
    out: ti.types.ndarray(),  # type: ignore[valid-type]
):
    for p in range(value.shape[0]):
        fixed[p] = transfer.to_fixed(value[p])
        out[p, 0] = transfer.bounded(value[p], -1.0, 2.0)
        out[p, 1] = transfer.largest(value[p], 1.0)


@ti.kernel
def read_numbers(  # type: ignore[no-untyped-def] # noqa: ANN201
    bits: ti.types.ndarray(),  # type: ignore[valid-type]
    numbers: ti.types.ndarray(),  # type: ignore[valid-type]
    node_count: ti.template(),  # type: ignore[valid-type]
):
    for p in range(bits.shape[0]):
        numbers[p] = transfer.node_number(bits[p], node_count)


@ti.kernel
def count_weights(  # type: ignore[no-untyped-def] # noqa: ANN201
    first: ti.types.ndarray(),  # type: ignore[valid-type]
    weights: ti.types.ndarray(),  # type: ignore[valid-type]
    rows: ti.template(),  # type: ignore[valid-type]
    counts: ti.types.ndarray(),  # type: ignore[valid-type]
):
    ti.loop_config(serialize=True)
    for p in range(first.shape[0]):
        row = ti.Vector([weights[p, 0], weights[p, 1], weights[p, 2], 0.0])
        transfer.add_shifted(rows, 0, first[p] + 2, row, False)
    ti.loop_config(serialize=True)
    for n in range(counts.shape[0]):
        counts[n] = transfer.row_count(rows, 0, n)[0]


@pytest.fixture(autouse=True)
def engine() -> None:
    """Start the engine as the solver does."""
    backend.start(Device.CPU)


def test_weights_are_the_quadratic_b_spline() -> None:
    """Each weight is a product of SciPy's B-splines; moments are 1, 0 and dx^2/4; the
    rest fits.
    """
    count = 500
    rng = np.random.default_rng(0)
    share = rng.random((count, 2))
    x = (share * 0.9 + 0.05).astype(np.float32)
    rows = np.zeros((count, 3, 4), np.float32)
    base = np.zeros(count, np.int32)
    evaluate_stencil(x, rows, base)

    # distance of each of the three nodes per axis [cells], shape [point, 3, 2]
    node = np.stack(np.divmod(base, 33), axis=-1)
    step = np.arange(3)[:, None]
    nodes = node[:, None] + step
    scaled = x.astype(np.float64) / DX
    distance = nodes - scaled[:, None]
    assert np.abs(distance).max() <= 1.5

    knots = [-1.5, -0.5, 0.5, 1.5]
    basis = BSpline.basis_element(knots, extrapolate=False)
    spline = basis(distance)
    along_x = spline[:, :, None, 0]
    along_y = spline[:, None, :, 1]
    expected = along_x * along_y
    weight = rows[:, :, :3]
    assert_allclose(weight, expected, rtol=0, atol=2e-6)
    total = weight.sum(axis=(1, 2))
    assert_allclose(total, 1.0, rtol=0, atol=1e-6)
    for axis in range(2):
        along = weight.sum(axis=2 - axis)
        offset = distance[:, :, axis]
        first_moment = (along * offset).sum(axis=1)
        square = along * offset**2
        second_moment = square.sum(axis=1)
        assert_allclose(first_moment, 0.0, rtol=0, atol=4e-6)
        assert_allclose(second_moment, 0.25, rtol=0, atol=4e-6)
        stated_offset = rows[:, axis + 1, 3]
        from_middle = -offset[:, 1]
        assert_allclose(stated_offset, from_middle, rtol=0, atol=1e-6)


def test_fixed_point_is_numpys_rint() -> None:
    """Any float32 within the range becomes the integer that NumPy rounds to: halves to
    the even one.
    """
    by_hand = {
        0.5: 0,
        1.5: 2,
        2.5: 2,
        -0.5: 0,
        -1.5: -2,
        3.0: 3,
        1e-30: 0,
        0.75: 1,
        -(2.0**50): -(2**50),
        2.0**50: 2**50,
    }
    count = 20_000
    rng = np.random.default_rng(1)
    mantissa = rng.random(count) - 0.5
    exponent = rng.integers(-5, 51, count)
    drawn = mantissa * 2.0**exponent
    value = np.concatenate([list(by_hand), drawn])
    value = value.astype(np.float32)
    fixed = np.zeros(len(value), np.int64)
    bounds = np.zeros((len(value), 2), np.float32)
    evaluate(value, fixed, bounds)
    fixed_by_hand = fixed[: len(by_hand)]
    assert fixed_by_hand.tolist() == list(by_hand.values())
    expected = np.rint(value.astype(np.float64))
    np.testing.assert_array_equal(fixed, expected.astype(np.int64))


@pytest.mark.parametrize("node_count", [1, 64, 1000, 65_536])
def test_numbers_of_nodes_survive_as_bits(node_count: int) -> None:
    """A float with the bits of a node's number gives that number, for every node."""
    expected = np.arange(node_count, dtype=np.int32)
    numbers = np.zeros_like(expected)
    read_numbers(expected.view(np.float32), numbers, node_count)
    np.testing.assert_array_equal(numbers, expected)


def test_rows_count_the_weights_of_each_node() -> None:
    """Weights added in rows of three give the sum of the weights of each node."""
    node_count = 12
    rng = np.random.default_rng(2)
    first = rng.integers(0, node_count - 2, 200).astype(np.int32)
    weights = rng.integers(0, 1000, (200, 3)).astype(np.float32)
    rows = ti.Vector.field(4, ti.i64, shape=(1, node_count + 2))
    counts = np.zeros(node_count, np.int64)
    count_weights(first, weights, rows, counts)
    expected = np.zeros(node_count, np.int64)
    for step in range(3):
        np.add.at(expected, first + step, weights[:, step].astype(np.int64))
    np.testing.assert_array_equal(counts, expected)


def test_bounds_and_extremes_meet_nan() -> None:
    """What is not a number becomes the lower bound as a position, and stays visible as
    an extreme.
    """
    value = np.array([-3.0, 0.5, 7.0, np.nan, np.inf], np.float32)
    fixed = np.zeros(5, np.int64)
    out = np.zeros((5, 2), np.float32)
    evaluate(value, fixed, out)
    bounded, extreme = out.T
    expected_bounded = [-1.0, 0.5, 2.0, -1.0, 2.0]
    expected_extreme = [1.0, 1.0, 7.0, np.nan, np.inf]
    np.testing.assert_array_equal(bounded, expected_bounded)
    np.testing.assert_array_equal(extreme, expected_extreme)


@given(
    particles=st.integers(1, 2**22),
    bound=st.floats(1e-6, 1e6),
)
def test_sums_cannot_overflow(particles: int, bound: float) -> None:
    """The scale is a power of two, N bounds fit in 62 bits, and one step is far below
    float32's.
    """
    scale = transfer.fixed_point_scale(particles, bound)
    assert np.frexp(scale)[0] == 0.5
    assert scale * bound <= 2.0**50
    assert scale * bound * particles <= 2.0**62
    assert 1.0 / scale <= bound * 2.0**-38
