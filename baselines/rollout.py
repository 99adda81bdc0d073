"""Rollouts: a model fed with its own predictions, and their validation.

A rollout is frozen where it ceases to be finite or goes far outside the box. One
function serves predictions and validations. A validation rolls out every scenario of
``valid`` and takes the metric that ranks. Files, metric and rounding are the scorer's:
were ``valid`` the test subset, the scores would have the same digits. A validation
never reads ``test``. Scenarios are batches of whole scenarios; training windows are
those of `lagbench.torch`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lagbench.data.box import parse_obstacle
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
from lagbench.submission.validation import MAX_DISTANCE
from lagbench.tensors import collate
from lagbench.torch import tensors

from .baseline import Baseline, Batch, DatasetInfo
from .recipe import TrainingOptions


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """Predicted positions of one window."""

    scenario: int  # scenario id
    # positions [length], float32, on the CPU, shape [frame, particle, axis]
    position: Tensor
    # absolute frame from which the positions are frozen; None where none is
    diverged_at: int | None


def count_predicted(rollout: Rollout, frames: int, *, input_frames: int) -> int:
    """Return how many frames of a rollout the model computed, before it was frozen.

    Args:
        rollout: a rollout from the first frames of its scenario.
        frames: frames of the rollout, without the given ones.
        input_frames: given frames.
    """
    if rollout.diverged_at is None:
        return frames
    # The model computed the first frozen frame too: it was not finite, or far outside.
    return rollout.diverged_at - input_frames + 1


@torch.no_grad()
def roll_out(model: Baseline, given: Batch, frames: int) -> list[Rollout]:
    """Predict frames after the given ones, for every window.

    A window that ceases to be finite or goes far outside the box is frozen at its last
    frame before (the last given one if need be). Where that happens beside other
    windows, all are predicted again one by one, so that no window can disturb another.
    """
    was_training = model.training
    model.eval()
    try:
        particles, _, dimension = given.position.shape
        predicted = torch.empty(frames, particles, dimension)
        finite_frames = frames
        state = model.start(given)
        for frame, row in enumerate(predicted):
            state, position = model.advance(state)
            row.copy_(position)
            # The scorer refuses positions farther out. Comparisons with NaN are false.
            is_near = (row - 0.5).abs() <= MAX_DISTANCE
            if not is_near.all():
                finite_frames = frame
                break
        is_diverged = finite_frames < frames
        if is_diverged and given.windows > 1:
            rollouts = []
            for window in range(given.windows):
                rollouts += roll_out(model, select_window(given, window), frames)
            return rollouts
    finally:
        model.train(was_training)

    diverged_at = None
    if is_diverged:
        if finite_frames:
            last_finite = predicted[finite_frames - 1]
        else:
            last_given = given.position[:, -1]
            last_finite = last_given.cpu().float()
        predicted[finite_frames:] = last_finite
        diverged_at = int(given.frame[0]) + given.frames + finite_frames

    sample = given.sample.cpu()
    rollouts = []
    for window, scenario in enumerate(given.scenario):
        is_inside = sample == window
        rollout = Rollout(
            scenario=int(scenario),
            position=predicted[:, is_inside],
            diverged_at=diverged_at,
        )
        rollouts.append(rollout)
    return rollouts


def select_window(batch: Batch, window: int) -> Batch:
    """Return one window of a batch as a batch of its own."""
    is_inside = batch.sample == window
    values = {}
    for name, value in vars(batch).items():
        if value is None:
            continue
        if name in ("position", "material", "origin"):
            values[name] = value[is_inside]
        else:
            values[name] = value[window : window + 1]
    values["sample"] = torch.zeros_like(batch.sample[is_inside])
    return replace(batch, **values)


@contextmanager
def replace_parameters(values: Mapping[Tensor, Tensor]) -> Iterator[None]:
    """Give parameters other values for a while."""
    originals = {parameter: parameter.detach().clone() for parameter in values}
    for parameter, value in values.items():
        parameter.data.copy_(value)
    try:
        yield
    finally:
        for parameter, value in originals.items():
            parameter.data.copy_(value)


def round_parameters(model: nn.Module) -> AbstractContextManager[None]:
    """Round the parameters to bfloat16 for a while."""
    rounded: dict[Tensor, Tensor] = {}
    for parameter in model.parameters():
        value = parameter.detach()
        rounded[parameter] = value.to(torch.bfloat16)
    return replace_parameters(rounded)


def scenario_batch(
    paths: Path | Sequence[Path],
    frames: slice = slice(None),
    *,
    viscosity: float | None = None,
) -> Batch:
    """Return the same frames of whole scenarios, read without a cache.

    Args:
        paths: files of the scenarios.
        frames: the frames to read.
        viscosity: that of scenarios whose files state none [length^2/s]; None where it
            is not known.

    Raises:
        UsageError: the frames are not consecutive ones of a scenario.
    """
    if isinstance(paths, Path):
        paths = [paths]
    windows = []
    for path in paths:
        with read_scenario(path) as file:
            header = file.header
            numbers = range(header.frames)[frames]
            if not numbers or numbers.step != 1:
                raise UsageError(
                    f"no consecutive frames: got {frames}, expected frames of "
                    f"0:{header.frames}",
                    where=str(path),
                )
            first = numbers.start
            # The forcing of all later frames too: a rollout from these knows it.
            later_frames = slice(first, None)
            position = file.read("position", slice(first, numbers.stop))
            material = np.zeros(position.shape[1], np.int8)
            if "material" in file.variables:
                material = file.read("material")
            walls = None
            if "wall_velocity" in file.variables:
                walls = file.read("wall_velocity", later_frames)
            force = None
            if "body_force" in file.variables:
                force = file.read("body_force", later_frames)
            particle_mass = None
            if "particle_mass" in file.variables:
                particle_mass = file.read_particle_mass()
            obstacle = parse_obstacle(
                header.parameters, position.shape[2], where=f"{header.key}"
            )
        window = copy_window(
            list(position), material, walls, header.key.scenario, first
        )
        stated = header.viscosity
        window = window._replace(
            viscosity=viscosity if stated is None else stated,
            body_force=force,
            obstacle=obstacle,
        )
        windows.append(
            tensors(window)._replace(
                particle_mass=particle_mass, friction=header.friction
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
    tier, root_folder, _ = locate(split, size, root=root, registry=registry)
    return scenario_files(tier, root_folder, (subset,))


@dataclass(frozen=True, kw_only=True)
class Validation:
    """The scenarios that a training is validated on."""

    task: ScoredTask  # the valid subset
    # frames to predict, by scenario id: later ones do not count
    frames: Mapping[int, int]
    is_compiled: bool = False  # whether the training compiles layers

    @property
    def metric(self) -> str:
        """Name of the metric that ranks; lower is better."""
        return ranking_metric(self.task.size)

    def measure(self, model: Baseline) -> float:
        """Return the metric, the mean over scenarios; NaN where it is undefined.

        The model is rolled out with its weights rounded to bfloat16, and on a CPU one
        scenario after the other, as predictions are. A rollout that diverges counts
        with its frozen frames.
        """
        device = torch.device("cpu")  # where a model has no parameters
        for parameter in model.parameters():
            device = parameter.device
            break
        ids = list(self.frames)
        groups = [ids]
        if device.type == "cpu":
            groups = [[scenario] for scenario in ids]
        # A rollout needs no gradients: its layers would be compiled anew.
        stance: AbstractContextManager[Any] = nullcontext()
        if self.is_compiled:
            stance = torch.compiler.set_stance("force_eager")

        tallies: dict[int, Tally] = {}
        viscosity = self.task.size.viscosity()
        input_frames = slice(0, self.task.config.input_frames)
        metrics = select([self.metric])
        with round_parameters(model), stance:
            for group in groups:
                paths = [self.task.truth.path(scenario) for scenario in group]
                given = scenario_batch(paths, input_frames, viscosity=viscosity)
                horizon = max(self.frames[scenario] for scenario in group)
                for rollout in roll_out(model, given.to(device), horizon):
                    frames = self.task.config.predicted_frames
                    with self.task.opened(rollout.scenario) as truth:
                        scenario = truth.scenario
                        predicted = snapshots(scenario, rollout.position.numpy())
                        # one pair in memory at a time
                        pairs = map(
                            partial(FramePair, scenario),
                            frames,
                            truth.snapshots(),
                            predicted,
                        )
                        statistics = tally(pairs, metrics, frames)
                    tallies[rollout.scenario] = round_statistics(statistics)
        result = score(METRICS[self.metric], tallies)
        if result is None:
            return math.nan
        return result.mean


def load_validation(
    options: TrainingOptions, info: DatasetInfo, *, root: Path, registry: Registry
) -> Validation | None:
    """Return the validation of a training; None where the recipe asks for none."""
    if options.validate_every == 0:
        return None
    size = registry.size(info.split, info.size)
    task = load_scored_task(size, root, subset="valid")
    horizon = info.horizon
    if options.validation_frames:
        horizon = min(options.validation_frames, horizon)
    config = replace(task.config, horizon=horizon)
    task = replace(task, config=config)
    scenarios = task.scenarios[: options.validation_scenarios]
    frames = {}
    for scenario in scenarios:
        with task.opened(scenario) as truth:
            moving_frames = truth.scenario.moving_frames
        frames[scenario] = len(moving_frames)
    return Validation(task=task, frames=frames, is_compiled=options.compile)
