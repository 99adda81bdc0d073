"""Training: what it converges to, how it goes on after an interrupt, and how it stops."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import netCDF4
import numpy as np
import pytest
import torch
from simple_models import FACTS, Drift, install
from torch import Tensor

from lagbench.baselines.baseline import Batch
from lagbench.baselines.checkpoint import load
from lagbench.baselines.module import TrainingModule
from lagbench.baselines.recipe import TrainingOptions
from lagbench.baselines.train import StepBatches, TrainingResult, train
from lagbench.data.registry import Registry
from lagbench.errors import UsageError, WorkFailedError
from lagbench.make.generate import GenerationResult
from lagbench.torch import WindowDataset, WindowSampler
from lagbench.work.progress import Progress

Run = Callable[..., TrainingResult]


@pytest.fixture
def run(
    generated: GenerationResult, unmeasured: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Run:
    """Train on tiny curl-noise data on one thread, a Drift by default."""
    install(monkeypatch, drift=Drift, greedy=Greedy)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")

    def call(baseline: str = "drift", folder: str = "run", *settings: str, **options: Any) -> TrainingResult:
        options = {"root": generated.root, **options}
        return train(
            baseline,
            "curl-noise",
            "tiny",
            settings=tuple(f"training.{one}" if one[:6] != "model." else one for one in settings),
            output=tmp_path / folder,
            threads=1,
            registry=unmeasured,
            **options,
        )

    return call


class Greedy(Drift):
    """Asks for more memory than there is."""

    def forward(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Return more than there is."""
        return {"motion": torch.zeros(2**50)}


def interrupt_at(step: int) -> Callable[[Progress], None]:
    """Return a listener that presses Ctrl-C after a step."""

    def listen(news: Progress) -> None:
        if news.stage != "predicting" and news.done == step:
            os.kill(os.getpid(), signal.SIGINT)

    return listen


def weights(path: Path) -> dict[str, Tensor]:
    """Return the weights of a checkpoint."""
    return dict(load(path).weights)


def same(first: Path, second: Path) -> bool:
    """Return whether two checkpoints hold the same bits."""
    one, other = weights(first), weights(second)
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def train_positions(root: Path) -> list[np.ndarray]:
    """Return the positions of the train scenarios, read without our code."""
    files = sorted((root / "curl-noise/tiny/v2/train").glob("*.nc"))
    found = []
    for file in files:
        with netCDF4.Dataset(file) as data:
            found.append(np.asarray(data["position"][:], np.float64))
    return found


def test_converges_to_least_squares(run: Run, generated: GenerationResult) -> None:
    """The coefficient becomes sum(u(f) u(f+1)) / sum(u(f)^2) over train."""
    result = run(
        "drift", "run", "steps=250", "batch=8", "learning_rate=0.03", "schedule=cosine", "validate_every=0"
    )
    above = below = 0.0
    for position in train_positions(generated.root):
        velocity = np.diff(position, axis=0)
        above += float((velocity[1:] * velocity[:-1]).sum())
        below += float((velocity[:-1] ** 2).sum())
    assert float(weights(result.checkpoint)["a"]) == pytest.approx(above / below, abs=2e-3)
    assert result.state == "finished"
    assert result.parameters == 1


def test_the_record(run: Run) -> None:
    """training.json says what was done, what it cost, and on what data."""
    result = run("drift", "run", "steps=6", "validate_every=2")
    record = json.loads((result.folder / "training.json").read_text())
    assert (record["state"], record["step"], record["windows"]) == ("finished", 6, 48)
    assert record["recipe"]["training"]["steps"] == 6
    assert [entry["step"] for entry in record["validation"]] == [2, 4, 6]
    assert 0 < record["cpu_seconds"] < 100
    assert record["loss"]["total"] == pytest.approx(record["loss"]["motion"] + record["loss"]["swirl"])
    assert list((result.folder / "tensorboard").iterdir())


@pytest.mark.parametrize("baseline", ["supergat", "neuralmpm", "drift"])
def test_resumed_equals_uninterrupted(run: Run, baseline: str, tmp_path: Path) -> None:
    """Interrupted twice and resumed, a training ends with the bits of an uninterrupted one."""
    settings = ("steps=7", "validate_every=3", "schedule=cosine")
    settings += ("model.noise_std=1e-4",) if baseline != "drift" else ()
    whole = run(baseline, "whole", *settings)
    for step in (2, 5):
        with pytest.raises(KeyboardInterrupt):
            run(baseline, "parts", *settings, progress=interrupt_at(step))
        stopped = json.loads((tmp_path / "parts/training.json").read_text())
        assert (stopped["state"], stopped["step"]) == ("interrupted", step)
    parts = run(baseline, "parts", *settings)
    assert (parts.state, parts.step) == ("finished", 7)
    assert same(whole.checkpoint, parts.checkpoint)
    assert same(whole.weights, parts.weights)
    assert (whole.best_value, whole.best_step) == (parts.best_value, parts.best_step)


def test_a_finished_training_is_not_repeated(run: Run) -> None:
    """The same command again changes nothing."""
    first = run("drift", "run", "steps=3")
    before = first.checkpoint.read_bytes()
    again = run("drift", "run", "steps=3")
    assert (again.state, again.step) == ("finished", 3)
    assert first.checkpoint.read_bytes() == before


def test_seeds(run: Run) -> None:
    """The same seed gives the same weights, another seed others."""
    first, second, other = (
        run("gns", f"run{number}", "steps=2", "validate_every=0", seed=seed)
        for number, seed in enumerate((3, 3, 4))
    )
    assert same(first.checkpoint, second.checkpoint)
    assert not same(first.checkpoint, other.checkpoint)


