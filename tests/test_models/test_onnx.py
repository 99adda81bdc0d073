"""ONNX models of strangers: checked, run with limits, never trusted."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from command_line import CliRunner
from hostile_onnx import (
    REFUSED,
    STOPPED,
    pickle_as_onnx,
    straight_on,
    works_later,
)
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray

from lagbench.baselines.particle_grid import ParticleGrid
from lagbench.board.check import check_board
from lagbench.board.entry import Level, Meta
from lagbench.board.reproduce import reproduce
from lagbench.board.submit import submit
from lagbench.cli.program import app
from lagbench.data.registry import load
from lagbench.data.scenario import read_scenario
from lagbench.errors import (
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
)
from lagbench.make.generate import GenerationResult
from lagbench.models.export import export_onnx
from lagbench.models.onnx_checks import examine
from lagbench.models.onnx_model import (
    SECONDS_PER_CALL,
    OnnxModel,
    check_onnx,
    open_onnx,
)
from lagbench.models.onnx_rollout import find_edges
from lagbench.models.predict_onnx import predict_onnx
from lagbench.tensors import Batch
from lagbench.torch import predict
from lagbench.work.machine import run_in_child

MOST_SECONDS = 5.0  # until a hostile file is refused or stopped [s]

SIZE = load().size("curl-noise", "tiny")


def opened(
    path: Path,
    generated: GenerationResult,
    seconds_per_call: float = SECONDS_PER_CALL,
) -> OnnxModel:
    """Return a model with the limits of a test."""
    return open_onnx(
        path,
        size=SIZE,
        root=generated.root,
        memory=2 << 30,
        seconds_per_call=seconds_per_call,
    )


def processor_time() -> float:
    """Return the time that this process and its ended children have needed [s]."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def first_scenario(generated: GenerationResult) -> Path:
    """Return the file of the first test scenario."""
    first = SIZE.subsets["test"][0]
    return SIZE.path(generated.root, first)


def first_prediction(step: Any, root: Path) -> tuple[int, NDArray[np.float32]]:
    """Return the first test scenario and what a step predicts of it."""
    rollouts = predict(step, SIZE.split, size=SIZE.name, history=2, root=root)
    return next(rollouts)


