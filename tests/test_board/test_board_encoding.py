"""The encoding of the page's data: arrays as levels, bytes as text."""

from __future__ import annotations

import json
import math
import sys

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from page_reader import read_array, read_levels

from lagbench.board.encoding import LEVELS, ArrayStore, Reference, decode, encode
from lagbench.board.sampling import coarsen

# Taichi, once started in this process, makes its thread round subnormals to zero.
NUMBERS = st.floats(-1e6, 1e6, allow_subnormal=False)
GAP = st.just(float("nan"))


def restore(store: ArrayStore, reference: Reference) -> NDArray:
    """Return an array as the page's script reads it."""
    levels = read_levels(store.to_bytes())
    return read_array(levels, store.starts(), reference)


@given(
    st.lists(NUMBERS | GAP, min_size=1, max_size=40),
    st.booleans(),
)
@example([sys.float_info.min], True)
def test_numbers_come_back_within_half_a_step(
    values: list[float], prefer_logarithmic: bool
) -> None:
    """Gaps stay gaps; on a logarithmic scale half a step of the logarithm."""
    array = np.array(values)
    store = ArrayStore()
    reference = store.add(array, kind="a", prefer_logarithmic=prefer_logarithmic)
    restored = restore(store, reference)[:, 0]

    is_gap = np.isnan(array)
    assert_array_equal(np.isnan(restored), is_gap)
    is_known = ~is_gap
    half_step = 0.5 * float(reference["step"])
    zero = float(reference["zero"])
    if reference["log"]:
        is_inside = is_known & (array >= np.exp(zero))
        ratio = restored[is_inside] / array[is_inside]
        error = np.abs(np.log(ratio))
        assert np.all(error <= half_step + 1e-5)
    else:
        error = np.abs(restored[is_known] - array[is_known])
        scale = 1.0 + abs(zero)
        assert np.all(error <= half_step + 1e-5 * scale)


@pytest.mark.parametrize("low", [float(np.float32(0.1)), 1.23456789499, -3.3333333333])
@pytest.mark.parametrize("share", [1e-15, 1e-12, 1e-10])
@pytest.mark.parametrize("prefer_logarithmic", [False, True])
def test_values_that_differ_by_rounding_come_back(
    low: float, share: float, prefer_logarithmic: bool
) -> None:
    """Their range is narrower than the digits of a short zero."""
    values = np.array([low, low * (1.0 + share), math.nan, low * (1.0 + share / 2)])
    store = ArrayStore()
    reference = store.add(values, kind="a", prefer_logarithmic=prefer_logarithmic)
    restored = restore(store, reference)[:, 0]
    assert_allclose(restored, values, rtol=share + 1e-15)


@given(
    st.integers(1, 20),
    st.integers(1, 6),
    st.integers(0, 2**32),
)
def test_rows_and_columns_keep_their_places(rows: int, columns: int, seed: int) -> None:
    """Steps between rows may be as long as the whole range."""
    rng = np.random.default_rng(seed)
    values = rng.random((rows, columns))
    store = ArrayStore()
    store.add([1.0, 2.0, 4.0], kind="a")
    reference = store.add(values, kind="b")
    store.add([3.0, 5.0], kind="a")
    restored = restore(store, reference)
    assert_allclose(restored, values, atol=0.51 / LEVELS)


def test_whole_numbers_are_exact_and_stand_once() -> None:
    """Frames of many curves are the same: the second array takes no room."""
    store = ArrayStore()
    frames = [10, 11, 500, 7]
    first = store.add_whole(frames, kind="a")
    length = len(store.to_bytes())
    second = store.add_whole(frames, kind="a")
    assert first == second
    assert len(store.to_bytes()) == length
    restored = restore(store, first)
    assert restored[:, 0].tolist() == frames


@pytest.mark.parametrize("last", [32_767, 32_768, 65_536, 10_000_000])
def test_the_frames_of_a_long_rollout_are_exact(last: int) -> None:
    """Greater numbers than 16 bits hold do not wrap around."""
    store = ArrayStore()
    frames = [7, last - 1, last]
    store.add_whole([1, 2, 3], kind="a")
    reference = store.add_whole(frames, kind="a")
    assert json.loads(json.dumps(reference)) == reference
    restored = restore(store, reference)
    assert restored[:, 0].tolist() == frames


@given(st.binary(max_size=200))
def test_bytes_survive_as_text_without_markup(data: bytes) -> None:
    """Nothing in the text could end an HTML element."""
    text = encode(data)
    assert not set(text) & set("<>&\"'")
    assert decode(text, longest=len(data)) == data


@pytest.mark.parametrize(
    "text",
    [
        "",
        "AAAA",
        'no "digits"',
        "über",
        encode(bytes(10_000)),
    ],
)
def test_text_that_is_too_long_or_none_is_refused(text: str) -> None:
    """A short text may encode a long content: it is not decompressed whole."""
    with pytest.raises(ValueError):  # noqa: PT011
        decode(text, longest=9_999)


def test_coarse_field_keeps_its_mean() -> None:
    """Blocks average the known nodes: 4 x 4 nodes become 2 x 2, worked by hand."""
    field = np.arange(16.0).reshape(4, 4)
    field[0, 0] = np.nan
    # upper left block: 1, 4, 5 are known, mean 10/3
    coarse = coarsen(field, 2)
    expected = [
        [10 / 3, 4.5],
        [10.5, 12.5],
    ]
    assert_allclose(coarse, expected)
    assert_array_equal(coarsen(field, 4), field)