def test_chance_of_the_caller_is_left_alone(run: Run) -> None:
    """Training draws nothing from the caller's generators."""
    random.seed(5)
    np.random.seed(5)  # noqa: NPY002 (it must not change)
    torch.manual_seed(5)
    run("drift", "run", "steps=2")
    found = random.random(), float(np.random.random()), float(torch.rand(1))  # noqa: NPY002
    random.seed(5)
    np.random.seed(5)  # noqa: NPY002
    torch.manual_seed(5)
    assert found == (random.random(), float(np.random.random()), float(torch.rand(1)))  # noqa: NPY002


def test_a_loss_that_is_not_finite(run: Run, tmp_path: Path) -> None:
    """NaN stops with the step and the term; the checkpoint before it stays."""
    with pytest.raises(WorkFailedError, match="swirl") as caught:
        run("drift", "run", "model.fail_at=6", "steps=9", "checkpoint_every=4")
    assert "step 6" in str(caught.value)
    assert "motion" not in str(caught.value)
    kept = load(tmp_path / "run/checkpoint.pt")
    assert kept.training["step"] == 4
    assert torch.isfinite(kept.weights["a"]).all()
    assert json.loads((tmp_path / "run/training.json").read_text())["state"] == "failed"


def test_out_of_memory(run: Run) -> None:
    """When memory is full, the message says what to lower."""
    with pytest.raises(WorkFailedError, match=r"lower --set training\.batch"):
        run("greedy", "run", "steps=2")


def test_early_stop(run: Run) -> None:
    """Training stops when validations bring nothing new, and the best weights are those kept."""
    # The best coefficient is near 1; with this rate the second step overshoots it for good.
    result = run(
        "drift", "run", "model.start=1.0", "steps=50", "validate_every=1", "patience=3", "learning_rate=0.5"
    )
    record = json.loads((result.folder / "training.json").read_text())
    values = [entry["vorticity_nrmse"] for entry in record["validation"]]
    assert result.state == "stopped early"
    assert result.step == int(np.argmin(values)) + 1 + 3 < 50
    assert load(result.weights).training["step"] == result.best_step


def test_what_has_no_layers_is_not_compiled(run: Run) -> None:
    """A model without layers to compile refuses the option before it trains."""
    with pytest.raises(UsageError) as caught:
        run("drift", "run", "steps=2", "compile=true")
    assert caught.value.where == "training.compile"


def test_folders_are_guarded(run: Run) -> None:
    """Another recipe in a folder is refused unless the user wants to train anew."""
    run("drift", "run", "steps=2")
    with pytest.raises(UsageError, match=r"training\.steps = 3"):
        run("drift", "run", "steps=3")
    with pytest.raises(UsageError, match="--resume"):
        run("drift", "run", "steps=2", resume=False)
    assert run("drift", "run", "steps=3", fresh=True).step == 3


def test_the_test_subset_is_never_read(run: Run, generated: GenerationResult, tmp_path: Path) -> None:
    """Training and validation work where no test scenario is on the disk."""
    root = tmp_path / "root"
    shutil.copytree(generated.root, root)
    shutil.rmtree(root / "curl-noise/tiny/v2/test")
    assert run("drift", "run", "steps=2", root=root).best_value is not None


def test_learning_rate_follows_the_processes() -> None:
    """Thesis section 5.7.3: the rate is multiplied by the number of processes."""

    def rate(processes: int) -> float:
        module = TrainingModule(
            Drift.build({}, FACTS),
            TrainingOptions(steps=5, learning_rate=0.01),
            loader=lambda rank, ranks: NotImplemented,
            steps=5,
            processes=processes,
        )
        return module.learning_rate

    assert rate(3) == pytest.approx(3 * rate(1))


def test_gradients_are_clipped(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gradient longer than `clip` is scaled to it before the optimiser sees it."""
    seen = []
    step = torch.optim.AdamW.step

    def watched(self: torch.optim.AdamW, *args: Any, **kwargs: Any) -> Any:
        out = step(self, *args, **kwargs)
        seen.append(float(self.param_groups[0]["params"][0].grad.norm()))
        return out

    monkeypatch.setattr(torch.optim.AdamW, "step", watched)
    run("drift", "free", "steps=2", "validate_every=0")
    run("drift", "clipped", "steps=2", "validate_every=0", "clip=0.001")
    assert min(seen[:2]) > 0.001
    assert seen[2:] == pytest.approx([0.001, 0.001], rel=1e-3)


@pytest.mark.parametrize("ranks", [1, 3])
def test_batches_from_any_step(generated: GenerationResult, unmeasured: Registry, ranks: int) -> None:
    """The windows of step k are the same whether the order is read from step 0 or from step k."""
    data = WindowDataset("curl-noise", size="tiny", root=generated.root, history=2, registry=unmeasured)
    for rank in range(ranks):

        def drawn(first: int, rank: int = rank) -> list[list[int]]:
            sampler = WindowSampler(data, seed=1, rank=rank, ranks=ranks)
            return list(StepBatches(sampler, 5, first=first, last=23))

        whole = drawn(0)
        assert all(drawn(first) == whole[first:] for first in range(23))
        assert {len(batch) for batch in whole} == {5}
        epoch = list(islice((window for batch in whole for window in batch), len(data) // ranks))
        assert len(set(epoch)) == len(epoch)


def test_closed_forms_go_through_the_same_door(run: Run) -> None:
    """A VAR is fitted, stored and validated like the others; again, it is not fitted twice."""
    result = run("var", "run")
    assert (result.state, result.step, result.steps) == ("finished", 1, 1)
    assert result.weights.exists()
    stamp = result.checkpoint.stat().st_mtime_ns
    assert run("var", "run").state == "finished"
    assert result.checkpoint.stat().st_mtime_ns == stamp
