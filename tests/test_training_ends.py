"""How a training ends: early, for good; and on a full disk or with a model that memory cannot hold."""

from __future__ import annotations

import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from simple_models import Drift, install

from lagbench.baselines.checkpoint import load, save
from lagbench.baselines.job import RunFolder
from lagbench.baselines.train import TrainingResult, train
from lagbench.data.registry import Registry
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.make.generate import GenerationResult
from lagbench.work.progress import Progress

Run = Callable[..., TrainingResult]

GREEDY = (1.0, 0.5)
"""Start and learning rate of a Drift that its second step takes past the best coefficient, for good."""


@pytest.fixture
def run(
    generated: GenerationResult, unmeasured: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Run:
    """Train on tiny curl-noise data on one thread."""
    install(monkeypatch, drift=Drift)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")

    def call(baseline: str, *settings: str, **options: Any) -> TrainingResult:
        return train(
            baseline,
            "curl-noise",
            "tiny",
            settings=settings,
            output=tmp_path / "run",
            threads=1,
            registry=unmeasured,
            root=generated.root,
            **options,
        )

    return call


def test_a_training_that_stopped_early_is_over(run: Run) -> None:
    """The same command again changes no byte of what an early stop left."""
    settings = (f"model.start={GREEDY[0]}", f"training.learning_rate={GREEDY[1]}", "training.steps=50")
    settings += ("training.validate_every=1", "training.patience=2")
    first = run("drift", *settings)
    files = (first.checkpoint, first.weights, first.folder / "training.json")
    before = [file.read_bytes() for file in files]
    again = run("drift", *settings)
    assert (again.state, again.step) == (first.state, first.step) == ("stopped early", first.step)
    assert first.step < 50
    assert (again.best_step, again.best_value) == (first.best_step, first.best_value)
    assert [file.read_bytes() for file in files] == before


def test_weights_without_a_checkpoint_are_not_replaced(run: Run) -> None:
    """Going on is refused where only weights are left: it is said whether that training is finished."""
    first = run("drift", "training.steps=1")
    first.checkpoint.unlink()
    before = {file: file.read_bytes() for file in (first.weights, first.folder / "training.json")}
    with pytest.raises(UsageError, match=r"the training is finished(.|\n)*--fresh"):
        run("drift", "training.steps=1")
    with pytest.raises(UsageError, match=r"no checkpoint to go on from(.|\n)*--fresh"):
        run("drift", "training.steps=2")
    with pytest.raises(UsageError, match="holds a training"):
        run("drift", "training.steps=1", resume=False)
    assert {file: file.read_bytes() for file in before} == before
    for content in (b"{", b"[]"):
        (first.folder / "training.json").write_bytes(content)
        with pytest.raises(UsageError, match="no checkpoint to go on from"):
            run("drift", "training.steps=1")
    assert run("drift", "training.steps=2", fresh=True).step == 2


def test_a_record_alone_is_no_training(run: Run) -> None:
    """What failed before it stored any weights is trained again."""
    first = run("drift", "training.steps=1")
    first.checkpoint.unlink()
    first.weights.unlink()
    assert run("drift", "training.steps=2").step == 2


def test_resumed_steps_are_not_counted_in_the_rate(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that goes on at step 3 tells 0 steps per second at first, and 1 after one step in one second."""
    settings = ("training.steps=5", "training.validate_every=0", "training.checkpoint_every=1")

    def stop(news: Progress) -> None:
        if news.stage != "predicting" and news.done == 3:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run("drift", *settings, progress=stop)
    heard: list[Progress] = []
    run("drift", *settings, progress=heard.append)
    assert [news.done for news in heard] == [3, 4, 5]
    assert {news.total for news in heard} == {5}
    rates = [replace(news, seconds=1.0 + i).rate for i, news in enumerate(heard)]
    assert rates == [0.0, 1 / 2, 2 / 3]


@pytest.mark.parametrize("split", ["fluid", "multimaterial"])
def test_gravity_has_no_square_of_images(split: str, tmp_path: Path) -> None:
    """Where gravity acts, only a mirror image is drawn; a box without it has all eight."""
    there = {"root": tmp_path, "settings": ("model.symmetry=square",)}
    with pytest.raises(UsageError, match=r"gravity in(.|\n)*model\.symmetry=mirror"):
        train("gns", split, "tiny", **there)
    with pytest.raises(DataError):  # no data are there: what comes next is looked at
        train("gns", split, "tiny", root=tmp_path, settings=("model.symmetry=mirror",))
    with pytest.raises(DataError):
        train("gns", "cavity", "tiny", **there)


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Let the system refuse files above a size, as it refuses them on a full disk [byte]."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk(run: Run) -> None:
    """Where a checkpoint does not fit on the disk, that is said, and the one before stays."""
    path = run("drift", "training.steps=1").checkpoint
    before, found = path.read_bytes(), load(path)
    larger = replace(found, weights={**found.weights, "more": torch.ones(10**5)})
    with largest_file(10**5), pytest.raises(WorkFailedError, match="free disk space") as caught:
        save(path, larger)
    assert "checkpoint.pt" in str(caught.value)
    left = {file.name for file in path.parent.iterdir() if file.is_file()}
    assert left == {"checkpoint.pt", "training.json", "weights.pt"}
    assert path.read_bytes() == before


@pytest.mark.parametrize("baseline", ["gns", "var"])
def test_a_model_that_memory_cannot_hold(run: Run, baseline: str) -> None:
    """A model of 10^15 numbers ends with what to lower, before any step."""
    setting = "model.lags=1000000000" if baseline == "var" else "model.latent=10000000"
    with pytest.raises(WorkFailedError, match="out of memory") as caught:
        run(baseline, setting)
    assert setting.partition("=")[0].partition(".")[2] in str(caught.value)


@pytest.mark.parametrize(
    "setting",
    [
        "training.epochs=.inf",
        "training.clip=.inf",
        "model.noise_std=.inf",
        "model.radius=.inf",
        "model.loss.vorticity=.inf",
        "model.link_weight=.inf",
    ],
)
def test_numbers_without_end_are_refused(run: Run, setting: str) -> None:
    """No option is infinite; the message names it."""
    with pytest.raises(UsageError, match=setting.partition("=")[0].replace(".", r"\.")):
        run("gns", setting)


def test_only_our_own_logs_are_cleared(tmp_path: Path) -> None:
    """A tensorboard folder that holds somebody else's runs keeps them; one of ours goes."""
    theirs, ours = tmp_path / "theirs", tmp_path / "ours"
    (theirs / "tensorboard" / "my-runs").mkdir(parents=True)
    (theirs / "tensorboard" / "my-runs" / "notes.txt").write_text("precious")
    (ours / "tensorboard").mkdir(parents=True)
    for name in ("events.out.tfevents.1.host.2.0", "hparams.yaml"):
        (ours / "tensorboard" / name).touch()
        (theirs / "tensorboard" / name).touch()
    for folder in (theirs, ours):
        RunFolder(folder).clear()
    assert [path.name for path in theirs.rglob("*") if path.is_file()] == ["notes.txt"]
    assert list(ours.iterdir()) == []