@pytest.mark.parametrize("make", REFUSED, ids=lambda make: make.__name__)
def test_a_hostile_file_is_refused(
    make: Callable[[Path], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its checks name the reason, and nothing of it is run.

    The checks run in this process here, for speed; the child is tested below.
    """
    monkeypatch.chdir(tmp_path)
    path = make(tmp_path / "model.onnx")
    started = time.monotonic()
    try:
        reason = examine(str(path))["refused"]
    except UnreadableFileError as error:
        reason = error.got
    assert reason
    assert time.monotonic() - started < MOST_SECONDS
    assert os.listdir(tmp_path) == ["model.onnx"]


@pytest.mark.slow
@pytest.mark.parametrize("make", STOPPED, ids=lambda make: make.__name__)
def test_a_greedy_model_is_stopped(
    make: Callable[[Path], Path],
    tmp_path: Path,
    generated: GenerationResult,
) -> None:
    """Memory and processor time are bounded, whatever the graph computes, for any
    number of frames: the time of this process and its children.
    """
    model = opened(make(tmp_path / "model.onnx"), generated)
    started = processor_time()
    with pytest.raises((WorkFailedError, UnreadableFileError)) as caught:
        model.predict(first_scenario(generated), 90)
    assert caught.value.where == str(model.path)
    assert processor_time() - started < MOST_SECONDS


@pytest.mark.slow
def test_each_call_of_a_model_has_a_limit(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """A graph that is fast in its first call may not be slow in a later one."""
    model = opened(works_later(tmp_path / "model.onnx"), generated, 0.5)
    model.predict(first_scenario(generated), 1)
    started = processor_time()
    with pytest.raises(WorkFailedError):
        model.predict(first_scenario(generated), 90)
    assert processor_time() - started < MOST_SECONDS


def test_the_time_of_a_short_rollout_is_measured(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """Finer than in ticks of the clock of a limited process, 1 to 10 ms."""
    model = opened(straight_on(tmp_path / "model.onnx"), generated)
    scenario = first_scenario(generated)
    first = model.roll_out(scenario, 10).seconds
    second = model.roll_out(scenario, 10).seconds
    assert first != second
    for seconds in (first, second):
        assert seconds > 0
        milliseconds = 1e3 * seconds
        assert abs(milliseconds - round(milliseconds)) > 1e-6


def test_the_checks_run_in_a_child(tmp_path: Path) -> None:
    """A file that is refused there raises the error of an unreadable file."""
    first_fault, *_ = REFUSED
    path = first_fault(tmp_path / "model.onnx")
    with pytest.raises(UnreadableFileError) as caught:
        check_onnx(path)
    assert caught.value.where == str(path)
    text = tmp_path / "model.txt"
    text.write_text("no model")
    with pytest.raises(LagbenchError):
        check_onnx(text)


def test_a_child_writes_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not a byte, whatever runs there."""
    search_path = os.pathsep.join(sys.path)
    monkeypatch.setenv("PYTHONPATH", search_path)
    path = tmp_path / "written"
    answers = run_in_child(
        "hostile_onnx.write_a_file",
        [str(path)],
        seconds=5,
        wall=60,
    )
    assert answers.values == ["OSError"]
    assert not path.exists() or path.stat().st_size == 0


def test_a_model_predicts_what_its_graph_says(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """Straight lines, to rounding, in the frames of the task."""
    model = opened(straight_on(tmp_path / "model.onnx"), generated)
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


def test_an_exported_step_predicts_what_it_did(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """Sums over particles of one index, walls and weights survive the export."""
    net = torch.nn.Linear(2, 2)

    def step(window: Batch) -> torch.Tensor:
        before, now = window.position.unbind(1)
        velocity = now - before
        cell = (4 * now[:, 0]).long().clamp(0, 3)
        ones = torch.ones_like(velocity)
        sums = torch.zeros(4, 2).index_add(0, cell, velocity)
        counts = torch.zeros(4, 2).index_add(0, cell, ones)
        mean = sums / counts.clamp(min=1.0)
        correction: torch.Tensor = net(velocity)
        motion = 0.5 * velocity + 0.1 * mean[cell] + 1e-4 * correction
        return now + motion

    path = export_onnx(
        step,
        tmp_path / "model.onnx",
        split=SIZE.split,
        size=SIZE.name,
        modules=[net],
        history=2,
        root=generated.root,
    )
    model = open_onnx(path, size=SIZE, root=generated.root)
    assert model.parameters >= 6
    scenario, expected = first_prediction(step, generated.root)
    position = model.predict(SIZE.path(generated.root, scenario))
    assert_allclose(position, expected, rtol=0, atol=1e-5)


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
    model = open_onnx(path, size=SIZE, root=generated.root)
    scenario, expected = first_prediction(step, generated.root)
    position = model.predict(SIZE.path(generated.root, scenario))
    assert_allclose(position, expected, rtol=0, atol=1e-5)


def test_an_export_leaves_all_else_as_it_was(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """A network that trains goes on training, and no other file is touched. The folder
    is made.
    """
    net = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Dropout(0.5))
    net[0].eval()
    folder = tmp_path / "new"

    def step(window: Batch) -> torch.Tensor:
        before, now = window.position.unbind(1)
        motion: torch.Tensor = 1e-4 * net(now - before)
        return now + motion

    def write_model() -> Path:
        return export_onnx(
            step,
            folder / "model.onnx",
            split=SIZE.split,
            size=SIZE.name,
            modules=[net],
            history=2,
            root=generated.root,
        )

    write_model()
    assert [part.training for part in net.modules()] == [True, False, True]
    another_export = folder / ".model.exporting.onnx"
    another_export.write_text("of another process")
    write_model()
    assert sorted(os.listdir(folder)) == [another_export.name, "model.onnx"]


def test_an_exported_file_states_its_data_set(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """So `predict` needs no --split; onnxruntime reads the same metadata."""

    def step(window: Batch) -> torch.Tensor:
        return window.position[:, -1]

    path = export_onnx(
        step,
        tmp_path / "still.onnx",
        split=SIZE.split,
        size=SIZE.name,
        history=2,
        root=generated.root,
    )
    metadata = onnxruntime.InferenceSession(path).get_modelmeta().custom_metadata_map
    assert metadata == {"lagbench_split": SIZE.split, "lagbench_size": SIZE.name}

    predictions = tmp_path / "predictions.nc"
    words = ["predict", str(path), "--root", str(generated.root), "--no-bench"]
    result = CliRunner().invoke(app, [*words, "-o", str(predictions)])
    assert result.exit_code == 0, result.output
    with h5py.File(predictions) as file:
        assert file.attrs["split"] == SIZE.split.encode()
        assert file.attrs["size"] == SIZE.name.encode()


@pytest.mark.parametrize("name", ["../cavity", "/tmp", "", "a" * 1000, "c\x1b[2J"])
def test_a_stated_data_set_is_a_name(name: str, tmp_path: Path) -> None:
    """The metadata of a stranger's file cannot lead to another folder."""
    path = straight_on(tmp_path / "lines.onnx")
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {"lagbench_split": name})
    onnx.save(model, path)
    with pytest.raises(UnreadableFileError) as caught:
        check_onnx(path)
    assert "\x1b" not in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_a_stated_split_that_is_not_there_needs_the_option(tmp_path: Path) -> None:
    """As that of a local split, whose folder only the user knows."""
    path = straight_on(tmp_path / "lines.onnx")
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {"lagbench_split": "own"})
    onnx.save(model, path)
    with pytest.raises(UsageError) as caught:
        predict_onnx(path, tmp_path / "predictions.nc", root=tmp_path)
    assert str(path) in str(caught.value.where)
    assert "--split" in str(caught.value.fix)


def test_an_onnx_model_of_another_split_is_refused_before_data_are_asked_for(
    tmp_path: Path,
) -> None:
    path = straight_on(tmp_path / "lines.onnx")
    model = onnx.load(path)
    onnx.helper.set_model_props(model, {"lagbench_split": "cavity"})
    onnx.save(model, path)
    output = tmp_path / "predictions.nc"
    with pytest.raises(UsageError, match="another split") as caught:
        predict_onnx(path, output, split="curl-noise", size="tiny", root=tmp_path)
    assert caught.value.expected == "cavity"


def test_an_onnx_model_without_a_stated_split_needs_the_option(tmp_path: Path) -> None:
    path = straight_on(tmp_path / "lines.onnx")
    with pytest.raises(UsageError) as caught:
        predict_onnx(path, tmp_path / "predictions.nc")
    assert "--split" in str(caught.value.fix)


def test_the_error_names_the_inputs_of_an_onnx_model(
    tmp_path: Path, generated: GenerationResult
) -> None:
    def step(window: Batch) -> torch.Tensor:
        assert window.obstacle is None
        radius: torch.Tensor = window.obstacle[:, -1]
        return window.position[:, -1] * radius.sum()

    with pytest.raises(UsageError) as caught:
        export_onnx(
            step,
            tmp_path / "model.onnx",
            split=SIZE.split,
            size=SIZE.name,
            root=generated.root,
        )
    assert "wall_velocity, viscosity" in str(caught.value.expected)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "where"),
    [
        ({"path": "predictions.nc"}, "export_onnx, path"),
        ({"path": ""}, "export_onnx, path"),
        ({"history": 0}, "export_onnx"),
        ({"history": -1}, "export_onnx"),
        ({"history": 1000}, "export_onnx"),
        ({"modules": [3]}, "export_onnx, modules"),
    ],
)
def test_arguments_that_do_not_fit_an_export_are_refused(
    changes: dict[str, Any],
    where: str,
    tmp_path: Path,
    generated: GenerationResult,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """No file of another kind is written over, and no model sees other frames."""
    monkeypatch.chdir(tmp_path)
    options: dict[str, Any] = {
        "path": "model.onnx",
        "split": SIZE.split,
        "size": SIZE.name,
        "root": generated.root,
    }
    with pytest.raises(UsageError) as caught:
        export_onnx(lambda window: window.position[:, -1], **options | changes)
    assert caught.value.where == where
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "device", ["", "gpu", "cuda:999", "meta", -1, 10**30, "a\0b", np.array(2)]
)
def test_a_device_that_does_not_exist_is_a_usage_error(
    device: Any, generated: GenerationResult
) -> None:
    """Torch has several kinds of errors for that."""
    rollouts = predict(
        lambda window: window.position[:, -1],
        SIZE.split,
        size=SIZE.name,
        root=generated.root,
        device=device,
    )
    with pytest.raises(UsageError) as caught:
        next(rollouts)
    assert caught.value.where == "predict, device"


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


def unknown_input(window: Batch) -> torch.Tensor:
    """Return what a window does not have."""
    inputs = {"position": window.position}
    return inputs["density"]


def obstacle_needed(window: Batch) -> torch.Tensor:
    """Return the last positions where there is an obstacle."""
    assert window.obstacle is not None
    return window.position[:, -1]


def all_frames(window: Batch) -> torch.Tensor:
    """Return several frames."""
    return window.position


def one_component(window: Batch) -> torch.Tensor:
    """Return positions along x."""
    return window.position[:, -1, 0]


def fewer_particles(window: Batch) -> torch.Tensor:
    """Return the positions of all particles but one."""
    return window.position[1:, -1]


@pytest.mark.parametrize(
    "step",
    [
        earlier_frame,
        unknown_input,
        obstacle_needed,
        all_frames,
        one_component,
        fewer_particles,
    ],
)
def test_a_step_that_cannot_predict_the_next_frame_is_refused(
    step: Callable[[Batch], torch.Tensor], tmp_path: Path, generated: GenerationResult
) -> None:
    """The file would be refused only where it predicts."""
    with pytest.raises(UsageError) as caught:
        export_onnx(
            step,
            tmp_path / "model.onnx",
            split=SIZE.split,
            size=SIZE.name,
            root=generated.root,
        )
    error = caught.value
    assert None not in (error.where, error.expected, error.got, error.fix)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("step", "what"),
    [
        (without_kernel, "does not run"),
        (shorter_in_the_file, "another number of positions"),
    ],
)
def test_a_file_that_cannot_stand_for_the_model_is_refused(
    step: Callable[[Batch], torch.Tensor],
    what: str,
    tmp_path: Path,
    generated: GenerationResult,
) -> None:
    """Errors of onnxruntime and of NumPy become errors of lagbench."""
    with pytest.raises(UsageError, match=what) as caught:
        export_onnx(
            step,
            tmp_path / "model.onnx",
            split=SIZE.split,
            size=SIZE.name,
            root=generated.root,
        )
    error = caught.value
    assert None not in (error.where, error.expected, error.got, error.fix)
    assert not list(tmp_path.iterdir())


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
    model = open_onnx(path, size=SIZE, root=generated.root)
    scenario, expected = first_prediction(step, generated.root)
    position = model.predict(SIZE.path(generated.root, scenario))
    assert_allclose(position, expected, rtol=0, atol=1e-5)


