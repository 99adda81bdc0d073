"""What ONNX models are given of the force that drives a flow, and of an obstacle."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from onnx_files import GIVEN_POSITIONS, integers, node, save_model, value

from lagbench.baselines.forcing import force_at, obstacle_features
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.errors import UnreadableFileError
from lagbench.make.generate import GenerationResult
from lagbench.models.export import export_onnx
from lagbench.models.onnx_model import OnnxModel
from lagbench.tensors import Batch, TensorBox
from lagbench.torch import predict

POISEUILLE = load().size("poiseuille", "tiny")
CYLINDER = load().size("cylinder", "tiny")

TinySplit = Callable[..., GenerationResult]


def first_scenario(size: Size, root: Path) -> Path:
    """Return the file of the first test scenario."""
    return size.path(root, size.subsets["test"][0])


def driven(path: Path) -> Path:
    """Write the model x + 0.1 f, with the force f on the lowest layer in the next
    frame.
    """
    nodes = [
        node("Gather", ["position", "last"], "now", axis=0),
        node("Gather", ["body_force", "last"], "coming", axis=0),
        node("Gather", ["coming", "first"], "lowest", axis=1),
        node("Mul", ["lowest", "share"], "way"),
        node("Add", ["now", "way"], "next_position"),
    ]
    share = integers("tenth", 10)
    inputs = [
        value("position", GIVEN_POSITIONS),
        value("body_force", ["towards", "layer", "axis"]),
    ]
    nodes.insert(3, node("Cast", ["tenth"], "ten", to=1))
    nodes.insert(4, node("Reciprocal", ["ten"], "share"))
    initialisers = [integers("last", -1), integers("first", 0), share]
    return save_model(path, nodes, initialisers=initialisers, inputs=inputs)


def placed(path: Path) -> Path:
    """Write the model c + R, with centre c and radius R of the obstacle."""
    nodes = [
        node("Gather", ["position", "last"], "now", axis=0),
        node("Gather", ["obstacle", "axes"], "centre", axis=0),
        node("Gather", ["obstacle", "last"], "radius", axis=0),
        node("Add", ["centre", "radius"], "corner"),
        node("Sub", ["now", "now"], "zero"),
        node("Add", ["zero", "corner"], "next_position"),
    ]
    inputs = [value("position", GIVEN_POSITIONS), value("obstacle", ["number"])]
    initialisers = [integers("last", -1), integers("axes", 0, 1)]
    return save_model(path, nodes, initialisers=initialisers, inputs=inputs)


def test_a_model_is_given_the_force_of_every_frame(
    tmp_path: Path, tiny_split: TinySplit
) -> None:
    """Its ways add up to the sum of the rows of the file, those to predict included."""
    root = tiny_split("poiseuille").root
    model = OnnxModel(driven(tmp_path / "driven.onnx"), size=POISEUILLE, root=root)
    scenario = first_scenario(POISEUILLE, root)
    position = model.predict(scenario)
    task = POISEUILLE.task
    with read_scenario(scenario) as file:
        given = file.read("position", slice(0, task.input_frames))
        force = file.read("body_force")
    rows = force[task.input_frames :][: task.horizon, 0].astype(float)
    ways = 0.1 * rows.cumsum(axis=0)
    assert np.abs(ways).max() > 1e-3
    assert_allclose(position, given[-1] + ways[:, None], rtol=0, atol=2e-6)


def test_a_model_is_given_centre_and_radius_of_the_obstacle(
    tmp_path: Path, tiny_split: TinySplit
) -> None:
    root = tiny_split("cylinder").root
    model = OnnxModel(placed(tmp_path / "placed.onnx"), size=CYLINDER, root=root)
    scenario = first_scenario(CYLINDER, root)
    with read_scenario(scenario) as file:
        stated = file.header.parameters
    radius = float(str(stated["obstacle_diameter"])) / 2.0
    x = float(str(stated["obstacle_x"]))
    y = float(str(stated["obstacle_y"]))
    position = model.predict(scenario, 2)
    expected = np.broadcast_to([x + radius, y + radius], position.shape)
    assert_allclose(position, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("make", [driven, placed])
def test_data_without_it_cannot_be_predicted(
    make: Callable[[Path], Path], tmp_path: Path, generated: GenerationResult
) -> None:
    """The message names the input that the data set does not have."""
    size = load().size("curl-noise", "tiny")
    path = make(tmp_path / "model.onnx")
    model = OnnxModel(path, size=size, root=generated.root)
    with pytest.raises(UnreadableFileError) as caught:
        model.predict(first_scenario(size, generated.root), 1)
    name = {driven: "body_force", placed: "obstacle"}[make]
    assert name in str(caught.value)


def flow_step(size: Size) -> Callable[[Batch], torch.Tensor]:
    """Return a step that the force of a particle's layer drives, and that an obstacle
    pushes away.
    """
    box = TensorBox(size.box)

    def step(window: Batch) -> torch.Tensor:
        before, now = window.position.unbind(1)
        velocity = box.displacement(before, now)
        if window.body_force is not None:
            coming = window.body_force[:, window.frames]
            force = force_at(now, window.sample, coming, box)
            velocity = velocity + size.frame_interval**2 * force
        if window.obstacle is not None:
            own = window.obstacle[window.sample]
            normal = obstacle_features(now, own, 0.1, box)[:, 1:]
            velocity = velocity + 1e-3 * normal
        return box.inside(now + velocity)

    return step


@pytest.mark.slow
@pytest.mark.parametrize("size", [POISEUILLE, CYLINDER], ids=lambda size: size.split)
def test_a_step_that_reads_them_is_exported(
    size: Size, tmp_path: Path, tiny_split: TinySplit
) -> None:
    """The rollout of the file is that of the step."""
    root = tiny_split(size.split).root
    step = flow_step(size)
    path = export_onnx(
        step,
        tmp_path / "flow.onnx",
        split=size.split,
        size=size.name,
        history=2,
        root=root,
    )
    model = OnnxModel(path, size=size, root=root)
    rollouts = predict(step, size.split, size=size.name, history=2, root=root)
    scenario, expected = next(rollouts)
    position = model.predict(size.path(root, scenario))
    way = size.box.displacement(expected.astype(float), position.astype(float))
    assert np.abs(way).max() < 1e-4
