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


def test_statistics_of_two_particles_by_hand() -> None:
    """Two particles, three frames, every number worked by hand.

    x: 0, 1, 4 and 0, 3, 4, so u: 1, 3 and 3, 1, so a: 2 and -2; y stays 0.5.
    """
    x = np.array([[0, 0], [1, 3], [4, 4]], np.float32)
    frames = np.stack([x, np.full_like(x, 0.5)], axis=-1)
    moments = scenario_moments(frames)
    result = statistics([moments])
    assert result["position_mean"] == (2.0, 0.5)
    # mean of squares (1 + 9 + 16 + 16) / 6 = 7, minus 4
    assert result["position_std"] == (round_digits(3**0.5), 0.0)
    assert result["velocity_mean"] == (2.0, 0.0)
    assert result["velocity_std"] == (1.0, 0.0)
    assert result["acceleration_mean"] == (0.0, 0.0)
    assert result["acceleration_std"] == (2.0, 0.0)
    # One frame has no velocity: no statistic is invented for it.
    one_frame = np.zeros((1, 4, 2), np.float32)
    short = scenario_moments(one_frame)
    names = set(statistics([short]))
    assert names == {"position_mean", "position_std"}
    longer = scenario_moments(frames_of(1, 6, 4))
    of_both = statistics([short, longer])
    of_longer = statistics([longer])
    assert of_both["velocity_std"] == of_longer["velocity_std"]
    # Nine significant digits, no negative zero.
    assert round_digits(1 / 3) == 0.333333333
    assert round_digits(-2.19123456789e-3) == -2.19123457e-3
    assert str(round_digits(-0.0)) == "0.0"


def test_statistics_agree_with_numpy() -> None:
    """Several scenarios of unequal length agree with NumPy on the concatenated
    arrays.
    """
    runs = []
    for scenario, frame_count in enumerate((9, 4, 17)):
        runs.append(frames_of(scenario, frame_count, 50))
    result = statistics([scenario_moments(run) for run in runs])
    for order, name in enumerate(("position", "velocity", "acceleration")):
        differences = []
        for run in runs:
            difference = np.diff(run.astype(np.float64), n=order, axis=0)
            differences.append(difference.reshape(-1, 2))
        values = np.concatenate(differences)
        mean = values.mean(axis=0)
        std = values.std(axis=0)
        assert_allclose(result[f"{name}_mean"], mean, rtol=1e-7, atol=1e-12)
        assert_allclose(result[f"{name}_std"], std, rtol=1e-8)


@settings(deadline=None)
@given(st.permutations(range(5)), st.integers(1, 4))
def test_order_and_grouping_do_not_matter(order: list[int], groups: int) -> None:
    """Any order gives the very same moments, any grouping over workers the same nine
    digits.
    """
    moments = []
    for scenario in range(5):
        run = frames_of(scenario, 3 + scenario, 33)
        moments.append(scenario_moments(run))
    reordered = [moments[scenario] for scenario in order]
    parts = [combine(reordered[start::groups]) for start in range(groups)]
    assert statistics(parts) == statistics(moments)
    assert combine(reordered) == combine(moments)


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
    assert whole.keys() == permuted.keys()
    for name, moments in whole.items():
        assert permuted[name].total == moments.total


def test_files_give_the_same_as_arrays(tmp_path: Path) -> None:
    """Streaming stored frames gives the digits of the frames in memory, whatever the
    block.
    """
    paths = []
    moments = []
    for scenario in (0, 1):
        frame_count = 3 + scenario
        key = make_key(scenario)
        path, _ = write_scenario(tmp_path, key, frames=frame_count, particles=9000)
        paths.append(path)
        run = frames_of(scenario, frame_count, 9000)
        moments.append(scenario_moments(run))
    expected = statistics(moments)
    assert file_statistics(paths) == expected
    with pytest.raises(DataError):
        file_statistics([])
