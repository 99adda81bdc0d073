"""Training: its result, interrupts and resumption, how it stops and ends."""

from __future__ import annotations

import os
import random
import shutil
import signal
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import h5py
import netCDF4
import numpy as np
import pandas as pd
import pytest
import torch
from scipy.special import comb
from simple_models import Drift, read_training_log, trainer

from lagbench.baselines.baseline import Batch
from lagbench.baselines.checkpoint import load
from lagbench.baselines.recipe import TrainingOptions
from lagbench.baselines.train import (
    StepBatches,
    TrainingResult,
)
from lagbench.data.registry import Registry
from lagbench.errors import (
    DataError,
    UsageError,
    WorkFailedError,
)
from lagbench.make.generate import GenerationResult
from lagbench.torch import WindowDataset, WindowSampler
from lagbench.work.run import Progress

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
        generated.root,
        unmeasured,
        tmp_path,
        monkeypatch,
        drift=Drift,
        fitted=FittedDrift,
    )


def interrupt_at(
    step: int, number: int = signal.SIGINT, *, times: int = 1
) -> Callable[[Progress], None]:
    """Return a listener that presses Ctrl-C, or sends a signal, after a step."""

    def listen(news: Progress) -> None:
        if news.stage != "predicting" and news.done == step:
            for _ in range(times):
                os.kill(os.getpid(), number)

    return listen


@dataclass
class Step:
    """The first parameter at a step of the optimiser."""

    gradient_length: float
    weight: float  # after the step


@pytest.fixture
def steps_taken(monkeypatch: pytest.MonkeyPatch) -> list[Step]:
    """A list that the steps of the optimiser are added to."""
    steps: list[Step] = []
    take_step = torch.optim.AdamW.step

    def record_step(self: torch.optim.AdamW, *args: Any, **kwargs: Any) -> Any:
        result = take_step(self, *args, **kwargs)
        first = self.param_groups[0]["params"][0]
        length = float(first.grad.norm())
        steps.append(Step(length, float(first.detach())))
        return result

    monkeypatch.setattr(torch.optim.AdamW, "step", record_step)
    return steps


def have_same_weights(first: Path, second: Path) -> bool:
    """Return whether two checkpoints have the same bits."""
    first_weights = load(first).weights
    second_weights = load(second).weights
    if first_weights.keys() != second_weights.keys():
        return False
    for name, value in first_weights.items():
        if not torch.equal(value, second_weights[name]):
            return False
    return True


