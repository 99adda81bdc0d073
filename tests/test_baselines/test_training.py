"""Training: what it converges to, how it goes on after an interrupt, how it stops and
ends.
"""

from __future__ import annotations

import json
import os
import random
import signal
from collections.abc import Callable
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pandas as pd
import pytest
import torch
from file_size_limit import largest_file
from scipy.special import comb
from simple_models import INFO, Drift, trainer

from lagbench.baselines.baseline import Batch
from lagbench.baselines.checkpoint import load, save
from lagbench.baselines.optimisation import Optimisation
from lagbench.baselines.recipe import TrainingOptions
from lagbench.baselines.run_folder import RunFolder
from lagbench.baselines.train import StepBatches, TrainingResult, train
from lagbench.data.registry import Registry
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.make.generate import GenerationResult
from lagbench.torch import WindowDataset, WindowSampler
from lagbench.work.progress import Progress

Run = Callable[..., TrainingResult]


@pytest.fixture
def run(
    generated: GenerationResult,
    unmeasured: Registry,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Run:
    """Train on tiny curl-noise data."""
    return trainer(
        generated.root, unmeasured, tmp_path, monkeypatch, drift=Drift, wrong=Wrong
    )


class Wrong(Drift):
    """A Drift with another loss."""

    loss: Any = None

    def forward(self, batch: Batch, generator: torch.Generator | None = None) -> Any:
        """Return it."""
        return self.loss(super().forward(batch, generator)["motion"])


@pytest.mark.parametrize(
    "loss",
    [
        lambda motion: motion,
        lambda motion: {"motion": motion.detach()},
        lambda motion: {"motion": motion * torch.ones(3)},
        lambda motion: {"motion": motion.item()},
        lambda motion: {},
        lambda motion: {"motion": motion * torch.ones(3), "idle": motion},
    ],
)
def test_a_loss_that_nothing_is_learned_from(
    run: Run, monkeypatch: pytest.MonkeyPatch, loss: Any
) -> None:
    """No dict, nothing that depends on a parameter, several numbers, no tensor, no
    term.
    """
    monkeypatch.setattr(Wrong, "loss", staticmethod(loss))
    with pytest.raises(UsageError) as caught:
        run("wrong", "steps=2")
    assert caught.value.where == "Wrong.forward"


def interrupt_at(step: int) -> Callable[[Progress], None]:
    """Return a listener that presses Ctrl-C after a step."""

    def listen(news: Progress) -> None:
        if news.stage != "predicting" and news.done == step:
            os.kill(os.getpid(), signal.SIGINT)

    return listen


@pytest.fixture
def stepped(monkeypatch: pytest.MonkeyPatch) -> list[tuple[float, float]]:
    """Return the length of the gradient and the first weight after each step of the
    optimiser.
    """
    seen: list[tuple[float, float]] = []
    step = torch.optim.AdamW.step

    def watched(self: torch.optim.AdamW, *args: Any, **kwargs: Any) -> Any:
        out = step(self, *args, **kwargs)
        first = self.param_groups[0]["params"][0]
        seen.append((float(first.grad.norm()), float(first.detach())))
        return out

    monkeypatch.setattr(torch.optim.AdamW, "step", watched)
    return seen


def same(first: Path, second: Path) -> bool:
    """Return whether two checkpoints hold the same bits."""
    one = load(first).weights
    other = load(second).weights
    return one.keys() == other.keys() and all(
        torch.equal(one[name], other[name]) for name in one
    )


def test_converges_to_least_squares(run: Run, generated: GenerationResult) -> None:
    """The coefficient becomes sum(u(f) u(f+1)) / sum(u(f)^2) over train."""
    result = run(
        "drift",
        "steps=250",
        "batch=8",
        "learning_rate=0.03",
        "schedule=cosine",
        "validate_every=0",
    )
    above = below = 0.0
    for file in generated.folder.glob("train/*.nc"):  # read without our code
        with netCDF4.Dataset(file) as data:
            velocity = np.diff(np.asarray(data["position"][:], np.float64), axis=0)
        above += float((velocity[1:] * velocity[:-1]).sum())
        below += float((velocity[:-1] ** 2).sum())
    assert float(load(result.checkpoint).weights["a"]) == pytest.approx(
        above / below, abs=2e-3
    )
    assert result.state == "finished"
    assert result.parameters == 1


@pytest.mark.parametrize("baseline", ["supergat", "neuralmpm", "drift"])
def test_resumed_equals_uninterrupted(run: Run, baseline: str, tmp_path: Path) -> None:
    """Interrupted twice and resumed, a training ends with the bits of an uninterrupted
    one.
    """
    settings = ("steps=7", "validate_every=3", "schedule=cosine")
    settings += ("model.noise_std=1e-4",) if baseline != "drift" else ()
    if baseline == "neuralmpm":
        settings += (
            "ema=0.9",
            "model.strain=true",
            "model.pushforward=2",
            "model.recovery=4",
        )
    whole = run(baseline, *settings, to="whole")
    for step in (2, 5):
        with pytest.raises(KeyboardInterrupt):
            run(baseline, *settings, to="parts", progress=interrupt_at(step))
        stopped = json.loads((tmp_path / "parts/training.json").read_text())
        assert stopped["state"] == "interrupted"
        assert stopped["step"] == step
    parts = run(baseline, *settings, to="parts")
    assert parts.state == "finished"
    assert parts.first_step == 5
    assert parts.step == 7
    assert same(whole.checkpoint, parts.checkpoint)
    assert same(whole.weights, parts.weights)
    assert whole.best_value == parts.best_value
    assert whole.best_step == parts.best_step


@pytest.mark.parametrize(("baseline", "steps"), [("drift", 3), ("var", 1)])
def test_a_finished_training_is_not_repeated(
    run: Run, baseline: str, steps: int
) -> None:
    """The same command again changes nothing, nor fits a closed form twice, which
    counts as one step.
    """
    settings = () if baseline == "var" else (f"steps={steps}",)
    first = run(baseline, *settings)
    assert first.state == "finished"
    assert first.step == steps
    assert first.steps == steps
    assert first.weights.exists()
    before = first.checkpoint.read_bytes()
    stamp = first.checkpoint.stat().st_mtime_ns
    again = run(baseline, *settings)
    assert again.state == "finished"
    assert again.first_step == steps
    assert again.step == steps
    assert first.checkpoint.read_bytes() == before
    assert first.checkpoint.stat().st_mtime_ns == stamp


def test_seeds(run: Run) -> None:
    """The same seed gives the same weights, another seed others."""
    first, second, other = (
        run("gns", "steps=2", "validate_every=0", to=f"run{number}", seed=seed)
        for number, seed in enumerate((3, 3, 4))
    )
    assert same(first.checkpoint, second.checkpoint)
    assert not same(first.checkpoint, other.checkpoint)


def test_chance_of_the_caller_is_left_alone(run: Run) -> None:
    """Training draws nothing from the caller's generators."""
    drawn = []
    for steps in (2, 0):
        random.seed(5)
        np.random.seed(5)  # noqa: NPY002 (it must not change)
        torch.manual_seed(5)
        if steps:
            run("drift", f"steps={steps}")
        drawn.append((random.random(), float(np.random.random()), float(torch.rand(1))))  # noqa: NPY002
    assert drawn[0] == drawn[1]


def test_a_loss_that_is_not_finite(run: Run, tmp_path: Path) -> None:
    """NaN stops with the step and the term; the checkpoint before it stays."""
    with pytest.raises(WorkFailedError) as caught:
        run("drift", "model.fail_at=6", "steps=9", "checkpoint_every=4")
    assert caught.value.where == "step 6"
    assert "motion" not in str(caught.value)
    kept = load(tmp_path / "run/checkpoint.pt")
    assert kept.training["step"] == 4
    assert torch.isfinite(kept.weights["a"]).all()
    assert json.loads((tmp_path / "run/training.json").read_text())["state"] == "failed"


def test_a_training_that_stopped_early_is_over(run: Run) -> None:
    """Validations that bring nothing new end it with the best weights; again, no byte
    changes.
    """
    # The best coefficient is near 1; with this rate the second step overshoots it for
    # good.
    settings = (
        "model.start=1.0",
        "learning_rate=0.5",
        "steps=50",
        "validate_every=1",
        "patience=3",
    )
    first = run("drift", *settings)
    files = (first.checkpoint, first.weights, first.folder / "training.json")
    before = [file.read_bytes() for file in files]
    values = [entry["vorticity_nrmse"] for entry in json.loads(before[2])["validation"]]
    assert first.state == "stopped early"
    assert first.step == int(np.argmin(values)) + 1 + 3
    assert first.step < 50
    assert load(first.weights).training["step"] == first.best_step
    again = run("drift", *settings)
    assert again.state == first.state
    assert again.step == first.step
    assert again.best_step == first.best_step
    assert [file.read_bytes() for file in files] == before


@pytest.mark.parametrize(
    ("baseline", "setting"),
    [
        ("drift", "training.compile=true"),
        ("var", "training.ema=0.9"),
        ("gns", "model.link_weight=2"),
    ],
)
def test_what_a_model_cannot_use_is_refused(
    run: Run, baseline: str, setting: str
) -> None:
    """Layers to compile, steps to average over, links to predict: before it trains."""
    with pytest.raises(UsageError) as caught:
        run(baseline, setting)
    assert caught.value.where == setting.partition("=")[0]


def test_folders_are_guarded(run: Run) -> None:
    """Another recipe in a folder is refused unless the user wants to train anew."""
    run("drift", "steps=2")
    with pytest.raises(UsageError) as caught:
        run("drift", "steps=3")
    assert caught.value.where.endswith("/run")
    with pytest.raises(UsageError) as caught:
        run("drift", "steps=2", resume=False)
    assert caught.value.where.endswith("/run")
    assert run("drift", "steps=3", fresh=True).step == 3


def test_learning_rate_follows_the_processes() -> None:
    """Thesis section 5.7.3: the rate is multiplied by the number of processes."""
    model = Drift.build({}, INFO)
    options = TrainingOptions(steps=5, learning_rate=0.01)
    one, three = (
        Optimisation(
            model,
            options,
            steps=5,
            processes=processes,
        )
        for processes in (1, 3)
    )
    assert three.learning_rate == pytest.approx(3 * one.learning_rate)


def test_gradients_are_clipped(run: Run, stepped: list[tuple[float, float]]) -> None:
    """A gradient longer than `clip` is scaled to it before the optimiser sees it."""
    run("drift", "steps=2", "validate_every=0")
    run("drift", "steps=2", "validate_every=0", "clip=0.001", to="clipped")
    lengths = [length for length, _ in stepped]
    assert min(lengths[:2]) > 0.001
    assert lengths[2:] == pytest.approx([0.001, 0.001], rel=1e-3)


@pytest.mark.parametrize("ema", [0.1, 0.9])
def test_the_mean_of_the_weights_is_published(
    run: Run, stepped: list[tuple[float, float]], ema: float
) -> None:
    """Bounded by a share, rising towards it; training goes on from the last weights."""
    result = run(
        "drift", "steps=6", "learning_rate=0.1", "validate_every=2", f"ema={ema}"
    )
    seen = [weight for _, weight in stepped]
    if ema == 0.1:  # means that keep a tenth of themselves
        means = [
            float(mean) for mean in pd.Series(seen).ewm(alpha=0.9, adjust=False).mean()
        ]
    else:
        # Means keep n / (n + 9): binomial weights C(k + 8, 8), of sum C(n + 9, 9).
        weighted = [seen[0], *(comb(k + 8, 8) * x for k, x in enumerate(seen, start=1))]
        means = [
            float(sum(weighted[: n + 1]) / comb(n + 9, 9))
            for n in range(1, len(seen) + 1)
        ]
    last = load(result.checkpoint)
    assert float(last.weights["a"]) == pytest.approx(seen[-1], rel=1e-6)
    best = means[(result.best_step or 0) - 1]
    assert float(load(result.weights).weights["a"]) == float(
        torch.tensor(best).bfloat16()
    )
    assert float((last.optimizer or {})["state"][0]["mean"]) == pytest.approx(
        means[-1], rel=1e-6
    )


@pytest.mark.parametrize("ranks", [1, 3])
def test_batches_from_any_step(
    generated: GenerationResult, unmeasured: Registry, ranks: int
) -> None:
    """The windows of step k are the same whether the order is read from step 0 or from
    step k.
    """
    data = WindowDataset(
        "curl-noise", size="tiny", root=generated.root, history=2, registry=unmeasured
    )
    drawn_here: list[list[int]] = []
    for rank in range(ranks):

        def drawn(first: int, share: float = 0.0, rank: int = rank) -> list[list[int]]:
            sampler = WindowSampler(data, seed=1, rank=rank, ranks=ranks)
            options = TrainingOptions(batch=5, opening_share=share, opening_frames=3)
            return list(StepBatches(sampler, options, first=first, last=23))

        whole = drawn(0)
        others = drawn(0, share=0.6)
        assert all(drawn(first) == whole[first:] for first in range(23))
        assert all(drawn(first, share=0.6) == others[first:] for first in range(23))
        assert {len(batch) for batch in whole + others} == {5}
        epoch = list(
            islice((window for batch in whole for window in batch), len(data) // ranks)
        )
        assert len(set(epoch)) == len(epoch)
        changed = [
            b for a, b in zip(chain(*whole), chain(*others), strict=True) if a != b
        ]
        assert 0.4 * 115 < len(changed) < 0.75 * 115
        assert {data[window].frame for window in changed} == {0, 1, 2}
        assert {data[window].scenario for window in changed} == set(data.scenarios)
        drawn_here.append(changed)
    assert len(set(map(tuple, drawn_here))) == ranks  # no two processes draw alike


def test_weights_without_a_checkpoint_are_not_replaced(run: Run) -> None:
    """Going on is refused where only weights are left: it is said whether that training
    is finished.
    """
    first = run("drift", "steps=1")
    first.checkpoint.unlink()
    before = {
        file: file.read_bytes()
        for file in (first.weights, first.folder / "training.json")
    }
    for steps, resume, words in (
        (1, True, r"the training is finished(.|\n)*--fresh"),
        (2, True, r"no checkpoint to go on from(.|\n)*--fresh"),
        (1, False, "holds a training"),
    ):
        with pytest.raises(UsageError, match=words):
            run("drift", f"steps={steps}", resume=resume)
    assert {file: file.read_bytes() for file in before} == before
    for content in (b"{", b"[]"):
        (first.folder / "training.json").write_bytes(content)
        with pytest.raises(UsageError) as caught:
            run("drift", "steps=1")
        assert caught.value.where.endswith("/run")
    assert run("drift", "steps=2", fresh=True).step == 2
    first.checkpoint.unlink()
    first.weights.unlink()
    assert (
        run("drift", "steps=1").step == 1
    )  # what failed before it stored any weights is trained again


def test_resumed_steps_are_not_counted_in_the_rate(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that goes on at step 3 tells 0 steps per second at first, and 1 after one
    step in one second.
    """
    settings = ("steps=5", "validate_every=0", "checkpoint_every=1")

    with pytest.raises(KeyboardInterrupt):
        run("drift", *settings, progress=interrupt_at(3))
    heard: list[Progress] = []
    run("drift", *settings, progress=heard.append)
    assert [news.done for news in heard] == [3, 4, 5]
    assert {news.total for news in heard} == {5}
    rates = [replace(news, seconds=1.0 + i).rate for i, news in enumerate(heard)]
    assert rates == [0.0, 1 / 2, 2 / 3]


@pytest.mark.parametrize("split", ["fluid", "multimaterial"])
def test_gravity_has_no_square_of_images(split: str, tmp_path: Path) -> None:
    """Where gravity acts, only a mirror image is drawn; a box without it has all
    eight.
    """
    with pytest.raises(UsageError) as caught:
        train("gns", split, "tiny", root=tmp_path, settings=("model.symmetry=square",))
    assert caught.value.where == "model.symmetry"
    for other, images in ((split, "mirror"), ("cavity", "square")):
        with pytest.raises(
            DataError
        ):  # no data are there: what comes next is looked at
            train(
                "gns",
                other,
                "tiny",
                root=tmp_path,
                settings=(f"model.symmetry={images}",),
            )


def test_a_full_disk(run: Run) -> None:
    """Where a checkpoint does not fit on the disk, that is said, and the one before
    stays.
    """
    path = run("drift", "steps=1").checkpoint
    before = path.read_bytes()
    found = load(path)
    larger = replace(found, weights={**found.weights, "more": torch.ones(10**5)})
    with (
        largest_file(10**5),
        pytest.raises(WorkFailedError, match="free disk space") as caught,
    ):
        save(path, larger)
    assert "checkpoint.pt" in str(caught.value)
    left = {file.name for file in path.parent.iterdir() if file.is_file()}
    assert left == {"checkpoint.pt", "training.json", "weights.pt"}
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("baseline", "setting", "lower"),
    [
        ("wrong", "training.steps=2", r"lower --set training\.batch"),
        ("gns", "model.latent=10000000", "latent"),
        ("var", "model.lags=1000000000", "lags"),
    ],
)
def test_out_of_memory(
    run: Run, monkeypatch: pytest.MonkeyPatch, baseline: str, setting: str, lower: str
) -> None:
    """When memory is full, by a model of 10^15 numbers before any step, the message
    says what to lower.
    """
    monkeypatch.setattr(Wrong, "loss", lambda *_: {"motion": torch.zeros(2**50)})
    with pytest.raises(WorkFailedError, match=rf"out of memory(.|\n)*{lower}"):
        run(baseline, setting)


@pytest.mark.parametrize(
    "key", ["noise_std", "radius", "loss.vorticity", "link_weight", "epochs", "clip"]
)
def test_numbers_without_end_are_refused(run: Run, key: str) -> None:
    """No option is infinite; the message names it."""
    group = "training" if key in ("epochs", "clip") else "model"
    with pytest.raises(UsageError, match=rf"{group}\.{key}"):
        run("gns", f"{group}.{key}=.inf")


def test_only_our_own_logs_are_cleared(tmp_path: Path) -> None:
    """A tensorboard folder that holds somebody else's runs keeps them; one of ours
    goes.
    """
    theirs = tmp_path / "theirs"
    ours = tmp_path / "ours"
    (theirs / "tensorboard" / "my-runs").mkdir(parents=True)
    (theirs / "tensorboard" / "my-runs" / "notes.txt").write_text("precious")
    (ours / "tensorboard").mkdir(parents=True)
    for folder in (theirs, ours):
        for name in ("events.out.tfevents.1.host.2.0", "hparams.yaml"):
            (folder / "tensorboard" / name).touch()
        RunFolder(folder).clear()
    assert [path.name for path in theirs.rglob("*") if path.is_file()] == ["notes.txt"]
    assert list(ours.iterdir()) == []
