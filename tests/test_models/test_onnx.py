"""ONNX models: what they predict, what an export writes, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from onnx_files import external_data, straight_on

from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.board.check import check_board
from lagbench.board.entry import Meta
from lagbench.board.reproduce import reproduce
from lagbench.board.submit import submit
from lagbench.board.verified import Level
from lagbench.data.registry import load
from lagbench.data.scenario import read_scenario
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.make.generate import GenerationResult
from lagbench.models.export import export_onnx
from lagbench.models.onnx_model import OnnxModel, check_onnx, find_edges
from lagbench.models.predict_onnx import predict_onnx
from lagbench.models.registered import build_registered
from lagbench.tensors import Batch
from lagbench.torch import predict

SIZE = load().size("curl-noise", "tiny")


def first_scenario(generated: GenerationResult) -> Path:
    """Return the file of the first test scenario."""
    first = SIZE.subsets["test"][0]
    return SIZE.path(generated.root, first)


def first_prediction(step: Any, root: Path) -> tuple[int, NDArray[np.float32]]:
    """Return the first test scenario and what a step predicts of it."""
    rollouts = predict(step, SIZE.split, size=SIZE.name, history=2, root=root)
    return next(rollouts)


def test_a_model_predicts_what_its_graph_says(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """Straight lines, to rounding, in the frames of the task."""
    path = straight_on(tmp_path / "model.onnx")
    model = OnnxModel(path, size=SIZE, root=generated.root)
    rollout = model.roll_out(first_scenario(generated))
    input_frames = slice(0, SIZE.task.input_frames)
    with read_scenario(first_scenario(generated)) as file:
        given = file.read("position", input_frames).astype(float)
    step = given[-1] - given[-2]
    frames = np.arange(1, SIZE.task.horizon + 1)[:, None, None]
    assert_allclose(
        rollout.position,
        given[-1] + frames * step,
        rtol=0,
        atol=2e-5,
    )
    assert rollout.diverged_at is None


def test_edges_are_all_pairs_within_the_radius() -> None:
    """Compared with all distances; across periodic ends only where there are some."""
    rng = np.random.default_rng(5)
    position = rng.random((60, 2))
    bounds = np.array([[0.0, 1.0], [0.0, 1.0]])
    for periodic in ([False, False], [True, False], [True, True]):
        difference = position[:, None] - position[None]
        shift = np.where(periodic, np.round(difference), 0.0)
        distance = np.linalg.norm(difference - shift, axis=-1)
        np.fill_diagonal(distance, np.inf)
        receivers, senders = np.nonzero(distance <= 0.2)
        edges = find_edges(position, 0.2, bounds, np.array(periodic))
        assert_array_equal(edges, [senders, receivers])


def test_an_exported_step_sees_the_viscosity(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """It stands in the window, so it is an input of the file."""

    def step(window: Batch) -> torch.Tensor:
        before, now = window.position.unbind(1)
        assert window.viscosity is not None
        decay = torch.exp(-1e3 * window.viscosity)[window.sample]
        return now + decay[:, None] * (now - before)

    path = export_onnx(
        step,
        tmp_path / "model.onnx",
        split=SIZE.split,
        size=SIZE.name,
        history=2,
        root=generated.root,
    )
    model = OnnxModel(path, size=SIZE, root=generated.root)
    scenario, expected = first_prediction(step, generated.root)
    position = model.predict(SIZE.path(generated.root, scenario))
    assert_allclose(position, expected, rtol=0, atol=1e-5)


def test_a_step_over_a_grid_of_particles_is_exported(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """As in the model of the README: sums at the nodes, a convolution, and back."""
    grid = ParticleGrid(SIZE.bounds, cells=8)
    net = torch.nn.Conv2d(3, 2, 3, padding=1)

    def step(window: Batch) -> torch.Tensor:
        before, now = window.position.unbind(1)
        velocity = now - before
        nodes = grid.stencil(now, window.sample)
        mass = torch.ones_like(now[:, :1])
        carried = torch.cat([velocity, mass], 1)
        sums = grid.spread(nodes, carried, window.windows)
        mass_at_nodes = sums[:, 2:].clamp(min=1e-3)
        mean = sums / mass_at_nodes
        mean_velocity = mean[:, :2] + 1e-4 * net(mean)
        flow = grid.gather(nodes, mean_velocity)
        return (now + flow).clamp(grid.low, grid.high)

    path = export_onnx(
        step,
        tmp_path / "model.onnx",
        split=SIZE.split,
        size=SIZE.name,
        modules=[net, grid],
        history=2,
        root=generated.root,
    )
    model = OnnxModel(path, size=SIZE, root=generated.root)
    scenario, expected = first_prediction(step, generated.root)
    position = model.predict(SIZE.path(generated.root, scenario))
    assert_allclose(position, expected, rtol=0, atol=1e-5)


def test_a_baseline_without_a_graph_is_exported(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """UPT; networks of neighbours go to the board as safetensors."""
    options = {"latent": 8, "layers": 1, "velocities": 2}
    data_set: Any = {"split": SIZE.split, "size": SIZE.name, "root": generated.root}
    torch.manual_seed(0)
    model = build_registered("upt", options=options, **data_set).eval()
    for parameter in model.parameters():
        torch.nn.init.normal_(parameter, std=0.1)

    def step(window: Batch) -> torch.Tensor:
        _, position = model.advance(model.start(window))
        return position

    path = export_onnx(
        step, tmp_path / "upt.onnx", modules=[model], history=3, **data_set
    )
    scenario = SIZE.subsets["test"][0]
    _, expected = next(
        predict(step, SIZE.split, size=SIZE.name, history=3, root=generated.root)
    )
    exported = OnnxModel(path, size=SIZE, root=generated.root)
    position = exported.predict(SIZE.path(generated.root, scenario))
    assert_allclose(position, expected, rtol=0, atol=1e-5)


def damaged(path: Path) -> Path:
    """Leave the end of the file out."""
    straight_on(path)
    path.write_bytes(path.read_bytes()[:-20])
    return path


def unknown_output(path: Path) -> Path:
    """Return positions under another name."""
    straight_on(path)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"next_position", b"last_position"))
    return path


@pytest.mark.parametrize("make", [damaged, external_data, unknown_output])
def test_other_files_are_refused(make: Callable[[Path], Path], tmp_path: Path) -> None:
    """Data outside the file would be read from the reader's disk."""
    path = make(tmp_path / "model.onnx")
    with pytest.raises(UnreadableFileError) as caught:
        check_onnx(path)
    assert caught.value.where == str(path)


