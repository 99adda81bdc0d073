"""Models in three dimensions and in boxes with periodic axes."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch.testing import assert_close

import lagbench
from lagbench.baselines.augmentation import (
    Symmetry,
    draw_mirror_matrices,
    mirror_batch,
)
from lagbench.baselines.graph import radius_graph, wall_distance
from lagbench.baselines.predict import predict
from lagbench.baselines.train import train
from lagbench.data.box import Box
from lagbench.data.local import locate
from lagbench.exchange import adopt
from lagbench.exchange.local_split import LocalSplit
from lagbench.submission.predictions import open_predictions
from lagbench.tensors import Batch

RECIPE = """
format: 1
recipes:
  '*/full': {training: {steps: 2, batch: 1, learning_rate: 1.0e-4}}
"""

BOXES = {
    "cube": Box.from_bounds([(0.0, 1.0)] * 3),
    "periodic": Box.from_bounds([(0.0, 1.0), (0.0, 0.5), (0.25, 0.75)], [True] * 3),
    "plane": Box.from_bounds([(0.0, 1.0), (0.0, 1.0)], [True, False]),
}


@pytest.mark.parametrize("most", [None, 3])
@pytest.mark.parametrize("name", BOXES)
def test_edges_are_the_pairs_within_the_radius(name: str, most: int | None) -> None:
    """By all pairs: the shortest of the ways to every image."""
    box = BOXES[name]
    rng = np.random.default_rng(1)
    position = rng.uniform(box.low, box.high, (60, box.dimension))
    sample = np.repeat([0, 1], 30)
    radius = 0.18
    shifts = []
    for steps in itertools.product((-1, 0, 1), repeat=box.dimension):
        shifts.append(np.where(box.periodic, steps * box.lengths, 0.0))
    expected = set()
    for i in range(60):
        distances = {}
        for j in range(60):
            if i != j and sample[i] == sample[j]:
                ways = position[j] - position[i] + np.array(shifts)
                distances[j] = math.sqrt((ways**2).sum(axis=1).min())
        near = [j for j in distances if distances[j] <= radius]
        near.sort(key=lambda j: distances[j])
        expected |= {(j, i) for j in near[:most]}
    edges = radius_graph(
        torch.from_numpy(position),
        radius,
        torch.from_numpy(sample),
        most=most,
        box=box,
    )
    assert set(map(tuple, edges.T.tolist())) == expected
    assert edges.shape[1] == len(expected)


def test_periodic_axes_have_no_walls() -> None:
    position = torch.tensor([[0.1, 0.1, 0.3]])
    distance = wall_distance(position, BOXES["cube"].bounds, 0.5, (True, False, False))
    assert_close(distance, torch.tensor([[1.0, 1.0, 0.2, 1.0, 0.6, 1.0]]))


@pytest.mark.parametrize("symmetry", [Symmetry.MIRROR, Symmetry.SQUARE])
def test_images_of_the_cube_keep_distances_and_walls(symmetry: Symmetry) -> None:
    """An image keeps distances; a wall that slides takes its velocity along."""
    generator = torch.Generator().manual_seed(0)
    matrix = draw_mirror_matrices(symmetry, 40, generator, dimension=3)
    identity = torch.eye(3).expand(40, 3, 3)
    assert_close(matrix @ matrix.transpose(1, 2), identity)
    images = {tuple(row.flatten().tolist()) for row in matrix}
    assert len(images) == 4 if symmetry is Symmetry.MIRROR else len(images) > 20
    if symmetry is Symmetry.MIRROR:
        assert_close(matrix[:, 1], identity[:, 1])

    position = torch.rand(40, 2, 3, generator=generator)
    walls = torch.zeros(40, 2, 6, 3)
    walls[:, :, 3, 0] = 1.0  # the top slides along x
    batch = Batch(
        position=position,
        sample=torch.arange(40),
        material=torch.zeros(40, dtype=torch.int64),
        wall_velocity=walls,
        scenario=torch.zeros(40, dtype=torch.int64),
        frame=torch.zeros(40, dtype=torch.int64),
    )
    image = mirror_batch(batch, matrix, BOXES["cube"].bounds)
    step = (position[:, 1] - position[:, 0]).norm(dim=1)
    image_step = (image.position[:, 1] - image.position[:, 0]).norm(dim=1)
    assert_close(image_step, step)
    assert image.wall_velocity is not None
    for number in range(40):
        top = matrix[number] @ torch.tensor([0.0, 1.0, 0.0])
        axis = int(top.abs().argmax())
        wall = 2 * axis + int(top[axis] > 0.0)
        velocity = matrix[number] @ torch.tensor([1.0, 0.0, 0.0])
        assert_close(image.wall_velocity[number, 0, wall], velocity)


def drifting(count: int, pace: float = 1.0) -> NDArray[np.float32]:
    """Return particles that drift through the ends of a periodic cube."""
    axis = (np.arange(5) + 0.5) / 5
    grid = np.meshgrid(axis, axis, axis, indexing="ij")
    lattice = np.stack(grid, axis=-1).reshape(-1, 3)[:count]
    frames = np.arange(12)[:, None, None]
    return np.asarray((lattice + pace * frames * [0.03, 0.01, -0.02]) % 1.0, np.float32)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    folder = tmp_path_factory.mktemp("drift")
    paths = []
    for number, count in enumerate((125, 110, 125, 100)):
        paths.append(folder / f"run{number}.npy")
        np.save(paths[-1], drifting(count))
    return adopt(
        paths,
        output=folder / "drift",
        valid=1,
        test=1,
        radius=0.3,
        frame_interval=0.1,
        bounds=((0.0, 1.0),) * 3,
        periodic=("x", "y", "z"),
    )


@pytest.mark.parametrize(
    ("baseline", "settings"),
    [
        ("gns", ("model.latent=8", "model.layers=1")),
        ("neuralmpm", ("model.cells=4", "model.width=4", "model.velocities=2")),
    ],
)
def test_a_training_and_its_predictions_go_through_the_ends(
    made: LocalSplit,
    tmp_path: Path,
    baseline: str,
    settings: tuple[str, ...],
) -> None:
    """Untrained, both models keep the velocity: here that is the truth."""
    run = tmp_path / "run"
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE)
    train(
        baseline,
        str(made.folder),
        output=run,
        recipe=str(recipe),
        settings=(*settings, "model.symmetry=square"),
        device="cpu",
    )
    path = tmp_path / "predictions.nc"
    root = made.folder.parent
    predict(run / "weights.pt", path, root=root, device="cpu")
    with open_predictions(path) as predictions:
        last = predictions.frames(3, 11, 1)[0].astype(np.float64)
    truth = drifting(100)[-1].astype(np.float64)
    error = locate(made.folder).size.box.displacement(truth, last)
    assert np.abs(error).max() < 0.01
    assert lagbench.validate(path, root=made.folder.parent, isolated=False).valid


@pytest.mark.parametrize(
    ("baseline", "settings"),
    [
        ("mlp", ("model.widths=[8]",)),
        ("lstm", ("model.encoder=[8]", "model.latent=8", "model.decoder=[8]")),
    ],
)
def test_networks_of_whole_frames_train_on_equal_scenarios(
    tmp_path: Path,
    baseline: str,
    settings: tuple[str, ...],
) -> None:
    """Their weights belong to places of a frame; positions stay in the period."""
    paths = []
    for number in range(4):
        paths.append(tmp_path / f"run{number}.npy")
        np.save(paths[-1], drifting(125, pace=1.0 + 0.1 * number))
    made = adopt(
        paths,
        output=tmp_path / "drift",
        valid=1,
        test=1,
        radius=0.3,
        frame_interval=0.1,
        bounds=((0.0, 1.0),) * 3,
        periodic=("x", "y", "z"),
    )
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE)
    run = tmp_path / "run"
    train(
        baseline,
        str(made.folder),
        output=run,
        recipe=str(recipe),
        settings=settings,
        device="cpu",
    )
    path = tmp_path / "predictions.nc"
    predict(run / "weights.pt", path, root=tmp_path, device="cpu")
    with open_predictions(path) as predictions:
        position = predictions.frames(3, 6, 6)
    assert position.shape == (6, 125, 3)
    assert position.min() >= 0.0
    assert position.max() < 1.0


@pytest.mark.parametrize("baseline", ["var"])
def test_other_models_say_that_they_know_no_such_box(
    made: LocalSplit,
    tmp_path: Path,
    baseline: str,
) -> None:
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(RECIPE)
    with pytest.raises(lagbench.errors.UsageError) as caught:
        train(
            baseline,
            str(made.folder),
            output=tmp_path / "run",
            recipe=str(recipe),
            device="cpu",
        )
    assert "the box of" in str(caught.value.where)
    assert not (tmp_path / "run" / "weights.pt").exists()
