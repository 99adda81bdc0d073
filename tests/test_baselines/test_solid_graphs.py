"""Models in three dimensions and in boxes with periodic axes."""

from __future__ import annotations

import itertools
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
from lagbench.baselines.graph import radius_graph
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

UNIT = (0.0, 1.0)
BOXES = {
    "cube": Box.from_bounds([UNIT] * 3),
    "periodic": Box.from_bounds([UNIT, (0.0, 0.5), (0.25, 0.75)], [True] * 3),
    "plane": Box.from_bounds([UNIT, UNIT], [True, False]),
}


@pytest.mark.parametrize("name", BOXES)
def test_edges_are_the_pairs_within_the_radius(name: str) -> None:
    """By all pairs: the shortest of the ways to every image."""
    box = BOXES[name]
    rng = np.random.default_rng(1)
    shape = (60, box.dimension)
    position = rng.uniform(box.low, box.high, shape)
    sample = np.repeat([0, 1], 30)
    radius = 0.18
    shifts = []
    steps = itertools.product((-1, 0, 1), repeat=box.dimension)
    for step in steps:
        shift = step * box.lengths
        shifts.append(np.where(box.periodic, shift, 0.0))
    expected = set()
    for i in range(60):
        for j in range(60):
            if i != j and sample[i] == sample[j]:
                ways = position[j] - position[i] + np.array(shifts)
                square_distances = np.sum(ways**2, axis=1)
                if square_distances.min() <= radius**2:
                    expected.add((j, i))
    edges = radius_graph(
        torch.from_numpy(position),
        radius,
        torch.from_numpy(sample),
        box=box,
    )
    senders, receivers = edges.tolist()
    pairs = set(zip(senders, receivers, strict=True))
    assert pairs == expected
    assert edges.shape[1] == len(expected)


@pytest.mark.parametrize("symmetry", [Symmetry.MIRROR, Symmetry.SQUARE])
def test_images_of_the_cube_keep_distances_and_walls(symmetry: Symmetry) -> None:
    """An image keeps distances; a wall that slides takes its velocity along."""
    generator = torch.Generator().manual_seed(0)
    matrix = draw_mirror_matrices(symmetry, 40, generator, dimension=3)
    identity = torch.eye(3).expand(40, 3, 3)
    assert_close(matrix @ matrix.transpose(1, 2), identity)
    images = {tuple(row.flatten().tolist()) for row in matrix}
    if symmetry is Symmetry.MIRROR:
        assert len(images) == 4
        assert_close(matrix[:, 1], identity[:, 1])
    else:
        assert len(images) > 20

    position = torch.rand(40, 2, 3, generator=generator)
    walls = torch.zeros(40, 2, 6, 3)
    walls[:, :, 3, 0] = 1.0  # the top slides along x
    zeros = torch.zeros(40, dtype=torch.int64)
    batch = Batch(
        position=position,
        sample=torch.arange(40),
        material=zeros,
        wall_velocity=walls,
        scenario=zeros,
        frame=zeros,
    )
    image = mirror_batch(batch, matrix, BOXES["cube"].bounds)
    before, after = position.unbind(1)
    image_before, image_after = image.position.unbind(1)
    step = (after - before).norm(dim=1)
    image_step = (image_after - image_before).norm(dim=1)
    assert_close(image_step, step)
    assert image.wall_velocity is not None
    x_axis = torch.tensor([1.0, 0.0, 0.0])
    y_axis = torch.tensor([0.0, 1.0, 0.0])
    for number in range(40):
        top = matrix[number] @ y_axis
        axis = int(top.abs().argmax())
        wall = 2 * axis + int(top[axis] > 0.0)
        velocity = matrix[number] @ x_axis
        image_velocity = image.wall_velocity[number, 0, wall]
        assert_close(image_velocity, velocity)


def drifting(count: int, pace: float = 1.0) -> NDArray[np.float32]:
    """Return particles that drift through the ends of a periodic cube."""
    axis = (np.arange(5) + 0.5) / 5
    grid = np.meshgrid(axis, axis, axis, indexing="ij")
    lattice = np.stack(grid, axis=-1).reshape(-1, 3)
    frames = np.arange(12)[:, None, None]
    velocity = pace * np.array([0.03, 0.01, -0.02])
    position = (lattice[:count] + frames * velocity) % 1.0
    return position.astype(np.float32)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> LocalSplit:
    folder = tmp_path_factory.mktemp("drift")
    paths = []
    for number, count in enumerate((125, 110, 125, 100)):
        path = folder / f"run{number}.npy"
        np.save(path, drifting(count, pace=1.0 + 0.1 * number))
        paths.append(path)
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
    predict(run / "weights.safetensors", path, root=root, device="cpu")
    with open_predictions(path) as predictions:
        prediction = predictions.frames(3, 11, 1)
    last = prediction[0].astype(np.float64)
    truth = drifting(100, pace=1.3)[-1].astype(np.float64)
    box = locate(made.folder).size.box
    error = box.displacement(truth, last)
    assert np.abs(error).max() < 0.01
    report = lagbench.validate(path, root=root)
    assert report.valid
