"""Own data that the scorer cannot use: counted, said before a training, and mended as
it says.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

import lagbench
from lagbench.__main__ import app
from lagbench.data.grid import Grid, Placement
from lagbench.data.local import locate
from lagbench.errors import WorkFailedError
from lagbench.exchange import adopt
from lagbench.exchange.local_split import LocalSplit
from lagbench.metrics.coverage import Cloud, covered_nodes
from lagbench.scoring.scorability import check_scorability
from lagbench.scoring.score import score

GIVEN = 2
FRAMES = 5


def lattice(side: int, *, seed: int = 0, speed: float = 0.1) -> NDArray[np.float32]:
    """Return particles that fill the unit box and rotate a little about its centre.

    The shape is [frame, particle, 2].
    """
    axis = (np.arange(side) + 0.5) / side
    regular = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    jitter = np.random.default_rng(seed).uniform(-0.1, 0.1, regular.shape)
    start = regular + jitter / side - 0.5
    x = start[:, 0]
    y = start[:, 1]

    # slower towards the walls, shape [frame, particle]
    rate = speed * (1.0 - 4.0 * np.max(start**2, axis=1))
    angle = np.arange(FRAMES)[:, None] * rate
    rotated_x = np.cos(angle) * x - np.sin(angle) * y
    rotated_y = np.sin(angle) * x + np.cos(angle) * y
    position = 0.5 + np.stack([rotated_x, rotated_y], axis=-1)
    return np.clip(position, 0.0, 1.0).astype(np.float32)


def own_split(
    folder: Path, runs: list[NDArray[np.float32]], **wishes: Any
) -> LocalSplit:
    """Adopt trajectories of which the last two are the test subset."""
    for number, run in enumerate(runs):
        np.save(folder / f"{number}.npy", run)
    files = [folder / f"{number}.npy" for number in range(len(runs))]
    known: dict[str, Any] = {
        "radius": 0.2,
        "frame_interval": 0.1,
        "input_frames": GIVEN,
        **wishes,
    }
    return adopt(files, output=folder / "own", valid=1, test=2, **known)


def runs(side: int, **options: Any) -> list[NDArray[np.float32]]:
    """Return four trajectories."""
    return [lattice(side, seed=seed, **options) for seed in range(4)]


@pytest.mark.parametrize(
    ("side", "cells", "word"), [(12, 5, "finer"), (3, 40, "coarser")]
)
def test_the_proposed_grid_makes_it_defined(
    tmp_path: Path, side: int, cells: int, word: str
) -> None:
    """The message counts scenarios and nodes and names a grid; with that one in
    split.yaml it scores.
    """
    made = own_split(tmp_path, runs(side), cells=cells, full_box=True)
    lagbench.template(str(made.folder), output=tmp_path / "p.nc")
    card = score(tmp_path / "p.nc", root=tmp_path, write=False)
    assert np.isnan(card.scores["submission"][card.ranking].values).all()
    (warning,) = [found for found in card.warnings if found.check == "undefined"]
    with lagbench.open_split(str(made.folder), subset="test") as data:
        clouds = [
            Cloud(data["position"].values[i, GIVEN], side**2 * made.spacing**2)
            for i in range(2)
        ]
    nodes = {
        covered_nodes(cloud, Grid(cells, Placement.CELL_CENTRES)) for cloud in clouds
    }
    assert str(warning.got).startswith("2 of 2 test scenarios undefined: ")
    assert max(nodes) < 16
    spelled = " to ".join(str(count) for count in sorted(nodes))
    assert f"{spelled} nodes counted, 16 needed" in str(warning.got)
    found = re.match(
        rf"a {word} grid: cells: (\d+) under score_grid in own/split.yaml",
        str(warning.fix),
    )
    described = made.folder / "split.yaml"
    text = described.read_text()
    assert text.count(f"cells: {cells}") == 1
    described.write_text(text.replace(f"cells: {cells}", f"cells: {found[1]}"))
    card = score(tmp_path / "p.nc", root=tmp_path, write=False)
    assert np.isfinite(card.scores["submission"][card.ranking].values).all()
    assert not [found for found in card.warnings if found.check == "undefined"]


@pytest.mark.parametrize("side", [8, 9, 10, 12, 15, 20, 30])
@pytest.mark.parametrize("full_box", [True, False])
def test_the_default_grid_fits_the_particles(
    tmp_path: Path, side: int, full_box: bool
) -> None:
    """From 64 particles on every test scenario covers 16 nodes in the first and the
    last frame.
    """
    made = own_split(tmp_path, runs(side), full_box=full_box)
    size, root, _ = locate(str(made.folder))
    grid = Grid(size.task.score_grid.cells, Placement(size.task.score_grid.placement))
    with lagbench.open_split(str(made.folder), subset="test") as data:
        for position in (
            data["position"].values[:, [GIVEN, FRAMES - 1]].reshape(-1, side**2, 2)
        ):
            assert covered_nodes(Cloud(position, side**2 * made.spacing**2), grid) >= 16
    assert list(check_scorability(size, root)) == []


def test_nodes_are_counted_as_the_metrics_do() -> None:
    """A full box of n cells across has (n - 2)^2 nodes with neighbours on all sides; no
    particles, none.
    """
    position = lattice(40)[0]
    for cells in (4, 6, 10):
        assert (
            covered_nodes(Cloud(position, 1.0), Grid(cells, Placement.CELL_CENTRES))
            == (cells - 2) ** 2
        )
    assert (
        covered_nodes(Cloud(position[:1], 1.0), Grid(10, Placement.CELL_CENTRES)) <= 1
    )


COARSE = {"cells": 5, "full_box": True}


@pytest.mark.parametrize(
    ("made_of", "wishes", "words"),
    [
        (
            lambda: runs(12),
            COARSE,
            ["2 of 2 test scenarios undefined: 9", "1 of 1 valid scenarios undefined"],
        ),
        (lambda: [*runs(12)[:3], lattice(10)], {}, ["100 to 144 particles"]),
        (lambda: runs(12, speed=0.0), {}, ["nothing moves in test"]),
        (
            lambda: [*runs(12)[:1], lattice(12)[:4], *runs(12)[2:]],
            {},
            ["a valid scenario is too short"],
        ),
    ],
)
def test_reasons(
    tmp_path: Path,
    made_of: Callable[[], list[NDArray[np.float32]]],
    wishes: dict[str, Any],
    words: list[str],
) -> None:
    """Each way in which own data cannot be scored or validated is said."""
    made = own_split(tmp_path, made_of(), **wishes)
    size, root, _ = locate(str(made.folder))
    reasons = "\n".join(check_scorability(size, root))
    assert [said for said in words if said not in reasons] == []


@pytest.mark.parametrize(("cells", "warned"), [(5, True), (8, False)])
def test_training_says_so_first(
    tmp_path: Path, cells: int, warned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One warning with a grid that mends it precedes the training, which is begun; none
    without a reason.
    """

    def begin(*_: object, **__: object) -> None:
        raise WorkFailedError("begun")

    monkeypatch.setattr("lagbench.baselines.train.train", begin)
    made = own_split(tmp_path, runs(12), cells=cells, full_box=True)
    recipe = tmp_path / "own.yaml"
    recipe.write_text(f"format: 1\nrecipes:\n  '*/{made.size}': {{}}\n")
    words = [
        "train",
        "--baseline",
        "mlp",
        "--split",
        str(made.folder),
        "--recipe",
        str(recipe),
    ]
    done = CliRunner().invoke(app, words)
    before, begun, _ = done.stderr.partition("lagbench: begun")
    assert begun
    assert before.count("warning:") == warned
    assert ("under score_grid in own/split.yaml" in before) == warned
