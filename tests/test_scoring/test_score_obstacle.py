"""The obstacle of a scenario in its score file: the film on the page shows it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray
from score_bench import ScoreBench, bench_of, straight

from lagbench.data.registry import load
from lagbench.errors import UnreadableFileError
from lagbench.make.generate import GenerationResult
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.scenario import PreviewRecorder
from lagbench.scoring.score_file_checks import read_score_file
from lagbench.scoring.score_file_writer import write_statistics

DISC = np.float32([0.25, 0.5, 0.0625])


@pytest.fixture(scope="module")
def card(bench: ScoreBench, tmp_path_factory: pytest.TempPathFactory) -> ScoreCard:
    """The score card of a data set without an obstacle, written."""
    path = tmp_path_factory.mktemp("card") / "predictions.nc"
    return bench.score(bench.submit(path, straight))


def write_with(
    card: ScoreCard, obstacle: NDArray[np.float32] | None, path: Path
) -> Path:
    """Write the scores of a card whose film has an obstacle."""
    preview = replace(card.preview, obstacle=obstacle)
    write_statistics(replace(card, preview=preview), path)
    return path


def test_the_obstacle_reads_back(card: ScoreCard, tmp_path: Path) -> None:
    """It has the same bits; a file without one does not name it."""
    path = write_with(card, DISC, tmp_path / "scores.nc")
    read = read_score_file(path).preview.obstacle
    assert read is not None
    assert read.dtype == np.float32
    assert_array_equal(read, DISC)

    without = card.files[1]
    assert read_score_file(without).preview.obstacle is None
    with h5py.File(without) as file:
        assert "obstacle" not in file["preview"].attrs


@pytest.mark.parametrize(
    "obstacle",
    [
        np.float32([0.25, 0.5]),
        np.float32([0.25, 0.5, 0.5, 0.1]),
        np.float32([0.25, 0.5, 0.0]),
        np.float32([0.25, np.nan, 0.1]),
        np.float32(0.1),
        np.array([0.25, 0.5, 1e300]),
        np.array([b"0.25", b"0.5", b"0.1"]),
        np.float32([1e38, 0.5, 0.1]),
        np.float32([0.25, 0.5, 1e38]),
    ],
)
def test_an_obstacle_without_place_or_size_is_refused(
    obstacle: NDArray[np.float32], card: ScoreCard, tmp_path: Path
) -> None:
    """The file comes from strangers: the page draws what it says."""
    path = write_with(card, obstacle, tmp_path / "scores.nc")
    with pytest.raises(UnreadableFileError):
        read_score_file(path)


def test_the_recorder_keeps_the_obstacle(bench: ScoreBench) -> None:
    """A scenario without one has none."""
    number = bench.task.scenarios[0]
    with bench.task.opened(number) as truth:
        assert truth.obstacle is None
        recorder = PreviewRecorder(number, truth.scenario, obstacle=DISC)
    assert recorder.preview.obstacle is DISC


@pytest.mark.slow  # compiles the kernels of cylinder
def test_scores_of_cylinder_hold_the_disc(
    tiny_split: Callable[..., GenerationResult], tmp_path: Path
) -> None:
    """Its place is that of the pictured scenario, and no true particle is inside."""
    cylinder = bench_of(tiny_split("cylinder"), load())
    card = cylinder.score(cylinder.submit(tmp_path / "predictions.nc", straight))
    preview = read_score_file(card.files[1]).preview
    with cylinder.task.opened(preview.scenario) as truth:
        expected = truth.obstacle
    assert expected is not None
    assert preview.obstacle is not None
    assert_array_equal(preview.obstacle, expected)

    true_film = preview.film[0]
    distance = np.linalg.norm(true_film - expected[:2], axis=-1)
    assert distance.min() > 0.99 * expected[2]
