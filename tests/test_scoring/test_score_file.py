"""scores.nc and scores.json as files: size and damage."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal, assert_equal
from score_bench import ScoreBench, straight

from lagbench.errors import UnreadableFileError
from lagbench.metrics import Tally, aggregate, select
from lagbench.metrics.aggregate import round_statistics
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score_file import read_statistics, write_statistics
from lagbench.scoring.task import SUBMISSION

MAX_BYTES = 300_000
SCENARIOS = range(54, 60)


@pytest.fixture(scope="module")
def card(bench: ScoreBench, tmp_path_factory: pytest.TempPathFactory) -> ScoreCard:
    """The score card of constant velocity, written."""
    folder = tmp_path_factory.mktemp("card")
    path = bench.submit(folder / "predictions.nc", straight)
    return bench.score(path)


def metric_names(card: ScoreCard) -> tuple[str, ...]:
    """Return the names of the metrics of the submission."""
    return card.tallies[SUBMISSION][3].names


def replace_tallies(card: ScoreCard, tallies: dict[int, Tally]) -> ScoreCard:
    """Return a card with other tallies; references have no such scenarios."""
    return replace(
        card,
        tallies={SUBMISSION: tallies},
        scores={SUBMISSION: card.submission},
        skill=None,
    )


def scattered_tallies(
    names: tuple[str, ...], rng: np.random.Generator
) -> dict[int, Tally]:
    """Return tallies whose values scatter by a hundredth in each of 598 frames.

    As in multimaterial full, every scenario has two of the four materials, and
    transport is measured in two frames.
    """
    frames = tuple(range(2, 600))
    shape = (len(names), len(frames))
    levels = 10.0 ** rng.uniform(-6, 0, (len(names), 1))
    transport_row = names.index("sliced_w2")
    missing_materials = [
        ("jelly", "snow"),
        ("snow", "rope"),
        ("liquid", "rope"),
    ]
    tallies = {}
    for scenario, missing in zip(SCENARIOS, 2 * missing_materials, strict=True):
        weight = np.zeros(shape, np.int64)
        for row, name in enumerate(names):
            if not name.endswith(missing):
                weight[row] = 1
        weight[transport_row, 1:-1] = 0
        scatter = 0.01 * rng.standard_normal(shape)
        values = np.where(weight, levels * (1 + scatter), 0.0)
        undefined = np.zeros_like(weight)
        tally = Tally(names, frames, values, weight, undefined)
        tallies[scenario] = round_statistics(tally)
    return tallies


def test_six_scenarios_of_598_frames_take_300_kb(
    card: ScoreCard, tmp_path: Path
) -> None:
    """Their scores follow from the file."""
    path = tmp_path / "scores.nc"
    rng = np.random.Generator(np.random.PCG64(1))
    large = replace_tallies(card, scattered_tallies(metric_names(card), rng))
    write_statistics(large, path)
    assert 100_000 < path.stat().st_size <= MAX_BYTES

    statistics = read_statistics(str(path))
    metrics = select(statistics.tallies[54].names)
    expected = aggregate(metrics, large.tallies[SUBMISSION])
    scores = statistics.scores()
    for name, score in expected.items():
        assert_equal(scores[name].mean, score.mean)


def test_stored_statistics_saturate_at_the_largest_float32() -> None:
    """Undefined values are counted."""
    largest = float(np.finfo(np.float32).max)
    tenth = float(np.float32(0.1))
    values = {
        "a": 1e300,
        "b": -1e300,
        "c": 0.1,
        "d": math.nan,
    }
    tally = Tally.of("abcd", (0,), {0: values})
    stored = round_statistics(tally)
    expected = [largest, -largest, tenth, 0.0]
    assert_array_equal(stored.total[:, 0], expected)
    undefined = stored.undefined[:, 0]
    assert undefined.tolist() == [0, 0, 0, 1]


def test_long_rollouts_are_stored_in_eleven_bits() -> None:
    """0 and 1 stay as they are; to round twice is to round once."""
    largest = float(np.finfo(np.float32).max)
    values_by_frame = {}
    for frame in range(101):
        values_by_frame[frame] = {
            "a": 1e-9 * math.pi**frame,
            "b": 0.0,
            "c": 1.0,
            "d": -1e300,
        }
    tally = Tally.of("abcd", range(101), values_by_frame)
    stored = round_statistics(tally)

    # Later values of the first row are beyond float32.
    growing = stored.total[0, :80]
    expected = tally.total[0, :80]
    assert_allclose(growing, expected, rtol=2.0**-11)
    mantissa, _ = np.frexp(growing)
    bits_beyond = mantissa * 2**11 % 1
    assert len(np.unique(bits_beyond)) == 1
    constant_rows = [set(row) for row in stored.total[1:]]
    assert constant_rows == [{0.0}, {1.0}, {-largest}]
    again = round_statistics(stored)
    assert_array_equal(again.total[:3], stored.total[:3])


def test_scores_nc_reads_back_to_the_bit(card: ScoreCard) -> None:
    statistics = read_statistics(card.files[1])
    assert statistics.predictions_sha256 == card.predictions_sha256
    scores = statistics.scores()
    assert list(scores) == list(card.submission)
    for name, score in scores.items():
        expected = card.submission[name]
        assert_array_equal(score.values, expected.values, err_msg=name)
        assert_equal(score.interval, expected.interval)
        assert score.undefined == expected.undefined, name

    tallies = card.tallies[SUBMISSION]
    for scenario, expected in tallies.items():
        tally = statistics.tallies[scenario]
        assert tally.names == expected.names
        assert tally.frames == expected.frames
        assert_array_equal(tally.total, expected.total)
        assert_array_equal(tally.weight, expected.weight)
        assert_array_equal(tally.undefined, expected.undefined)


@pytest.mark.parametrize("length", [0, 100, 5000, 20000])
def test_truncated_netcdf_is_unreadable(
    card: ScoreCard, tmp_path: Path, length: int
) -> None:
    path = tmp_path / "scores.nc"
    content = card.files[1].read_bytes()
    path.write_bytes(content[:length])
    with pytest.raises(UnreadableFileError):
        read_statistics(path)
