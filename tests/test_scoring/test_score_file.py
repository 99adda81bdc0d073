"""scores.nc and scores.json as files: size, preview, damage."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from file_size_limit import largest_file
from score_bench import ScoreBench, straight

from lagbench.errors import UnreadableFileError, WorkFailedError
from lagbench.metrics import Tally, aggregate, select
from lagbench.metrics.aggregate import round_statistics
from lagbench.metrics.distributions import histograms
from lagbench.scoring.card import (
    FRAMES,
    PARTICLES,
    SUBMISSION,
    ScoreCard,
    digits,
)
from lagbench.scoring.published_scores import read_scores
from lagbench.scoring.score_file import read_statistics, write_statistics


@pytest.fixture(scope="module")
def card(bench: ScoreBench, tmp_path_factory: pytest.TempPathFactory) -> ScoreCard:
    """The score card of constant velocity, written."""
    return bench.score(
        bench.submit(tmp_path_factory.mktemp("card") / "predictions.nc", straight)
    )


def noisy(card: ScoreCard) -> ScoreCard:
    """Return a card as large as one of cavity full and as hard to compress: noise
    throughout.
    """
    rng = np.random.Generator(np.random.PCG64(0))
    names = card.tallies[SUBMISSION][3].names
    frames = tuple(range(6, 96))
    ones = np.ones((len(names), 90), np.int64)
    tallies = {
        i: round_statistics(
            Tally(names, frames, rng.standard_normal(ones.shape), ones, 0 * ones)
        )
        for i in range(54, 60)
    }
    normal = {"vorticity": (2, 8, 40, 40), "histogram_range": (8, 2)}
    uniform = {"histogram": (2, 8, 64), "film": (2, FRAMES, PARTICLES, 2)}
    arrays = {name: rng.standard_normal(shape) for name, shape in normal.items()}
    arrays |= {name: rng.random(shape) for name, shape in uniform.items()}
    numbers = {"map_frames": 8, "film_frames": FRAMES, "particles": PARTICLES}
    preview = replace(
        card.preview,
        material=np.zeros(PARTICLES, np.int8),
        **{name: tuple(range(count)) for name, count in numbers.items()},
        **{name: array.astype(np.float32) for name, array in arrays.items()},
    )
    scores = {SUBMISSION: card.submission}  # floors have other scenarios than these
    return replace(
        card, tallies={SUBMISSION: tallies}, scores=scores, skill=None, preview=preview
    )


def scattered(card: ScoreCard) -> ScoreCard:
    """Return a card as large as one of multimaterial full.

    Every frame scatters by a hundredth. As there, every scenario has two of the four
    materials, and transport is measured in two frames.
    """
    rng = np.random.Generator(np.random.PCG64(1))
    names = card.tallies[SUBMISSION][3].names
    frames = tuple(range(2, 600))
    levels = 10.0 ** rng.uniform(-6, 0, (len(names), 1))
    lacking_materials = [("jelly", "snow"), ("snow", "rope"), ("liquid", "rope")]
    tallies = {}
    for scenario, lacking in enumerate(lacking_materials * 2, 54):
        is_measured = np.ones((len(names), len(frames)), bool)
        for row, name in enumerate(names):
            if name.endswith(lacking):
                is_measured[row] = False
        is_measured[names.index("sliced_w2"), 1:-1] = False
        values = levels * (1 + 0.01 * rng.standard_normal(is_measured.shape))
        weight = is_measured.astype(np.int64)
        tally = Tally(
            names, frames, np.where(is_measured, values, 0.0), weight, 0 * weight
        )
        tallies[scenario] = round_statistics(tally)

    fields = rng.standard_normal((2, 2, 65, 65)).astype(np.float32)
    fields[:, :, :, 26:] = np.nan  # the material fills less than two fifths of the box
    steps = 1e-3 * rng.standard_normal((2, FRAMES, PARTICLES, 2))
    start = rng.random((1, 1, PARTICLES, 2))
    film = start + np.cumsum(steps, axis=1)
    large = noisy(card)
    preview = replace(
        large.preview,
        map_frames=(60, 599),
        vorticity=fields,
        film=film.astype(np.float32),
        histogram=large.preview.histogram[:, :2],
        histogram_range=large.preview.histogram_range[:2],
    )
    return replace(large, tallies={SUBMISSION: tallies}, preview=preview)


def test_full_submissions_take_300_kb(card: ScoreCard, tmp_path: Path) -> None:
    """Six scenarios of 598 frames that scatter stay below it; scores follow the file.

    So do incompressible statistics and pictures of six scenarios of 90 frames.
    """
    path = tmp_path / "scores.nc"
    large = scattered(card)
    write_statistics(large, path)
    assert 200_000 < path.stat().st_size <= 300_000
    statistics = read_statistics(path)
    metrics = select(statistics.tallies[54].names)
    for name, score in aggregate(metrics, large.tallies[SUBMISSION]).items():
        stored_mean = statistics.scores()[name].mean
        assert stored_mean == score.mean or math.isnan(score.mean)

    write_statistics(noisy(card), path)
    assert 200_000 < path.stat().st_size <= 300_000


@pytest.mark.parametrize("size", [0, 20_000])
def test_a_full_disk_is_said(card: ScoreCard, tmp_path: Path, size: int) -> None:
    """Most bytes are written when the file is closed: what is refused then is told too,
    with the remedy.
    """
    with largest_file(size), pytest.raises(WorkFailedError) as caught:
        write_statistics(noisy(card), tmp_path / "scores.nc", option="--board")
    assert caught.value.where == str(tmp_path / "scores.nc")
    assert "--board" in str(caught.value.fix)
    assert not list(tmp_path.iterdir())


def test_stored_statistics_saturate_at_float32() -> None:
    """An undefined value is counted."""
    largest = float(np.finfo(np.float32).max)
    values = {0: {"a": 1e300, "b": -1e300, "c": 0.1, "d": math.nan}}
    stored = round_statistics(Tally.of("abcd", (0,), values))
    expected = [largest, -largest, float(np.float32(0.1)), 0.0]
    np.testing.assert_array_equal(stored.total[:, 0], expected)
    assert stored.undefined[:, 0].tolist() == [0, 0, 0, 1]


def test_statistics_of_long_rollouts_are_rounded_to_eleven_bits() -> None:
    """Rounded twice they are the same; 0 and 1 stay."""
    largest = float(np.finfo(np.float32).max)
    frames = range(101)
    values = {}
    for frame in frames:
        growing = 1e-9 * math.pi**frame
        values[frame] = {"a": growing, "b": 0.0, "c": 1.0, "d": -1e300}
    tally = Tally.of("abcd", frames, values)
    stored = round_statistics(tally)
    finite = stored.total[0, :80]
    np.testing.assert_allclose(finite, tally.total[0, :80], rtol=2.0**-11)
    mantissas, _ = np.frexp(finite)
    remainders = mantissas * 2**11 % 1
    assert len(np.unique(remainders)) == 1
    assert [set(row) for row in stored.total[1:]] == [{0.0}, {1.0}, {-largest}]
    again = round_statistics(stored)
    np.testing.assert_array_equal(again.total[:3], stored.total[:3])


def test_preview_shows_the_truth_beside_the_prediction(
    bench: ScoreBench, card: ScoreCard
) -> None:
    """Xarray unpacks the preview to within one level of its content."""
    level = 2.0 / 65534
    with xr.open_dataset(card.files[1], group="preview") as preview:
        n = bench.size.task.input_frames
        truth = bench.truth(int(preview.attrs["scenario"]))
        frames = preview["film_frame"].values
        particles = preview["film_particle"].values
        assert len(frames) == bench.size.task.horizon
        assert len(particles) == PARTICLES

        true_film, predicted_film = preview["film"].values
        expected_truth = truth[frames][:, particles]
        np.testing.assert_allclose(true_film, expected_truth, atol=level)
        prediction = straight(truth, n, len(frames))[:, particles]
        np.testing.assert_allclose(predicted_film, prediction, atol=level)

        true_maps, predicted_maps = preview["vorticity"].values
        is_empty = np.isnan(true_maps)
        assert is_empty.any()
        assert np.array_equal(is_empty, np.isnan(predicted_maps))
        for i, true_map in enumerate(true_maps):
            defined = ~is_empty[i]
            assert histograms(true_map[defined], predicted_maps[i][defined]) is not None
            share_sums = preview["histogram"].values[:, i].sum(axis=1)
            assert abs(share_sums - 1.0).max() < 0.01


def test_the_statistics_read_back_to_the_bit(card: ScoreCard) -> None:
    """So do the scores that follow from them."""
    stored = read_statistics(card.files[1])
    assert stored.predictions_sha256 == card.predictions_sha256
    assert list(stored.scores()) == list(card.submission)
    for name, score in stored.scores().items():
        expected = card.submission[name]
        np.testing.assert_array_equal(score.values, expected.values, err_msg=name)
        np.testing.assert_equal(score.interval, expected.interval)
        assert score.undefined == expected.undefined, name
    for scenario, tally in card.tallies[SUBMISSION].items():
        again = stored.tallies[scenario]
        assert again.names == tally.names
        assert again.frames == tally.frames
        np.testing.assert_array_equal(again.total, tally.total)
        np.testing.assert_array_equal(again.weight, tally.weight)
        np.testing.assert_array_equal(again.undefined, tally.undefined)


def test_scores_json_reads_back_with_its_digits(card: ScoreCard) -> None:
    """It holds what compare needs."""
    published = read_scores(card.files[0])
    assert published.ranking == "vorticity_nrmse"
    assert published.identity["method"] == card.header.method
    assert digits(1.23456789012e-7) == 1.23456789e-7
    assert digits(math.nan) is None
    assert digits(math.inf) is None
    for row, scores in card.scores.items():
        for name, score in scores.items():
            again = published.scores[row][name]
            stored_digits = [digits(value) for value in again.values.tolist()]
            expected_digits = [digits(value) for value in score.values.tolist()]
            assert stored_digits == expected_digits
            assert again.undefined == score.undefined


def test_damaged_json_is_unreadable(card: ScoreCard, tmp_path: Path) -> None:
    """No JSON object, or cut off: the error names how to make it again; test_compare.py
    has wrong values.
    """
    path = tmp_path / "scores.json"
    for content in (
        b"",
        b"\xff\xfe",
        b"[1, 2]",
        b"null",
        card.files[0].read_bytes()[:500],
    ):
        path.write_bytes(content)
        with pytest.raises(UnreadableFileError) as caught:
            read_scores(path)
        assert caught.value.where.endswith("scores.json")


@pytest.mark.parametrize("length", [0, 100, 5000, 20000])
def test_truncated_netcdf_is_unreadable(
    card: ScoreCard, tmp_path: Path, length: int
) -> None:
    """A scores.nc that was cut off is unreadable, not a traceback."""
    path = tmp_path / "scores.nc"
    path.write_bytes(card.files[1].read_bytes()[:length])
    with pytest.raises(UnreadableFileError):
        read_statistics(path)
    with pytest.raises(UnreadableFileError) as caught:
        read_statistics(card.files[1].parent / "predictions.nc")
    assert caught.value.where.endswith("predictions.nc")
