"""Rollouts: a model fed with its own predictions, frozen where it ceases to be finite
or leaves for far.

One function serves the predictions that are scored and validation while a model is
trained: rollouts of every scenario of ``valid`` by the metric that ranks. Files, metric
and its rounding are the scorer's: were ``valid`` the test subset, the score card would
have the same digits. ``test`` is never read. Scenarios come whole, as batches; training
windows are `lagbench.torch`'s.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from lagbench.data.local import locate
from lagbench.data.registry import Registry
from lagbench.data.scenario import read_scenario
from lagbench.errors import UsageError
from lagbench.metrics.aggregate import Tally, round_statistics, score, tally
from lagbench.metrics.frame import FramePair, snapshots
from lagbench.metrics.table import METRICS, ranking_metric, select
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.store.copy import scenario_files
from lagbench.store.windows import copy_window
from lagbench.submission.checks import MAX_DISTANCE
from lagbench.tensors import TensorWindow, collate
from lagbench.torch import tensors

from .baseline import Baseline, Batch, Facts
from .recipe import TrainingOptions


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """Predicted positions of one window."""

    scenario: int  # scenario id
    # positions [length], float32, on the CPU, shape [frame, particle, 2]
    position: Tensor
    # absolute frame from which the positions are frozen; None where none is
    diverged_at: int | None


@torch.no_grad()
def roll_out(model: Baseline, given: Batch, frames: int) -> list[Rollout]:
    """Predict frames after the given ones, for every window.

    A window that ceases to be finite is frozen at its last finite frame (the last given
    one if need be). Where that happens beside other windows, all are predicted again
    one by one, so that no window can disturb another.
    """
    was_training = model.training
    model.eval()
    try:
        predicted, finite = _advance(model, given, frames)
        if finite < frames and given.windows > 1:
            alone = (single(given, window) for window in range(given.windows))
            return [
                rollout
                for window in alone
                for rollout in roll_out(model, window, frames)
            ]
    finally:
        model.train(was_training)
    mark = None
    if finite < frames:
        if finite:
            predicted[finite:] = predicted[finite - 1]
        else:
            predicted[finite:] = given.position[:, -1].cpu().float()
        mark = int(given.frame[0]) + given.frames + finite
    sample = given.sample.cpu()
    return [
        Rollout(
            scenario=int(scenario),
            position=predicted[:, sample == window],
            diverged_at=mark,
        )
        for window, scenario in enumerate(given.scenario)
    ]


def single(batch: Batch, window: int) -> Batch:
    """Return one window of a batch as a batch of its own."""
    mine = batch.sample == window
    walls = batch.wall_velocity
    return Batch(
        position=batch.position[mine],
        sample=torch.zeros_like(batch.sample[mine]),
        material=batch.material[mine],
        wall_velocity=None if walls is None else walls[window : window + 1],
        scenario=batch.scenario[window : window + 1],
        frame=batch.frame[window : window + 1],
        origin=None if batch.origin is None else batch.origin[mine],
    )


def _advance(model: Baseline, given: Batch, frames: int) -> tuple[Tensor, int]:
    """Return positions, shape [frame, particle, 2], and how many frames are finite and
    near the box.
    """
    predicted = torch.empty((frames, len(given.position), 2), dtype=torch.float32)
    state = model.start(given)
    for frame in range(frames):
        found: object = model.advance(state)
        if isinstance(found, tuple | list):
            parts = found
        else:
            parts = (found,)
        # What has another shape a frame could be broadcast from.
        shape = predicted[frame].shape
        if len(parts) == 2:
            position = parts[1]
        else:
            position = None
        if not isinstance(position, Tensor) or position.shape != shape:
            raise UsageError(
                "a model returned no positions of the next frame",
                where=f"{type(model).__qualname__}.advance",
                expected=f"the next state and a tensor of shape {list(shape)}: "
                f"[particle, 2]",
                got=", ".join(
                    str(getattr(part, "shape", type(part).__name__)) for part in parts
                ),
                fix="mend that class",
            )
        state = parts[0]
        predicted[frame] = position
        # The scorer refuses what lies farther out; of NaN nothing is true.
        if not ((predicted[frame] - 0.5).abs() <= MAX_DISTANCE).all():
            return predicted, frame
    return predicted, frames


@contextmanager
def replaced(values: Mapping[Tensor, Tensor]) -> Iterator[None]:
    """Give parameters other values for a while."""
    kept = {parameter: parameter.detach().clone() for parameter in values}
    with torch.no_grad():
        for parameter, value in values.items():
            parameter.copy_(value)
    try:
        yield
    finally:
        with torch.no_grad():
            for parameter, value in kept.items():
                parameter.copy_(value)


def as_published(model: nn.Module) -> AbstractContextManager[None]:
    """Round the parameters to bfloat16 for a while."""
    return replaced(
        {
            parameter: parameter.detach().to(torch.bfloat16)
            for parameter in model.parameters()
        }
    )


def scenario_batch(paths: Path | Sequence[Path], frames: slice = slice(None)) -> Batch:
    """Return the same frames of one or several whole scenarios, read without a
    cache.
    """
    windows: list[TensorWindow] = []
    for path in [paths] if isinstance(paths, Path) else paths:
        with read_scenario(path) as file:
            numbers = range(file.header.frames)[frames]
            if not numbers or numbers.step != 1:
                raise UsageError(
                    "no consecutive frames",
                    where=str(path),
                    expected=f"frames of 0:{file.header.frames}",
                    got=frames,
                )
            run = slice(numbers.start, numbers.stop)
            held = file.variables
            position = file.read("position", run)
            if "material" in held:
                material = file.read("material")
            else:
                material = np.zeros(position.shape[1], np.int8)
            # The forcing is given for all frames, so that a rollout from these knows
            # what comes.
            if "wall_velocity" in held:
                walls = file.read("wall_velocity", slice(run.start, None))
            else:
                walls = None
            scenario = file.header.key.scenario
            windows.append(
                tensors(
                    copy_window(
                        list(position), material, walls, scenario, numbers.start
                    )
                )
            )
    return collate(windows)


def scenario_paths(
    split: str,
    *,
    subset: str = "test",
    size: str | None = None,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> dict[int, Path]:
    """Return the files of a subset by scenario id; all of them exist."""
    entry, folder, _ = locate(split, size, root=root, registry=registry)
    return scenario_files(entry, folder, (subset,))


@dataclass(frozen=True, kw_only=True)
class Validation:
    """The scenarios that a training is validated on; calling it validates."""

    task: ScoredTask  # the valid subset
    # frames to predict, by scenario id: later ones do not count
    frames: Mapping[int, int]
    compiled: bool = False  # whether the training compiles layers

    @property
    def metric(self) -> str:
        """Name of the metric that ranks; lower is better."""
        return ranking_metric(self.task.size)

    def __call__(self, model: Baseline) -> float:
        """Return the metric, the mean over scenarios; NaN where it is undefined.

        The model is rolled out with its weights rounded to bfloat16, as predictions use
        them, on a CPU one scenario after the other, as predictions are. A rollout that
        diverges counts with its frozen frames.
        """
        device = next((p.device for p in model.parameters()), torch.device("cpu"))
        ids = list(self.frames)
        if device.type == "cpu":
            groups = [[i] for i in ids]
        else:
            groups = [ids]
        tallies: dict[int, Tally] = {}
        # A rollout needs no gradients: its layers would be compiled anew.
        if self.compiled:
            stance = torch.compiler.set_stance("force_eager")
        else:
            stance = nullcontext()
        with as_published(model), stance:
            for group in groups:
                paths = [self.task.truth.path(i) for i in group]
                given = scenario_batch(
                    paths, slice(0, self.task.config.input_frames)
                ).to(device)
                for rollout in roll_out(
                    model, given, max(self.frames[i] for i in group)
                ):
                    with self.task.opened(rollout.scenario) as truth:
                        scenario = truth.scenario
                        frames = self.task.config.predicted_frames
                        predicted = snapshots(scenario, rollout.position.numpy())
                        states = zip(frames, predicted, truth.snapshots(), strict=False)
                        pairs = (
                            FramePair(scenario, frame, true, guess)
                            for frame, guess, true in states
                        )
                        measured = tally(pairs, select([self.metric]), frames)
                        # rounded as score files hold them
                        tallies[rollout.scenario] = round_statistics(measured)
        found = score(METRICS[self.metric], tallies)
        if found is None:
            return math.nan
        return found.mean


def validation_of(
    options: TrainingOptions, facts: Facts, *, root: Path, registry: Registry
) -> Validation | None:
    """Return the validation of a training; None where the recipe wants none."""
    if options.validate_every == 0:
        return None
    task = load_scored_task(
        registry.size(facts.split, facts.size), root, subset="valid"
    )
    horizon = min(options.validation_frames or facts.horizon, facts.horizon)
    task = replace(task, config=replace(task.config, horizon=horizon))
    frames = {}
    for i in task.scenarios[: options.validation_scenarios]:
        with task.opened(i) as truth:
            frames[i] = len(truth.scenario.moving_frames)
    return Validation(task=task, frames=frames, compiled=options.compile)