@pytest.mark.parametrize(
    ("baseline", "settings"),
    [
        ("drift", []),
        pytest.param(
            "neuralmpm",
            [
                "model.noise_std=1e-4",
                "ema=0.9",
                "model.strain=true",
                "model.pushforward=2",
                "model.recovery=4",
            ],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_resumed_training_equals_an_uninterrupted_one(
    run: Run,
    baseline: str,
    settings: list[str],
    tmp_path: Path,
) -> None:
    """Interrupted twice and resumed, it ends with the same bits."""
    all_settings = ["steps=7", "validate_every=3", "schedule=cosine", *settings]
    whole = run(baseline, *all_settings, to="whole")
    for step in (2, 5):
        with pytest.raises(KeyboardInterrupt):
            run(baseline, *all_settings, to="parts", progress=interrupt_at(step))
        log = read_training_log(tmp_path / "parts")
        assert log["state"] == "interrupted"
        assert log["step"] == step

    parts = run(baseline, *all_settings, to="parts")
    assert parts.state == "finished"
    assert parts.first_step == 5
    assert parts.step == 7
    assert have_same_weights(whole.checkpoint, parts.checkpoint)
    assert have_same_weights(whole.weights, parts.weights)
    assert parts.best_value == whole.best_value
    assert parts.best_step == whole.best_step


@pytest.mark.parametrize(
    ("baseline", "settings", "steps"),
    [
        ("drift", ["steps=3"], 3),
        ("fitted", [], 1),  # a fit counts as one step
    ],
)
def test_a_finished_training_is_not_repeated(
    run: Run,
    baseline: str,
    settings: list[str],
    steps: int,
) -> None:
    """The same command again changes nothing."""
    first = run(baseline, *settings)
    assert first.state == "finished"
    assert first.step == steps
    assert first.steps == steps
    assert first.weights.exists()
    content = first.checkpoint.read_bytes()
    modified = first.checkpoint.stat().st_mtime_ns

    second = run(baseline, *settings)
    assert second.state == "finished"
    assert second.first_step == steps
    assert second.step == steps
    assert first.checkpoint.read_bytes() == content
    assert first.checkpoint.stat().st_mtime_ns == modified


def test_the_seed_decides_the_weights(run: Run) -> None:
    """The same seed gives the same weights, another seed others."""
    settings = ("steps=2", "validate_every=0")
    first = run("gns", *settings, to="first", seed=3)
    same_seed = run("gns", *settings, to="same", seed=3)
    another_seed = run("gns", *settings, to="another", seed=4)
    assert have_same_weights(first.checkpoint, same_seed.checkpoint)
    assert not have_same_weights(first.checkpoint, another_seed.checkpoint)


def test_training_draws_nothing_from_the_callers_generators(run: Run) -> None:
    def seed_and_draw(*, train_between: bool) -> tuple[float, float, float]:
        random.seed(5)
        np.random.seed(5)  # noqa: NPY002 (it must not change)
        torch.manual_seed(5)
        if train_between:
            run("drift", "steps=2")
        from_numpy = float(np.random.random())  # noqa: NPY002
        return random.random(), from_numpy, float(torch.rand(1))

    expected = seed_and_draw(train_between=False)
    assert seed_and_draw(train_between=True) == expected


@pytest.mark.parametrize(
    "command",
    [
        ("drift", "steps=2"),
        ("fitted",),
    ],
)
def test_a_changed_value_of_train_stops_the_training(
    run: Run,
    generated: GenerationResult,
    tmp_path: Path,
    command: tuple[str, ...],
) -> None:
    """It is noticed before the first step, although the file states its old hash."""
    shutil.copytree(generated.root, tmp_path / "data")
    path = next((tmp_path / "data").glob("curl-noise/tiny/*/train/*.nc"))
    with h5py.File(path, "r+") as file:
        file["position"][1, 0, 0] += np.float32(1e-3)
    with pytest.raises(DataError) as caught:
        run(*command, root=tmp_path / "data")
    assert str(path) in str(caught.value.where)
    assert not (tmp_path / "run").exists()


def test_a_loss_that_is_not_finite_stops_the_training(run: Run, tmp_path: Path) -> None:
    """The error names the step and the term; the checkpoint before it stays."""
    with pytest.raises(WorkFailedError) as caught:
        run("drift", "model.fail_at=6", "steps=9", "checkpoint_every=4")
    assert "swirl" in str(caught.value)
    checkpoint = load(tmp_path / "run/checkpoint.safetensors")
    assert checkpoint.training["step"] == 4
    assert torch.isfinite(checkpoint.weights["a"]).all()
    assert read_training_log(tmp_path / "run")["state"] == "failed"


def test_a_training_that_stopped_early_is_over(run: Run) -> None:
    """Validations without a new best end it; the same command again changes no byte."""
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
    paths = (first.checkpoint, first.weights, first.folder / "training.json")
    before = [path.read_bytes() for path in paths]
    validations = read_training_log(first.folder)["validation"]
    values = [validation["vorticity_nrmse"] for validation in validations]
    best_step = int(np.argmin(values)) + 1
    assert first.state == "stopped early"
    assert first.step == best_step + 3
    assert first.step < 50
    assert load(first.weights).training["step"] == first.best_step

    second = run("drift", *settings)
    assert second.state == first.state
    assert second.step == first.step
    assert second.best_step == first.best_step
    assert [path.read_bytes() for path in paths] == before


def test_another_recipe_in_a_folder_is_refused(run: Run) -> None:
    """Another recipe in a folder is refused unless the user wants to train anew."""
    run("drift", "steps=2")
    with pytest.raises(UsageError) as caught:
        run("drift", "steps=3")
    assert str(caught.value.where).endswith("/run")
    assert run("drift", "steps=3", fresh=True).step == 3


def test_gradients_are_clipped(run: Run, steps_taken: list[Step]) -> None:
    """A gradient longer than `clip` is scaled to it before the optimiser sees it."""
    run("drift", "steps=2", "validate_every=0")
    run("drift", "steps=2", "validate_every=0", "clip=0.001", to="clipped")
    lengths = [step.gradient_length for step in steps_taken]
    assert min(lengths[:2]) > 0.001
    assert lengths[2:] == pytest.approx([0.001, 0.001], rel=1e-3)


def exponential_means(weights: list[float]) -> list[float]:
    """Return means that keep a tenth of themselves in each step."""
    means = pd.Series(weights).ewm(alpha=0.9, adjust=False).mean()
    return [float(mean) for mean in means]


def rising_means(weights: list[float]) -> list[float]:
    """Return means that keep n / (n + 9) of themselves in step n.

    The weights of the mean are C(k + 8, 8), of sum C(n + 9, 9).
    """
    total = weights[0]
    means = []
    for step, weight in enumerate(weights, start=1):
        total += comb(step + 8, 8) * weight
        means.append(float(total / comb(step + 9, 9)))
    return means


@pytest.mark.parametrize(
    ("ema", "mean_weights"),
    [
        (0.1, exponential_means),
        (0.9, rising_means),
    ],
)
def test_the_mean_of_the_weights_is_published(
    run: Run,
    steps_taken: list[Step],
    ema: float,
    mean_weights: Callable[[list[float]], list[float]],
) -> None:
    """Training goes on from the last weights."""
    result = run(
        "drift", "steps=6", "learning_rate=0.1", "validate_every=2", f"ema={ema}"
    )
    weights = [step.weight for step in steps_taken]
    means = mean_weights(weights)
    checkpoint = load(result.checkpoint)
    assert float(checkpoint.weights["a"]) == pytest.approx(weights[-1], rel=1e-6)
    assert checkpoint.optimizer is not None
    stored_mean = float(checkpoint.optimizer["a/mean"])
    assert stored_mean == pytest.approx(means[-1], rel=1e-6)

    assert result.best_step is not None
    best = torch.tensor(means[result.best_step - 1]).bfloat16()
    published = load(result.weights).weights["a"]
    assert float(published) == float(best)


STEPS = 23
BATCH = 5


def draw_batches(
    data: WindowDataset,
    *,
    first: int = 0,
    share: float = 0.0,
    **ranks: int,
) -> list[list[int]]:
    """Return the windows of all steps from the first on."""
    sampler = WindowSampler(data, seed=1, **ranks)
    options = TrainingOptions(batch=BATCH, opening_share=share, opening_frames=3)
    return list(StepBatches(sampler, options, first=first, last=STEPS))


@pytest.fixture
def data(generated: GenerationResult, unmeasured: Registry) -> WindowDataset:
    """The windows of tiny curl-noise."""
    return WindowDataset(
        "curl-noise",
        size="tiny",
        root=generated.root,
        history=2,
        registry=unmeasured,
    )


@pytest.mark.parametrize("share", [0.0, 0.6])
@pytest.mark.parametrize(
    "ranks",
    [
        {"rank": 0, "ranks": 1},
        {"rank": 0, "ranks": 3},
        {"rank": 1, "ranks": 3},
        {"rank": 2, "ranks": 3},
    ],
)
def test_batches_are_the_same_from_any_step(
    data: WindowDataset,
    ranks: dict[str, int],
    share: float,
) -> None:
    batches = draw_batches(data, share=share, **ranks)
    assert {len(batch) for batch in batches} == {BATCH}
    for first in range(STEPS):
        resumed = draw_batches(data, first=first, share=share, **ranks)
        assert resumed == batches[first:]


def draw_openings(data: WindowDataset, **ranks: int) -> list[int]:
    """Return the windows of all steps that an opening share has exchanged."""
    plain = chain.from_iterable(draw_batches(data, **ranks))
    with_openings = chain.from_iterable(draw_batches(data, share=0.6, **ranks))
    openings = []
    for window, other in zip(plain, with_openings, strict=True):
        if other != window:
            openings.append(other)
    return openings


@pytest.mark.parametrize("ranks", [1, 3])
def test_a_share_of_the_windows_are_openings(data: WindowDataset, ranks: int) -> None:
    """They start at the first frames of all scenarios; no two processes draw alike."""
    draws = set()
    for rank in range(ranks):
        openings = draw_openings(data, rank=rank, ranks=ranks)
        window_count = STEPS * BATCH
        assert 0.4 * window_count < len(openings) < 0.75 * window_count
        assert {data[window].frame for window in openings} == {0, 1, 2}
        scenarios = {data[window].scenario for window in openings}
        assert scenarios == set(data.scenarios)
        draws.add(tuple(openings))
    assert len(draws) == ranks


class FittedDrift(Drift):
    """The Drift that docs/baselines.md fits as a whole; it keeps what it has seen."""

    closed_form = True
    seen: ClassVar[list[Batch]] = []

    def fit(self, scenarios: Iterable[Batch]) -> dict[str, float]:
        """Set a to a quotient of sums over all particles and frames."""
        products = 0.0
        squares = 0.0
        for batch in scenarios:
            self.seen.append(batch)
            step = batch.position.double().diff(dim=1)
            products += float((step[:, 1:] * step[:, :-1]).sum())
            squares += float(step[:, :-1].square().sum())
        self.a.data.fill_(products / squares)
        return {"best": products / squares}


def test_a_users_fit_gets_whole_scenarios_as_batches(
    run: Run, generated: GenerationResult
) -> None:
    """Each has all frames and what its file states; the numbers are logged."""
    FittedDrift.seen.clear()
    result = run("fitted")
    products = 0.0
    squares = 0.0
    paths = sorted(generated.folder.glob("train/*.nc"))
    for path, batch in zip(paths, FittedDrift.seen, strict=True):
        with netCDF4.Dataset(path) as data:
            position = np.asarray(data["position"][:], np.float64)
        assert batch.windows == 1
        assert batch.position.shape[:2] == (position.shape[1], position.shape[0])
        assert batch.particle_mass is not None
        step = np.diff(position, axis=0)
        products += float((step[1:] * step[:-1]).sum())
        squares += float((step[:-1] ** 2).sum())
    best = products / squares
    assert read_training_log(result.folder)["loss"]["best"] == pytest.approx(best)
    exact = load(result.folder / "checkpoint.safetensors").weights["a"]
    assert float(exact) == pytest.approx(best)
