"""Statistics of train: right, and the same digits however the data arrive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scenario_factory import frames_of, make_key, write_scenario

from lagbench.data.checksums import round_digits
from lagbench.data.statistics import (
    combine,
    file_statistics,
    scenario_moments,
    statistics,
)
from lagbench.errors import DataError


def test_by_hand() -> None:
    """Two particles, three frames, every number worked by hand.

    x: 0, 1, 4 and 0, 3, 4, so u: 1, 3 and 3, 1, so a: 2 and -2; y stays 0.5.
    """
    x = np.array([[0, 0], [1, 3], [4, 4]], np.float32)
    frames = np.stack([x, np.full_like(x, 0.5)], axis=-1)
    result = statistics([scenario_moments(frames)])
    assert result["position_mean"] == (2.0, 0.5)
    # mean of squares (1 + 9 + 16 + 16) / 6 = 7, minus 4
    assert result["position_std"] == (round_digits(3**0.5), 0.0)
    assert result["velocity_mean"] == (2.0, 0.0)
    assert result["velocity_std"] == (1.0, 0.0)
    assert result["acceleration_mean"] == (0.0, 0.0)
    assert result["acceleration_std"] == (2.0, 0.0)
    # One frame has no velocity: no statistic is invented for it.
    short = scenario_moments(np.zeros((1, 4, 2), np.float32))
    assert set(statistics([short])) == {"position_mean", "position_std"}
    longer = scenario_moments(frames_of(1, 6, 4))
    assert (
        statistics([short, longer])["velocity_std"]
        == statistics([longer])["velocity_std"]
    )
    # Nine significant digits, no negative zero.
    assert [round_digits(x) for x in (1 / 3, -2.19123456789e-3)] == [
        0.333333333,
        -2.19123457e-3,
    ]
    assert str(round_digits(-0.0)) == "0.0"


def test_against_numpy() -> None:
    """Several scenarios of unequal length agree with NumPy on the concatenated
    arrays.
    """
    runs = [
        frames_of(i, frames, 50).astype(np.float64)
        for i, frames in enumerate((9, 4, 17))
    ]
    result = statistics(scenario_moments(run.astype(np.float32)) for run in runs)
    for order, name in enumerate(("position", "velocity", "acceleration")):
        values = np.concatenate(
            [np.diff(run, n=order, axis=0).reshape(-1, 2) for run in runs]
        )
        assert_allclose(
            result[f"{name}_mean"],
            values.mean(axis=0),
            rtol=1e-7,
            atol=1e-12,
        )
        assert_allclose(result[f"{name}_std"], values.std(axis=0), rtol=1e-8)


@settings(deadline=None)
@given(st.permutations(range(5)), st.integers(1, 4))
def test_order_and_grouping_do_not_matter(order: list[int], groups: int) -> None:
    """Any order gives the very same moments, any grouping over workers the same nine
    digits.
    """
    runs = [scenario_moments(frames_of(i, 3 + i, 33)) for i in range(5)]
    parts = [
        combine([runs[i] for i in order[start::groups]]) for start in range(groups)
    ]
    assert statistics(parts) == statistics(runs)
    assert combine([runs[i] for i in order]) == combine(runs)


@settings(deadline=None)
@given(st.integers(0, 100), st.permutations(range(64)))
def test_means_do_not_depend_on_the_order_of_particles(
    seed: int, order: list[int]
) -> None:
    """Sums over a frame are exact, so no summation order of any NumPy can change a
    mean.
    """
    run = frames_of(seed, 5, 64)
    whole = scenario_moments(run)
    permuted = scenario_moments(run[:, order])
    assert {n: m.total for n, m in whole.items()} == {
        n: m.total for n, m in permuted.items()
    }


def test_files_give_the_same_as_arrays(tmp_path: Path) -> None:
    """Streaming stored frames gives the digits of the frames in memory, whatever the
    block.
    """
    paths = [
        write_scenario(tmp_path, make_key(i), frames=3 + i, particles=9000)[0]
        for i in (0, 1)
    ]
    expected = statistics(scenario_moments(frames_of(i, 3 + i, 9000)) for i in (0, 1))
    assert file_statistics(paths) == expected
    with pytest.raises(DataError):
        file_statistics([])
