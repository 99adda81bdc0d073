"""Predictions: rollouts that are known in closed form, frozen ones, what a file says;
threads.
"""

from __future__ import annotations

import json
import os
import warnings
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
from simple_models import INFO, Bursting, Drift, State, install
from torch import Tensor

from lagbench.baselines import predict as prediction
from lagbench.baselines.baseline import Batch, DatasetInfo
from lagbench.baselines.catalogue import find, load_all
from lagbench.baselines.checkpoint import Checkpoint, load, save
from lagbench.baselines.dataset_info import read_dataset_info
from lagbench.baselines.graph import radius_graph
from lagbench.baselines.machine import use_threads
from lagbench.baselines.neuralmpm import NeuralMPM
from lagbench.baselines.predict import (
    PredictionResult,
    UnfinishedWarning,
    check_replaceable,
    predict,
)
from lagbench.baselines.recipe import recipe_for
from lagbench.baselines.rollout import roll_out, round_parameters, select_window
from lagbench.baselines.run_folder import LARGEST_LOG
from lagbench.baselines.training_log import OVER
from lagbench.data.registry import Registry
from lagbench.errors import DataError, UnreadableFileError, UsageError, WorkFailedError
from lagbench.make.generate import GenerationResult
from lagbench.submission import validate as examine

Predict = Callable[..., PredictionResult]


RECIPE = {"name": "curl-noise/tiny", "training": {"seed": 3}}
UNFINISHED = {"state": "running", "step": 9, "steps": 70, "recipe": RECIPE}
"""Record of a training whose weights the fixture has, and which goes on."""


class Scaled(Drift):
    """A Drift that may be run at any size, and keeps the info that it was last
    told.
    """

    any_size = True
    told: DatasetInfo

    def __init__(self, options: Any, info: DatasetInfo) -> None:
        super().__init__(options, info)
        Scaled.told = info


class Several(Drift):
    """A Drift with as many weights as asked for."""

    class Options(Drift.Options):
        """See above."""

        count: int = 1

    def __init__(self, options: Any, info: DatasetInfo) -> None:
        super().__init__(options, info)
        self.a = torch.nn.Parameter(torch.full((options.count,), options.start))