def test_predictions_state_the_seed_that_is_given(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """An ONNX file does not state its seed: the option does. Weights state theirs."""
    model = straight_on(tmp_path / "lines.onnx")
    predictions = tmp_path / "predictions.nc"
    words = ["predict", str(model), "--split", SIZE.split, "--size", SIZE.name]
    options = ["--root", str(generated.root), "--no-bench", "-o", str(predictions)]
    result = CliRunner().invoke(app, [*words, *options, "--seed", "3"])
    assert result.exit_code == 0, result.output
    with h5py.File(predictions) as file:
        assert file.attrs["seed"] == 3

    weights = CliRunner().invoke(app, ["predict", "weights.safetensors", "--seed", "3"])
    assert weights.exit_code == 2
    assert "--seed" in weights.output


def test_a_file_whose_name_is_no_method_needs_the_option(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """The remedy of the message works."""
    model = straight_on(tmp_path / "a\u200bb.onnx")
    predictions = tmp_path / "predictions.nc"
    words = ["predict", str(model), "--split", SIZE.split, "--size", SIZE.name]
    words += ["--root", str(generated.root), "--no-bench", "-o", str(predictions)]
    refused = CliRunner().invoke(app, words)
    assert refused.exit_code == 2
    assert "--method" in refused.output
    assert not predictions.exists()
    done = CliRunner().invoke(app, [*words, "--method", "lines"])
    assert done.exit_code == 0, done.output


def test_paths_of_an_onnx_model_may_begin_with_the_home_folder(
    home_folder: Path, generated: GenerationResult
) -> None:
    """In Python and on the command line, also of weights."""
    straight_on(home_folder / "lines.onnx")
    options: dict[str, Any] = {
        "split": SIZE.split,
        "size": SIZE.name,
        "root": generated.root,
    }
    result = predict_onnx("~/lines.onnx", "~/predictions.nc", **options)
    assert result.path == home_folder / "predictions.nc"
    assert result.path.is_file()
    with pytest.raises(UsageError) as caught:
        predict_onnx("~/lines.onnx", "~/predictions.nc", **options)
    assert "--overwrite" in str(caught.value.fix)

    words = ["predict", "~/lines.onnx", "--split", SIZE.split, "--size", SIZE.name]
    words += ["--root", str(generated.root), "--no-bench"]
    command = CliRunner().invoke(app, [*words, "--output=~/command.nc"])
    assert command.exit_code == 0, command.output
    assert (home_folder / "command.nc").is_file()
    weights = CliRunner().invoke(app, ["predict", "~/weights.safetensors"])
    assert weights.exit_code == 3
    assert str(home_folder / "weights.safetensors") in weights.output


def test_a_model_may_be_exported_to_the_home_folder(
    tmp_path: Path, generated: GenerationResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))

    def step(window: Batch) -> torch.Tensor:
        return window.position[:, -1]

    path = export_onnx(
        step,
        "~/still.onnx",
        split=SIZE.split,
        size=SIZE.name,
        root=generated.root,
    )
    assert path == tmp_path / "still.onnx"
    assert path.is_file()


def test_two_predictions_of_onnx_files_do_not_write_one_file_at_a_time(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """The second is refused at once; the first one's file is there afterwards."""
    model = straight_on(tmp_path / "lines.onnx")
    output = tmp_path / "out" / "predictions.nc"
    options: dict[str, Any] = {
        "split": SIZE.split,
        "size": SIZE.name,
        "root": generated.root,
    }
    errors: list[WorkFailedError] = []

    def predict_too(split: str, size: str) -> None:
        with pytest.raises(WorkFailedError) as caught:
            predict_onnx(model, output, overwrite=True, **options)
        errors.append(caught.value)

    predict_onnx(model, output, time_solver=predict_too, **options)
    assert [error.where for error in errors] == [str(output)]
    assert list(output.parent.iterdir()) == [output]


@pytest.mark.slow
def test_an_entry_carries_an_onnx_model(
    tmp_path: Path, generated: GenerationResult
) -> None:
    """Predicted, submitted and reproduced; another file for the same predictions is
    refused.
    """
    path = straight_on(tmp_path / "lines.onnx")
    predictions = tmp_path / "predictions.nc"
    prediction = predict_onnx(
        path,
        predictions,
        split=SIZE.split,
        size=SIZE.name,
        root=generated.root,
    )
    assert prediction.method == "lines"
    refused = {
        path: "another file",
        predictions: "--overwrite",
        tmp_path / "new.safetensors": "new.nc",
    }
    for output, fix in refused.items():
        with pytest.raises(UsageError) as caught:
            predict_onnx(
                path, output, split=SIZE.split, size=SIZE.name, root=generated.root
            )
        assert fix in str(caught.value.fix)
    with pytest.raises(UsageError):
        predict_onnx(
            path,
            path,
            overwrite=True,
            split=SIZE.split,
            size=SIZE.name,
            root=generated.root,
        )
    board = tmp_path / "board"
    meta = Meta(authors=("A. Author",), command="make")
    options: dict[str, Any] = {
        "board": board,
        "root": generated.root,
        "new_board": True,
    }
    other = tmp_path / "other.onnx"
    straight_on(other)
    with pytest.raises(UsageError):  # one of the two did not make the predictions
        submit([predictions], meta, weights=[path, other], **options)
    stated = onnx.load(other)
    onnx.helper.set_model_props(stated, {"lagbench_split": "cavity"})
    onnx.save(stated, other)
    with pytest.raises(UsageError):  # the predictions are of curl-noise
        submit([predictions], meta, weights=[other], **options)
    hostile = pickle_as_onnx(other)
    with pytest.raises(UnreadableFileError):
        submit([predictions], meta, weights=[hostile], **options)
    submit([predictions], meta, weights=[path], **options)

    place = board / "weights/curl-noise/tiny/lines_0.onnx"
    assert place.read_bytes() == path.read_bytes()
    assert check_board(board, isolated=False).findings == ()
    result = reproduce(
        board,
        ["curl-noise/tiny/lines"],
        costs=False,
        root=generated.root,
    )
    assert result.exit_code == 0
    (line,) = result.lines.values()
    assert line.level is Level.REPRODUCED

    # its successor shares the file once the entry is inactive
    successor = meta.model_copy(update={"method": "straight", "name": "Straight"})
    with pytest.raises(UsageError):
        submit([predictions], successor, weights=[place], **options)
    entry = board / "submissions/curl-noise/tiny/lines.yaml"
    old = entry.read_text()
    entry.write_text(f"{old}status: superseded\nsuperseded_by: straight\n")
    submit([predictions], successor, weights=[place], **options)
    assert [file.name for file in place.parent.iterdir()] == [place.name]
    assert check_board(board, isolated=False).findings == ()
