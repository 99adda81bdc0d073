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
    """Return a card as large as one of multimaterial full, with a scatter of a
    hundredth in every frame.

    As there, every scenario has two of the four materials, and transport is measured in
    two frames.
    """
    rng = np.random.Generator(np.random.PCG64(1))
    names = card.tallies[SUBMISSION][3].names
    frames = tuple(range(2, 600))
    levels = 10.0 ** rng.uniform(-6, 0, (len(names), 1))
    tallies = {}
    for i, lacking in enumerate(
        [("jelly", "snow"), ("snow", "rope"), ("liquid", "rope")] * 2, 54
    ):
        there = np.array([not name.endswith(lacking) for name in names])[
            :, None
        ] & np.ones(598, bool)
        there[names.index("sliced_w2"), 1:-1] = False
        values = levels * (1 + 0.01 * rng.standard_normal(there.shape))
        weight = there.astype(np.int64)
        tallies[i] = round_statistics(
            Tally(names, frames, np.where(there, values, 0.0), weight, 0 * weight)
        )
    fields = rng.standard_normal((2, 2, 65, 65)).astype(np.float32)
    fields[:, :, :, 26:] = np.nan  # the material fills less than two fifths of the box
    steps = 1e-3 * rng.standard_normal((2, FRAMES, PARTICLES, 2))
    film = (rng.random((1, 1, PARTICLES, 2)) + np.cumsum(steps, axis=1)).astype(
        np.float32
    )
    large = noisy(card)
    few = {
        "histogram": large.preview.histogram[:, :2],
        "histogram_range": large.preview.histogram_range[:2],
    }
    preview = replace(
        large.preview, map_frames=(60, 599), vorticity=fields, film=film, **few
    )
    return replace(large, tallies={SUBMISSION: tallies}, preview=preview)


def test_full_submissions_take_300_kb(card: ScoreCard, tmp_path: Path) -> None:
    """Six scenarios of 598 frames that scatter stay below 300 kB, and their scores
    follow from the file.

    Even incompressible statistics and pictures of six scenarios of 90 frames stay below
    300 kB.
    """
    path = tmp_path / "scores.nc"
    made = scattered(card)
    write_statistics(made, path)
    assert 200_000 < path.stat().st_size <= 300_000
    again = read_statistics(path)
    expected = aggregate(select(again.tallies[54].names), made.tallies[SUBMISSION])
    for name, score in expected.items():
        assert again.scores()[name].mean == score.mean or math.isnan(score.mean)
    write_statistics(noisy(card), path)
    assert 200_000 < path.stat().st_size <= 300_000


@pytest.mark.parametrize("size", [0, 20_000])
def test_a_full_disk_is_said(card: ScoreCard, tmp_path: Path, size: int) -> None:
    """Most bytes are written when the file is closed: what is refused then is told too,
    with the remedy.
    """
    with largest_file(size), pytest.raises(WorkFailedError) as told:
        write_statistics(noisy(card), tmp_path / "scores.nc", option="--board")
    assert told.value.where == str(tmp_path / "scores.nc")
    assert "--board" in str(told.value.fix)
    assert not list(tmp_path.iterdir())


def test_stored_statistics_are_rounded() -> None:
    """To float32, beyond which they saturate; in long rollouts to eleven bits, twice as
    well as once.

    0 and 1 stay; what is undefined is counted.
    """
    largest = float(np.finfo(np.float32).max)
    values = {0: {"a": 1e300, "b": -1e300, "c": 0.1, "d": math.nan}}
    stored = round_statistics(Tally.of("abcd", (0,), values))
    np.testing.assert_array_equal(
        stored.total[:, 0], [largest, -largest, float(np.float32(0.1)), 0.0]
    )
    assert stored.undefined[:, 0].tolist() == [0, 0, 0, 1]
    frames = range(101)
    given = Tally.of(
        "abcd",
        frames,
        {f: {"a": 1e-9 * math.pi**f, "b": 0.0, "c": 1.0, "d": -1e300} for f in frames},
    )
    stored = round_statistics(given)
    np.testing.assert_allclose(stored.total[0, :80], given.total[0, :80], rtol=2.0**-11)
    assert len(np.unique(np.frexp(stored.total[0, :80])[0] * 2**11 % 1)) == 1
    assert [set(row) for row in stored.total[1:]] == [{0.0}, {1.0}, {-largest}]
    np.testing.assert_array_equal(round_statistics(stored).total[:3], stored.total[:3])


def test_preview_shows_the_truth_beside_the_prediction(
    bench: ScoreBench, card: ScoreCard
) -> None:
    """Xarray unpacks the preview to within one level of the positions, fields and
    shares it was made of.
    """
    with xr.open_dataset(card.files[1], group="preview") as preview:
        n = bench.size.task.input_frames
        truth = bench.truth(int(preview.attrs["scenario"]))
        frames = preview["film_frame"].values
        particles = preview["film_particle"].values
        assert len(frames) == bench.size.task.horizon
        assert len(particles) == PARTICLES
        level = 2.0 / 65534
        film = preview["film"].values
        np.testing.assert_allclose(film[0], truth[frames][:, particles], atol=level)
        guess = straight(truth, n, len(frames))[:, particles]
        np.testing.assert_allclose(film[1], guess, atol=level)
        omega = preview["vorticity"].values
        assert np.isnan(omega[0]).any()
        assert np.array_equal(np.isnan(omega[0]), np.isnan(omega[1]))
        for i in range(len(preview["map_frame"])):
            known = ~np.isnan(omega[0, i])
            shares = histograms(omega[0, i][known], omega[1, i][known])
            assert shares is not None
            assert abs(preview["histogram"].values[:, i].sum(axis=1) - 1.0).max() < 0.01


def test_both_files_read_back(card: ScoreCard) -> None:
    """What compare needs comes back from scores.json; of scores.nc every bit of the
    statistics and scores.
    """
    stored = read_statistics(card.files[1])
    assert stored.predictions_sha256 == card.predictions_sha256
    assert list(stored.scores()) == list(card.submission)
    for name, score in stored.scores().items():
        np.testing.assert_array_equal(
            score.values, card.submission[name].values, err_msg=name
        )
        np.testing.assert_equal(score.interval, card.submission[name].interval)
        assert score.undefined == card.submission[name].undefined, name
    for scenario, tally in card.tallies[SUBMISSION].items():
        again = stored.tallies[scenario]
        assert again.names == tally.names
        assert again.frames == tally.frames
        for field in ("total", "weight", "undefined"):
            np.testing.assert_array_equal(getattr(again, field), getattr(tally, field))
    published = read_scores(card.files[0])
    assert published.ranking == "vorticity_nrmse"
    assert published.identity["method"] == card.header.method
    assert [digits(v) for v in (1.23456789012e-7, math.nan, math.inf)] == [
        1.23456789e-7,
        None,
        None,
    ]
    for row, scores in card.scores.items():
        for name, score in scores.items():
            again = published.scores[row][name]
            assert [digits(v) for v in again.values.tolist()] == [
                digits(v) for v in score.values.tolist()
            ]
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
