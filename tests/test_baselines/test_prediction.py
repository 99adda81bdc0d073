"""Predictions: rollouts in closed form, frozen ones, files, costs, threads."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import netCDF4
import numpy as np
import pytest
import torch
from simple_models import INFO, Bursting, Drift, install

from lagbench.baselines import predict as prediction
from lagbench.baselines.baseline import Batch, DatasetInfo
from lagbench.baselines.catalogue import find
from lagbench.baselines.checkpoint import Checkpoint, save
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.predict import (
    PredictionResult,
    predict,
)
from lagbench.baselines.recipe import recipe_for
from lagbench.baselines.rollout import roll_out, select_window
from lagbench.data.registry import Registry
from lagbench.errors import (
    UsageError,
)
from lagbench.make.generate import GenerationResult
from lagbench.submission import validate as examine

Predict = Callable[..., PredictionResult]


RECIPE = {"name": "curl-noise/tiny", "training": {"seed": 3}}


class Scaled(Drift):
    """A Drift of any size that keeps the info of its last instance."""

    any_size = True
    last_info: DatasetInfo

    def __init__(self, options: Any, info: DatasetInfo) -> None:
        super().__init__(options, info)
        Scaled.last_info = info


@pytest.fixture
def tiny_info(generated: GenerationResult, unmeasured: Registry) -> DatasetInfo:
    """The dataset info of tiny curl-noise."""
    return read_dataset_info(
        "curl-noise", "tiny", root=generated.root, registry=unmeasured
    )


@pytest.fixture
def run(
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Predict:
    """Predict with an untrained simple model on one thread."""
    install(monkeypatch, drift=Drift, bursting=Bursting, scaled=Scaled)

    def run_prediction(
        baseline: str = "drift",
        start: float = 1.0,
        *,
        root: Path = generated.root,
        info: DatasetInfo | None = None,
        model: dict[str, Any] | None = None,
        training: dict[str, Any] | None = None,
        name: str = "predictions.nc",
        **options: Any,
    ) -> PredictionResult:
        tiny_info = read_dataset_info(
            "curl-noise", "tiny", root=root, registry=unmeasured
        )
        info = info or tiny_info
        all_options = {"start": start, **(model or {})}
        drift = Drift.build(all_options, info)
        record = {"step": 9, "recipe": RECIPE, **(training or {})}
        weights = tmp_path / "weights.safetensors"
        checkpoint = Checkpoint(
            baseline=baseline,
            options=drift.options.model_dump(),
            info=info,
            weights=drift.state_dict(),
            training=record,
        )
        save(weights, checkpoint)
        return predict(
            weights,
            tmp_path / name,
            root=root,
            registry=unmeasured,
            **({"threads": 1} | options),
        )

    return run_prediction


def read_variable(path: Path, name: str = "position") -> np.ndarray:
    """Return a variable of a file, read without lagbench."""
    with netCDF4.Dataset(path) as data:
        return np.asarray(data[name][:])


def read_attributes(path: Path) -> dict[str, Any]:
    """Return the attributes of a file."""
    with netCDF4.Dataset(path) as data:
        names = data.ncattrs()
        return {name: data.getncattr(name) for name in names}


def read_truth(folder: Path) -> dict[int, np.ndarray]:
    """Return the positions of the test scenarios by id."""
    truth = {}
    for path in sorted(folder.glob("test/*.nc")):
        scenario = int(path.stem)
        truth[scenario] = read_variable(path).astype(float)
    return truth


def test_a_drift_in_closed_form(run: Predict, generated: GenerationResult) -> None:
    """With a = 1/2 the k-th position is x + (1 - 2^-k) u, u the last input velocity."""
    predicted = read_variable(run(start=0.5).path)
    shares = 1 - 0.5 ** np.arange(1, 21)
    truth = read_truth(generated.folder)
    for row, position in enumerate(truth.values()):
        last = position[5]
        velocity = last - position[4]
        expected = last + shares[:, None, None] * velocity
        error = np.abs(predicted[row] - expected)
        assert error.max() < 1e-6


def test_batches_do_not_matter(run: Predict) -> None:
    """Scenarios side by side are predicted as one by one."""
    alone = run(name="alone.nc", batch=1)
    together = run(name="together.nc", batch=2)
    assert alone.batch == 1
    assert together.batch == 2
    expected = read_variable(alone.path)
    np.testing.assert_array_equal(read_variable(together.path), expected)


def test_a_rollout_is_frozen_where_it_diverges(
    run: Predict, generated: GenerationResult
) -> None:
    """From frame 6 + 4 on, positions are those of frame 9, and the file says so."""
    result = run(model={"explode_at": 5})
    position = read_variable(result.path)
    diverged_at = read_variable(result.path, "diverged_at")
    truth = read_truth(generated.folder)
    assert result.diverged == dict.fromkeys(truth, 10)
    assert diverged_at.tolist() == [10, 10]
    assert np.isfinite(position).all()
    last_finite = position[:, 3]
    frozen = position[:, 4:]
    assert (frozen == last_finite[:, None]).all()
    assert (last_finite != position[:, 2]).any()


def test_a_rollout_that_diverges_at_once_stays_at_the_last_input_frame(
    run: Predict, generated: GenerationResult
) -> None:
    result = run(model={"explode_at": 1})
    predicted = read_variable(result.path)
    truth = read_truth(generated.folder)
    for row, position in enumerate(truth.values()):
        last = position[5].astype(np.float32)
        assert (predicted[row] == last).all()
    assert set(result.diverged.values()) == {6}


@pytest.mark.parametrize(
    ("batch", "seconds"),
    [
        (1, 1.0),
        (2, 1.5),
    ],
)
def test_frozen_frames_are_not_timed(
    run: Predict,
    monkeypatch: pytest.MonkeyPatch,
    batch: int,
    seconds: float,
) -> None:
    """With a second per step, 4 of 20 frames before a burst cost 4 s.

    Side by side 4 s in vain come before.
    """
    advance = Mock(side_effect=Drift.advance)

    def read_clock() -> float:
        return float(advance.call_count)

    clock = SimpleNamespace(process_time=read_clock, perf_counter=read_clock)
    monkeypatch.setattr(Drift, "advance", lambda *given: advance(*given))
    monkeypatch.setattr(prediction, "time", clock)
    result = run(model={"explode_at": 4}, batch=batch)
    assert list(result.diverged.values()) == [9, 9]
    assert result.seconds_per_frame == seconds


@pytest.mark.parametrize("threads", [1, 2])
def test_other_work_on_the_machine_does_not_count(
    run: Predict, monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    """The cost of a frame is the processor time of all threads, at any load. The result
    also has threads and wall-clock time.
    """
    advance = Mock(side_effect=Drift.advance)
    clock = SimpleNamespace(
        process_time=lambda: float(advance.call_count),
        perf_counter=lambda: 9.0 * advance.call_count,
    )
    monkeypatch.setattr(Drift, "advance", lambda *given: advance(*given))
    monkeypatch.setattr(prediction, "time", clock)
    result = run(threads=threads)
    assert result.clock == "processor"
    assert result.seconds_per_frame == 1.0
    assert result.wall_seconds_per_frame == 9.0
    assert result.threads == threads
    assert f"{threads} thread" in result.device
    cost = json.loads(result.path.with_suffix(".json").read_text())
    assert cost["threads"] == threads


def make_windows(first_x: list[float]) -> Batch:
    """Return windows of two frames of three particles, with x of the first particle."""
    count = len(first_x)
    generator = torch.Generator().manual_seed(0)
    shape = (3 * count, 2, 2)
    position = torch.rand(shape, generator=generator)
    x = torch.tensor(first_x)
    position[::3, :, 0] = x[:, None]
    return Batch(
        position=position,
        sample=torch.arange(count).repeat_interleave(3),
        material=torch.zeros(3 * count, dtype=torch.int64),
        wall_velocity=torch.zeros(count, 2, 4, 2),
        scenario=torch.arange(count) + 10,
        frame=torch.full((count,), 4),
    )


def test_a_diverging_scenario_leaves_others_alone() -> None:
    """Beside one that diverges, a scenario is predicted as it is alone."""
    model = Bursting.build({"start": 1.0}, INFO)
    batch = make_windows([0.9, 0.1])
    good, bad = roll_out(model, batch, 8)
    assert good.scenario == 10
    assert good.diverged_at is None
    assert bad.scenario == 11
    assert bad.diverged_at == 9  # frames 4 and 5 are input, 6 to 8 finite
    first_window = select_window(batch, 0)
    (alone,) = roll_out(model, first_window, 8)
    assert torch.equal(good.position, alone.position)
    assert good.position.shape == (8, 3, 2)
    assert bad.position.shape == (8, 3, 2)


def test_only_the_input_frames_are_read(
    run: Predict, copied: Callable[[], Path]
) -> None:
    """With all later frames of test overwritten the predictions are the same."""
    root = copied()
    result = run(name="a.nc", root=root)
    expected = read_variable(result.path)
    for path in (root / "curl-noise/tiny/v2/test").glob("*.nc"):
        path.chmod(0o644)
        with netCDF4.Dataset(path, "r+") as data:
            data["position"][6:] = 0.5
    result = run(name="b.nc", root=root)
    predicted = read_variable(result.path)
    np.testing.assert_array_equal(predicted, expected)


@pytest.fixture
def mini_info(tiny_info: DatasetInfo) -> DatasetInfo:
    """The dataset info of a training with four times as many particles."""
    return replace(
        tiny_info,
        size="mini",
        dataset_sha256="0" * 64,
        radius=0.5,
        horizon=3,
        statistics=dict.fromkeys(tiny_info.statistics, (1.0, 1.0)),
        particles=4 * tiny_info.particles,
    )


def test_a_model_of_any_size_predicts_another_size(
    run: Predict,
    generated: GenerationResult,
    unmeasured: Registry,
    tiny_info: DatasetInfo,
    mini_info: DatasetInfo,
) -> None:
    """Only the statistics are those of the training.

    Four times as many particles are half as far apart, so that the radius doubles.
    """
    budget = {
        "cpu_hours": 0.1,
        "steps": 9,
        "metric": "vorticity_nrmse",
        "best": 0.2,
        "validations": [[9, 0.2]],
    }
    result = run(
        "scaled",
        start=0.5,
        info=mini_info,
        size="tiny",
        training={"budget": budget},
    )
    assert result.size == "tiny"
    assert result.trained_size == "mini"
    expected = replace(tiny_info, radius=1.0, statistics=mini_info.statistics)
    assert Scaled.last_info == expected

    position = read_variable(result.path)
    same_size = run(start=0.5, name="same.nc")
    expected = read_variable(same_size.path)
    np.testing.assert_array_equal(position, expected)
    report = examine(result.path, root=generated.root, registry=unmeasured)
    assert report.valid, report.findings
    attributes = read_attributes(result.path)
    budget = json.loads(attributes["budget"])
    assert budget == {"cpu_hours": 0.1, "steps": 9}
    assert attributes["training"].startswith("curl-noise mini train")


def test_sizes_that_do_not_fit_are_refused(
    run: Predict,
    tiny_info: DatasetInfo,
    mini_info: DatasetInfo,
) -> None:
    """A model of one size, another frame interval, an unknown size, another version."""
    with pytest.raises(UsageError):
        run("drift", size="tiny", info=mini_info)
    twice_as_long = 2.0 * tiny_info.frame_interval
    other_interval = replace(mini_info, frame_interval=twice_as_long)
    with pytest.raises(UsageError):
        run("scaled", size="tiny", info=other_interval)
    with pytest.raises(UsageError):
        run("scaled", size="small", info=mini_info)


def test_options_of_a_model_may_change(run: Predict) -> None:
    """The prediction is that of a training with the option. The file lists the
    ``--set`` of the training and that of the prediction separately.
    """
    settings = ["training.steps=77"]
    recipe = recipe_for(find("gns"), "curl-noise", "tiny", settings=settings)
    result = run(
        training={"recipe": recipe.as_json()},
        settings=["model.explode_at=3"],
    )
    assert set(result.diverged.values()) == {8}
    trained = run(model={"explode_at": 3}, name="trained.nc")
    position = read_variable(result.path)
    expected = read_variable(trained.path)
    np.testing.assert_array_equal(position, expected)
    text = read_attributes(result.path)["training"]
    of_training, _, of_prediction = text.partition("predicted with")
    assert "training.steps=77" in of_training
    assert "model.explode_at=3" not in of_training
    assert of_prediction.endswith("model.explode_at=3")
