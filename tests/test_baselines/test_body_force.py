"""The force that drives a flow: in windows, in batches, and as input of a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from simple_models import save_untrained
from torch.testing import assert_close

import lagbench
from lagbench.baselines.augmentation import mirror_batch, shift_batch
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.neuralmpm import NeuralMPM
from lagbench.baselines.predict import predict as predict_file
from lagbench.baselines.train import train
from lagbench.data.registry import load
from lagbench.data.scenario import read_scenario
from lagbench.errors import DataError, UsageError
from lagbench.make.generate import GenerationResult
from lagbench.tensors import Batch, TensorBox
from lagbench.torch import WindowDataset, collate

SPLIT = "poiseuille"
SIZE = load().size(SPLIT, "tiny")
GIVEN = 3


@pytest.fixture(scope="module")
def root(tiny_split: Callable[..., GenerationResult]) -> Path:
    return tiny_split(SPLIT).root


@pytest.fixture(scope="module")
def batch(root: Path) -> Batch:
    """Two windows of different scenarios, from different frames."""
    data = WindowDataset(
        SPLIT,
        size="tiny",
        root=root,
        history=GIVEN,
        future=4,
    )
    return collate([data[2], data[-1]])


def test_windows_hold_the_force_of_their_frames(root: Path) -> None:
    """Row f is what acts from frame f-1 to f."""
    data = lagbench.windows(SPLIT, size="tiny", root=root, history=2)
    window = data[5]
    assert window.body_force is not None
    with read_scenario(SIZE.path(root, window.scenario)) as file:
        force = file.read("body_force")
    expected = force[window.frame : window.frame + 3]
    assert np.abs(expected).max() > 0.0
    np.testing.assert_array_equal(window.body_force, expected)


def test_the_force_goes_with_the_frames(batch: Batch) -> None:
    """A part, and a window one frame later, begin with the force of their frames."""
    force = batch.body_force
    assert force is not None
    assert force.shape == (2, GIVEN + 4, 2, 2)
    lower = force[:, :, 0]
    upper = force[:, :, 1]
    assert_close(upper, -lower)
    given = batch.part(slice(GIVEN))
    assert given.body_force is not None
    assert_close(given.body_force, force)
    last = given.position[:, -1]
    later = given.followed_by(last)
    assert later.body_force is not None
    assert_close(later.body_force, force[:, 1:])


def for_both_windows(matrix: list[list[float]]) -> torch.Tensor:
    """Return one matrix for each of two windows."""
    return torch.tensor(matrix).expand(2, 2, 2)


def test_images_of_the_force_fit_the_images_of_the_particles(batch: Batch) -> None:
    """A mirror image in x drives the other way; upside down the layers change places;
    axes do not; windows are not moved across the layers.
    """
    force = batch.body_force
    assert force is not None
    across_x = for_both_windows([[-1.0, 0.0], [0.0, 1.0]])
    image = mirror_batch(batch, across_x, SIZE.bounds)
    assert image.body_force is not None
    assert_close(image.body_force, -force)

    across_y = for_both_windows([[1.0, 0.0], [0.0, -1.0]])
    image = mirror_batch(batch, across_y, SIZE.bounds)
    assert image.body_force is not None
    assert_close(image.body_force, force.flip(2))

    box = TensorBox(SIZE.box)
    generator = torch.Generator().manual_seed(1)
    moved = shift_batch(batch, box, generator)
    way = box.displacement(batch.position, moved.position)
    x_way, y_way = way.abs().unbind(dim=-1)
    assert float(x_way.min()) > 1e-3
    assert float(y_way.max()) == 0.0


def test_the_u_net_sees_the_coming_force_at_its_nodes(root: Path, batch: Batch) -> None:
    """The lower half of the grid has that of the first layer, the upper half that of
    the second; a model that sees it refuses data without it.
    """
    info = read_dataset_info(SPLIT, "tiny", root=root)
    options = {
        "cells": 12,
        "width": 8,
        "velocities": 2,
        "bundle": 3,
        "body_force": True,
    }
    model = NeuralMPM.build(options, info)
    given = batch.part(slice(GIVEN))
    state = model.start(given)
    assert state.body_force is not None
    fields = model.encoder.force(state.body_force)
    assert fields.shape == (2, 6, 12, 12)
    assert batch.body_force is not None
    square_interval = info.frame_interval**2
    unit = square_interval / model.acceleration_std
    coming = unit * batch.body_force[:, GIVEN : GIVEN + 3]
    halves = [fields[..., :6], fields[..., 6:]]
    for layer, half in enumerate(halves):
        of_layer = coming[:, :, layer].flatten(1)
        expected = of_layer[..., None, None].expand(-1, -1, 12, 6)
        assert_close(half, expected, atol=1e-6, rtol=1e-5)
    state, _ = model.call(state)
    assert state.body_force is not None
    next_force = state.body_force[:, 0]
    assert_close(next_force, square_interval * batch.body_force[:, GIVEN + 2])

    without_force = replace(given, body_force=None)
    with pytest.raises(DataError):
        model.start(without_force)


def test_no_image_turns_the_layers_of_a_force(root: Path, tmp_path: Path) -> None:
    """Neither a training nor a prediction begins with all images of the square."""
    square = "model.symmetry=square"
    output = tmp_path / "run"
    with pytest.raises(UsageError) as caught:
        train("gns", SPLIT, "tiny", settings=[square], root=root, output=output)
    assert caught.value.where == "model.symmetry"
    assert not output.exists()

    info = read_dataset_info(SPLIT, "tiny", root=root)
    options = {"cells": 12, "width": 8, "symmetry": "mirror", "body_force": True}
    model = NeuralMPM.build(options, info)
    weights = tmp_path / "weights.safetensors"
    save_untrained(weights, "neuralmpm", model, info)
    predictions = tmp_path / "predictions.nc"
    average = "model.average=true"
    with pytest.raises(UsageError) as caught:
        predict_file(weights, predictions, root=root, settings=[square, average])
    assert caught.value.where == "model.symmetry"
    assert not predictions.exists()
    predict_file(weights, predictions, root=root, settings=[average])
