"""Local data that the scorer cannot use: warnings before a training and fixes."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lagbench
from lagbench.data.grid import Grid, Placement
from lagbench.data.local import locate
from lagbench.exchange import adopt
from lagbench.exchange.local_split import LocalSplit
from lagbench.metrics.coverage import Cloud, covered_nodes
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.scorability import check_scorability
from lagbench.scoring.score import score
from lagbench.scoring.task import SUBMISSION

INPUT_FRAMES = 2
FRAMES = 5
NEEDED_NODES = 16

Trajectory = NDArray[np.float32]


def lattice(side: int, *, seed: int = 0, speed: float = 0.1) -> Trajectory:
    """Return particles that fill the unit box and rotate a little about its centre.

    The shape is [frame, particle, 2].
    """
    axis = (np.arange(side) + 0.5) / side
    x, y = np.meshgrid(axis, axis)
    regular = np.stack([x, y], axis=-1).reshape(-1, 2)
    rng = np.random.default_rng(seed)
    jitter = rng.uniform(-0.1, 0.1, regular.shape)
    start = regular + jitter / side - 0.5
    x = start[:, 0]
    y = start[:, 1]

    # slower towards the walls, shape [frame, particle]
    distance = np.max(start**2, axis=1)
    rate = speed * (1.0 - 4.0 * distance)
    angle = np.arange(FRAMES)[:, None] * rate
    cos = np.cos(angle)
    sin = np.sin(angle)
    rotated = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)
    position = np.clip(0.5 + rotated, 0.0, 1.0)
    return position.astype(np.float32)


def four_lattices(side: int, *, speed: float = 0.1) -> list[Trajectory]:
    """Return four trajectories."""
    return [lattice(side, seed=seed, speed=speed) for seed in range(4)]


def adopt_trajectories(
    folder: Path, trajectories: list[Trajectory], **options: Any
) -> LocalSplit:
    """Adopt trajectories of which the last two are the test subset."""
    files = []
    for number, trajectory in enumerate(trajectories):
        file = folder / f"{number}.npy"
        np.save(file, trajectory)
        files.append(file)
    all_options: dict[str, Any] = {
        "radius": 0.2,
        "frame_interval": 0.1,
        "input_frames": INPUT_FRAMES,
        "valid": 1,
        "test": 2,
    } | options
    return adopt(files, output=folder / "own", **all_options)


def ranking_values(card: ScoreCard) -> NDArray[np.float64]:
    """Return the ranking metric of the submission in each scenario."""
    return card.scores[SUBMISSION][card.ranking].values


def undefined_warnings(card: ScoreCard) -> list[Any]:
    """Return the warnings of a card about scenarios without a score."""
    return [warning for warning in card.warnings if warning.check == "undefined"]


@pytest.mark.parametrize(("side", "cells"), [(12, 5), (4, 40)])
def test_the_proposed_grid_makes_the_score_defined(
    tmp_path: Path, side: int, cells: int
) -> None:
    """The warning names a grid for split.yaml."""
    split = adopt_trajectories(
        tmp_path,
        four_lattices(side),
        cells=cells,
        full_box=True,
    )
    predictions = tmp_path / "p.nc"
    lagbench.template(str(split.folder), output=predictions)
    card = score(predictions, root=tmp_path, write=False)
    assert np.isnan(ranking_values(card)).all()
    (warning,) = undefined_warnings(card)

    match = re.search(r"a grid of (\d+) cells, under .* own/split.yaml", warning.what)
    assert match is not None
    description = split.folder / "split.yaml"
    text = description.read_text()
    assert text.count(f"cells: {cells}") == 1
    description.write_text(text.replace(f"cells: {cells}", f"cells: {match[1]}"))
    card = score(predictions, root=tmp_path, write=False)
    assert np.isfinite(ranking_values(card)).all()
    assert not undefined_warnings(card)


@pytest.mark.parametrize(("side", "full_box"), [(8, True), (15, False)])
def test_the_default_grid_fits_the_particles(
    tmp_path: Path, side: int, full_box: bool
) -> None:
    """From 64 particles on every test scenario covers enough nodes.

    It does so in the first and in the last frame.
    """
    split = adopt_trajectories(
        tmp_path,
        four_lattices(side),
        full_box=full_box,
    )
    size, root, _ = locate(str(split.folder))
    score_grid = size.task.score_grid
    placement = Placement(score_grid.placement)
    grid = Grid(score_grid.cells, placement)
    area = side**2 * split.spacing**2
    with lagbench.open_split(str(split.folder), subset="test") as data:
        positions = data["position"].values
    shown = positions[:, [INPUT_FRAMES, FRAMES - 1]]
    for position in shown.reshape(-1, side**2, 2):
        cloud = Cloud(position, area)
        assert covered_nodes(cloud, grid) >= NEEDED_NODES
    assert list(check_scorability(size, root)) == []


def list_reasons(split: LocalSplit) -> str:
    """Return why a split cannot be scored or validated."""
    size, root, _ = locate(str(split.folder))
    return "\n".join(check_scorability(size, root))


def test_a_coarse_grid_is_a_reason(tmp_path: Path) -> None:
    split = adopt_trajectories(
        tmp_path,
        four_lattices(12),
        cells=5,
        full_box=True,
    )
    assert len(list_reasons(split).splitlines()) == 2  # of test and of valid


def test_data_without_motion_are_a_reason(tmp_path: Path) -> None:
    at_rest = four_lattices(12, speed=0.0)
    split = adopt_trajectories(tmp_path, at_rest)
    assert "nothing moves in test" in list_reasons(split)