@pytest.fixture
def run(
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Predict:
    """Predict with an untrained simple model on one thread."""
    install(monkeypatch, drift=Drift, bursting=Bursting, scaled=Scaled)

    def call(
        baseline: str = "drift", start: float = 1.0, **options: Any
    ) -> PredictionResult:
        root = options.pop("root", generated.root)
        here = read_dataset_info("curl-noise", "tiny", root=root, registry=unmeasured)
        info = options.pop("info", here)
        model = Drift.build({"start": start, **options.pop("model", {})}, info)
        stored = Checkpoint(
            baseline=baseline,
            options=model.options.model_dump(),
            info=info,
            weights=model.state_dict(),
            training={"step": 9, "recipe": RECIPE, **options.pop("training", {})},
        )
        save(tmp_path / "weights.pt", stored)
        output = tmp_path / options.pop("name", "predictions.nc")
        return predict(
            tmp_path / "weights.pt",
            output,
            root=root,
            threads=1,
            registry=unmeasured,
            **options,
        )

    return call


def written(path: Path, name: str = "position") -> np.ndarray:
    """Return a variable of a file, read without our code."""
    with netCDF4.Dataset(path) as data:
        return np.asarray(data[name][:])


def said(path: Path) -> dict[str, Any]:
    """Return the attributes of a file."""
    with netCDF4.Dataset(path) as data:
        return {name: data.getncattr(name) for name in data.ncattrs()}


def truth(folder: Path) -> dict[int, np.ndarray]:
    """Return the positions of the test scenarios by id."""
    return {
        int(file.stem): written(file).astype(float)
        for file in sorted(folder.glob("test/*.nc"))
    }


def test_a_drift_in_closed_form(run: Predict, generated: GenerationResult) -> None:
    """With a = 1/2 the k-th position is x + (1 - 2^-k) u, u the last given velocity."""
    result = run(start=0.5)
    shares = 1 - 0.5 ** np.arange(1, 21)
    for row, position in enumerate(truth(generated.folder).values()):
        last = position[5]
        velocity = position[5] - position[4]
        expected = last + shares[:, None, None] * velocity
        assert np.abs(written(result.path)[row] - expected).max() < 1e-6


def test_the_file_is_valid_and_says_what_made_it(
    run: Predict, generated: GenerationResult, unmeasured: Registry
) -> None:
    """The file passes every check, and holds cost, device, seed, parameters and
    training.
    """
    # of a state that is not the best
    result = run(method="my drift", training={"best_step": 4})
    report = examine(result.path, root=generated.root, registry=unmeasured)
    assert report.valid, report.findings
    found = said(result.path)
    assert found["method"] == "my drift"
    assert found["seed"] == 3
    assert found["parameters"] == 1
    assert "curl-noise/tiny, step 9" in found["training"]
    assert "1 thread" in found["device"]
    assert found["seconds_per_frame"] == result.seconds_per_frame > 0
    cost = json.loads(result.path.with_suffix(".json").read_text())
    assert cost["seconds_without_search"] == result.seconds_per_frame


def test_batches_do_not_matter(run: Predict) -> None:
    """Scenarios predicted side by side are those predicted one by one."""
    alone, together = (run(name=f"{batch}.nc", batch=batch) for batch in (1, 2))
    assert alone.batch == 1
    assert together.batch == 2
    assert np.array_equal(written(alone.path), written(together.path))


def test_a_rollout_is_frozen_where_it_diverges(
    run: Predict, generated: GenerationResult
) -> None:
    """From frame 6 + 4 on, positions are those of frame 9, and the file says so."""
    result = run(model={"explode_at": 5})
    position = written(result.path)
    given = truth(generated.folder)
    assert result.diverged == dict.fromkeys(given, 10)
    assert written(result.path, "diverged_at").tolist() == [10, 10]
    assert np.isfinite(position).all()
    assert (position[:, 4:] == position[:, 3:4]).all()
    assert (position[:, 3] != position[:, 2]).any()
    # stays at the last given frame
    never = run(model={"explode_at": 1}, name="never.nc")
    for row, position in enumerate(given.values()):
        assert (written(never.path)[row] == position[5].astype(np.float32)).all()
    assert set(never.diverged.values()) == {6}


def test_the_search_that_is_timed_is_the_models(
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Where matter has collapsed, only the neighbours that the model hears are
    searched.
    """
    info = read_dataset_info(
        "curl-noise", "tiny", root=generated.root, registry=unmeasured
    )
    options = {"latent": 4, "layers": 1, "neighbours": 3}
    model = find("gns").model.build(options, info)
    stored = Checkpoint(
        baseline="gns",
        options=options,
        info=info,
        weights=model.state_dict(),
        training={"recipe": RECIPE},
    )
    save(tmp_path / "weights.pt", stored)
    asked = []

    def search(*given: Any, most: int | None) -> Tensor:
        asked.append(most)
        return radius_graph(*given, most=most)

    monkeypatch.setattr(prediction, "radius_graph", search)
    predict(
        tmp_path / "weights.pt",
        tmp_path / "p.nc",
        root=generated.root,
        threads=1,
        registry=unmeasured,
    )
    assert set(asked) == {3}


@pytest.mark.parametrize(("batch", "seconds"), [(1, 1.0), (2, 1.5)])
def test_frozen_frames_are_not_timed(
    run: Predict, monkeypatch: pytest.MonkeyPatch, batch: int, seconds: float
) -> None:
    """With a second per step, 4 of 20 frames before a burst cost 4 s, side by side 4 s
    in vain before.
    """
    slow = Mock(side_effect=Drift.advance)
    monkeypatch.setattr(Drift, "advance", lambda self, state: slow(self, state))
    monkeypatch.setattr(
        prediction, "time", SimpleNamespace(process_time=lambda: float(slow.call_count))
    )
    result = run(model={"explode_at": 4}, batch=batch)
    assert list(result.diverged.values()) == [9, 9]
    assert result.seconds_per_frame == seconds
    assert result.clock == "processor"  # one thread: what else runs here does not count


def windows(firsts: list[float]) -> Batch:
    """Return windows of three particles and two frames; the first particle stands where
    told.
    """
    position = torch.rand(
        (len(firsts) * 3, 2, 2), generator=torch.Generator().manual_seed(0)
    )
    position[::3, :, 0] = torch.tensor(firsts)[:, None]
    return Batch(
        position=position,
        sample=torch.arange(len(firsts)).repeat_interleave(3),
        material=torch.zeros(len(firsts) * 3, dtype=torch.int64),
        wall_velocity=torch.zeros(len(firsts), 2, 4, 2),
        scenario=torch.arange(len(firsts)) + 10,
        frame=torch.full((len(firsts),), 4),
    )


def test_a_diverging_scenario_leaves_others_alone() -> None:
    """Beside one that diverges, a scenario is predicted as it is alone."""
    model = Bursting.build({"start": 1.0}, INFO)
    batch = windows([0.9, 0.1])
    good, bad = roll_out(model, batch, 8)
    assert good.scenario == 10
    assert good.diverged_at is None
    # Frames 4 and 5 are given, 6 to 8 finite.
    assert bad.scenario == 11
    assert bad.diverged_at == 9
    alone = roll_out(model, select_window(batch, 0), 8)[0]
    assert torch.equal(good.position, alone.position)
    assert good.position.shape == bad.position.shape == (8, 3, 2)


class Wrong(Drift):
    """A Drift with another answer."""

    answer: Any = None

    def advance(self, state: State) -> Any:
        """Give the answer."""
        state, position = super().advance(state)
        return self.answer(state, position)


def test_a_rollout_is_frozen_before_it_is_too_far(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What the scorer would refuse is frozen within ten boxes, as what ceases to be
    finite is.
    """

    def fleeing(
        state: State, position: Tensor
    ) -> Any:  # a box farther to the right in every frame
        return state, position + torch.tensor([float(state[2] - 1), 0.0])

    monkeypatch.setattr(Wrong, "answer", staticmethod(fleeing))
    found = roll_out(Wrong.build({"start": 0.0}, INFO), windows([0.9]), 30)[0]
    assert found.diverged_at is not None
    assert 8.0 < float(found.position.max()) < 10.6
    assert torch.isfinite(found.position).all()


@pytest.mark.parametrize(
    "answer",
    [
        lambda state, position: (state, position[:1]),
        lambda state, position: (state, position.mean()),
        lambda state, position: (position, state),
        lambda state, position: (state, position.numpy()),
        lambda state, position: position,
    ],
)
def test_what_is_no_frame_is_not_broadcast(
    answer: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One particle, a mean, parts exchanged, an array or positions alone: told with the
    class.
    """
    monkeypatch.setattr(Wrong, "answer", staticmethod(answer))
    with torch.no_grad(), pytest.raises(UsageError) as caught:
        roll_out(Wrong.build({"start": 0.0}, INFO), windows([0.2, 0.9]), 3)
    assert caught.value.where == "Wrong.advance"


def test_rollouts_keep_mode_and_weights() -> None:
    """In training it is in training afterwards; rounded to bfloat16 for a while it has
    all its bits again.
    """
    drift = Drift.build({}, INFO).train()
    roll_out(drift, windows([0.9]), 1)
    assert drift.training
    model = torch.nn.Linear(8, 8)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with round_parameters(model):
        assert torch.equal(model.weight, before["weight"].bfloat16().float())
        assert not torch.equal(model.weight, before["weight"])
    assert all(
        torch.equal(value, before[name]) for name, value in model.state_dict().items()
    )


def test_only_the_given_frames_are_read(
    run: Predict, copied: Callable[[], Path]
) -> None:
    """With all later frames of test overwritten the predictions are the same."""
    root = copied()
    whole = run(name="a.nc", root=root)
    for file in (root / "curl-noise/tiny/v2/test").glob("*.nc"):
        file.chmod(0o644)
        with netCDF4.Dataset(file, "r+") as data:
            data["position"][6:] = 0.5
    blind = run(name="b.nc", root=root)
    assert np.array_equal(written(whole.path), written(blind.path))


def test_mistakes(run: Predict, generated: GenerationResult, tmp_path: Path) -> None:
    """Missing data, a missing checkpoint and a missing device have errors of their
    own.
    """
    made = run().path
    with pytest.raises(DataError) as caught:
        predict(tmp_path / "weights.pt", made, root=tmp_path / "nowhere")
    assert caught.value.where.endswith("nowhere/curl-noise/tiny/v2")
    with pytest.raises(UnreadableFileError) as caught:
        predict(tmp_path / "none.pt", made, root=generated.root)
    assert caught.value.where.endswith("none.pt")
    with pytest.raises(UsageError) as caught:
        run(device="tpu")
    assert caught.value.where == "--device"


def test_another_size_than_that_of_the_training(
    run: Predict, generated: GenerationResult, unmeasured: Registry
) -> None:
    """Four times as many particles are half as far apart; figures there, statistics of
    the training.
    """
    here = read_dataset_info(
        "curl-noise", "tiny", root=generated.root, registry=unmeasured
    )
    ones = dict.fromkeys(here.statistics, (1.0, 1.0))
    trained = replace(
        here,
        size="mini",
        dataset_sha256="0" * 64,
        radius=0.5,
        horizon=3,
        statistics=ones,
    )
    trained = replace(trained, particles=4 * here.particles)
    valid = {"metric": "vorticity_nrmse", "best": 0.2, "validations": [[9, 0.2]]}
    budget = {"cpu_hours": 0.1, "steps": 9, **valid}
    result = run(
        "scaled", start=0.5, info=trained, size="tiny", training={"budget": budget}
    )
    assert result.size == "tiny"
    assert result.trained_size == "mini"
    assert Scaled.told == replace(here, radius=1.0, statistics=ones)
    assert np.array_equal(
        written(result.path), written(run(start=0.5, name="own.nc").path)
    )
    report = examine(result.path, root=generated.root, registry=unmeasured)
    assert report.valid, report.findings
    assert json.loads(said(result.path)["budget"]) == {"cpu_hours": 0.1, "steps": 9}
    assert said(result.path)["training"].startswith("curl-noise mini train")
    other = replace(trained, frame_interval=2.0 * here.frame_interval)
    wrong = (
        ("drift", trained, "tiny"),
        ("scaled", other, "tiny"),
        ("scaled", trained, "small"),
    )
    for name, info, size in wrong:
        with pytest.raises(UsageError):
            run(name, size=size, info=info)
    with pytest.raises(DataError):
        run("scaled", size="tiny", info=replace(trained, version="0.9.0"))
    run("scaled", info=replace(here, radius=0.5))
    assert (
        Scaled.told.radius == 0.5
    )  # hashes do not hold it: at its own size that of the training counts


def test_a_model_is_changed_where_that_needs_no_weights(
    run: Predict, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An option of the model is as if it had been trained with, and the file says so;
    others are refused.

    By which ``--set`` the training's recipe became another is told apart from that.
    """
    recipe = recipe_for(
        find("gns"), "curl-noise", "tiny", settings=["training.steps=77"]
    ).as_json()
    result = run(training={"recipe": recipe}, settings=["model.explode_at=3"])
    trained = run(model={"explode_at": 3}, name="trained.nc")
    assert np.array_equal(written(result.path), written(trained.path), equal_nan=True)
    assert set(result.diverged.values()) == {8}
    before, _, after = said(result.path)["training"].partition("predicted with")
    assert "training.steps=77" in before
    assert "model.explode_at=3" not in before
    assert after.endswith("model.explode_at=3")
    install(monkeypatch, several=Several)
    for setting in ("training.steps=3", "model.explode=1", "model.count=2"):
        with pytest.raises(UsageError):
            run("several", settings=[setting])


def test_no_image_falls_sideways(
    tiny_split: Callable[..., GenerationResult], tmp_path: Path
) -> None:
    """Where gravity points down, images of the square are refused at prediction as in
    training.
    """
    root = tiny_split("fluid").root
    model = NeuralMPM.build(
        {"symmetry": "mirror"}, read_dataset_info("fluid", "tiny", root=root)
    )
    options = model.options.model_dump(mode="json")
    stored = Checkpoint(
        baseline="neuralmpm",
        options=options,
        info=model.info,
        weights=model.state_dict(),
        training={},
    )
    save(tmp_path / "weights.pt", stored)
    with pytest.raises(UsageError) as caught:
        predict(
            tmp_path / "weights.pt",
            tmp_path / "p.nc",
            root=root,
            settings=["model.symmetry=square"],
        )
    assert caught.value.where == "model.symmetry"
    assert not (tmp_path / "p.nc").exists()


def test_models_of_any_size_have_the_same_weights_at_each() -> None:
    """No parameter of theirs depends on the number of particles; MLPs and the like are
    not among them.
    """
    kinds = [
        f"{name}_{of}"
        for name in ("position", "velocity", "acceleration")
        for of in ("mean", "std")
    ]
    small = replace(INFO, statistics=dict.fromkeys(kinds, (0.5, 0.5)))
    large = replace(small, size="full", particles=12, radius=0.05)
    models = {
        name: entry.model for name, entry in load_all().items() if entry.model.any_size
    }
    assert (
        {"neuralmpm", "gns", "supergat"}
        <= set(models)
        <= set(load_all()) - {"mlp", "lstm", "var"}
    )
    for model in models.values():
        shapes = [
            {
                name: value.shape
                for name, value in model.build({}, info).state_dict().items()
            }
            for info in (small, large)
        ]
        assert shapes[0] == shapes[1], model.method


@pytest.mark.parametrize(
    "name",
    ["weights.pt", "training.nc", ".", "predictions.json", "taken.nc", "scenario.nc"],
)
def test_nothing_else_is_replaced(
    run: Predict,
    tmp_path: Path,
    name: str,
    monkeypatch: pytest.MonkeyPatch,
    generated: GenerationResult,
) -> None:
    """Not the weights, nor the record of their training, whose name that of the cost
    would be; no folder.

    No scenario, which is a file of the same format. Predictions and their cost have two
    names.
    """
    scenario = next(generated.folder.glob("test/*.nc")).read_bytes()
    (tmp_path / "scenario.nc").write_bytes(scenario)
    (tmp_path / "taken.json").mkdir()
    record = {**UNFINISHED, "state": "finished"}
    (tmp_path / "training.json").write_text(json.dumps(record))
    with pytest.raises(UsageError) as caught:
        run(name=name)
    assert caught.value.where == "--output"
    assert json.loads((tmp_path / "training.json").read_text()) == record
    assert load(tmp_path / "weights.pt").baseline == "drift"
    assert (tmp_path / "scenario.nc").read_bytes() == scenario
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError):
        check_replaceable(Path())
    run(name="predictions.nc")
    run(name="predictions.nc")
    # as scores have it too
    (tmp_path / "predictions.json").write_text('{"seconds_per_frame": 1.0}')
    with pytest.raises(UsageError):
        run(name="predictions.nc")


def test_out_of_memory(run: Predict, monkeypatch: pytest.MonkeyPatch) -> None:
    """When memory is full, the message says what to lower, and no file appears."""
    monkeypatch.setattr(
        Drift, "advance", Mock(side_effect=torch.OutOfMemoryError("no memory left"))
    )
    with pytest.raises(WorkFailedError):
        run(name="none.nc")


@pytest.mark.parametrize(
    "state", ["running", "interrupted", "failed", "finished", "stopped early"]
)
def test_weights_of_an_unfinished_training(
    run: Predict, tmp_path: Path, state: str
) -> None:
    """The record beside the weights says how far it came: those of the best step say
    'running' for good.
    """
    (tmp_path / "training.json").write_text(json.dumps({**UNFINISHED, "state": state}))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        run(training={"state": "running"})
    if state in OVER:
        assert not told
    else:
        assert [warning.category for warning in told] == [UnfinishedWarning]
        assert "step 9 of 70" in str(told[0].message)


@pytest.mark.parametrize(
    "record",
    [
        None,
        b"not JSON",
        b"[" * 100_000,
        json.dumps({**UNFINISHED, "step": "9", "steps": {}}).encode(),
        b'{"state": "running", "step": 9, "steps": 70, "recipe": {"name": "another"}}',
        json.dumps(UNFINISHED).encode() + b" " * LARGEST_LOG,
        "a pipe, which nobody writes to",
    ],
)
def test_what_is_no_record_of_these_weights_is_passed_over(
    run: Predict, tmp_path: Path, record: bytes | str | None
) -> None:
    """Weights alone, damaged records, those of other weights: predictions come without
    a warning.
    """
    if isinstance(record, bytes):
        (tmp_path / "training.json").write_bytes(record)
    elif record:
        os.mkfifo(tmp_path / "training.json")
    assert run(training={"state": "running"}).path.is_file()


CORES = len(os.sched_getaffinity(0))


@pytest.mark.parametrize(
    ("count", "environment", "processes", "expected"),
    [
        *(
            (3, "2", 1, 3),
            (None, "2", 1, 2),
            (None, "0", 1, 1),
            (None, "", 1, CORES),
            (None, "many", 1, CORES),
        ),
        *((None, "", CORES, 1), (None, "", CORES + 1, 1)),
    ],
)
def test_threads_are_those_asked_for(
    monkeypatch: pytest.MonkeyPatch,
    count: int | None,
    environment: str,
    processes: int,
    expected: int,
) -> None:
    """The option wins over OMP_NUM_THREADS, that over a share of the cores; afterwards
    all is as before.
    """
    monkeypatch.setenv("OMP_NUM_THREADS", environment)
    before = torch.get_num_threads()
    with use_threads(count, processes=processes):
        assert torch.get_num_threads() == expected
    assert torch.get_num_threads() == before