def without_kernel(window: Batch) -> torch.Tensor:
    """Return the last positions; onnxruntime has no erf of float64."""
    now = window.position[:, -1]
    return now + 0.0 * torch.erf(now.double()).float()


def shorter_in_the_file(window: Batch) -> torch.Tensor:
    """Return the last positions; the file leaves three of them out."""
    now = window.position[:, -1]
    if torch.onnx.is_in_onnx_export():
        return now[3:]
    return now


def earlier_frame(window: Batch) -> torch.Tensor:
    """Return a frame that is not given."""
    return window.position[:, -1000]


def one_component(window: Batch) -> torch.Tensor:
    """Return positions along x."""
    return window.position[:, -1, 0]


@pytest.mark.parametrize(
    "step", [without_kernel, shorter_in_the_file, earlier_frame, one_component]
)
def test_a_file_that_cannot_stand_for_the_model_is_refused(
    step: Callable[[Batch], torch.Tensor], tmp_path: Path, generated: GenerationResult
) -> None:
    with pytest.raises((UsageError, UnreadableFileError)):
        export_onnx(
            step,
            tmp_path / "model.onnx",
            split=SIZE.split,
            size=SIZE.name,
            root=generated.root,
        )
    assert not list(tmp_path.iterdir())


def test_an_exported_file_states_its_data_set(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """So a prediction needs no split; one without it does."""
    path = export_onnx(
        lambda window: window.position[:, -1],
        tmp_path / "still.onnx",
        split=SIZE.split,
        size=SIZE.name,
        history=2,
        root=generated.root,
    )
    predictions = tmp_path / "predictions.nc"
    predict_onnx(path, predictions, root=generated.root, seed=3)
    with h5py.File(predictions) as file:
        assert file.attrs["split"] == SIZE.split.encode()
        assert file.attrs["seed"] == 3
    with pytest.raises(UsageError):
        predict_onnx(straight_on(tmp_path / "lines.onnx"), tmp_path / "other.nc")


@pytest.mark.slow
def test_an_entry_carries_an_onnx_model(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """Predicted, submitted and reproduced."""
    path = straight_on(tmp_path / "lines.onnx")
    predictions = tmp_path / "predictions.nc"
    root = generated.root
    predict_onnx(path, predictions, split=SIZE.split, size=SIZE.name, root=root)
    board = tmp_path / "board"
    meta = Meta(authors=("A. Author",), command="make")
    submit([predictions], meta, weights=[path], board=board, root=root, new_board=True)
    place = board / "weights/curl-noise/tiny/lines_0.onnx"
    assert place.read_bytes() == path.read_bytes()
    assert check_board(board).findings == ()
    result = reproduce(board, ["curl-noise/tiny/lines"], costs=False, root=root)
    (line,) = result.lines.values()
    assert line.level is Level.REPRODUCED
