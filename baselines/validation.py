"""Validation: rollouts of every scenario of ``valid`` while a model is trained, by the metric that ranks.

The files, the metric and its rounding are the scorer's: were ``valid`` the test subset, the score card
would have the same digits. ``test`` is never read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace

import torch

from lagbench.metrics.aggregate import Tally, score, tally
from lagbench.metrics.frame import FramePair, snapshots
from lagbench.metrics.table import METRICS, select
from lagbench.scoring.scenario import as_stored
from lagbench.scoring.task import ScoredTask, load_scored_task, ranking_metric

from .baseline import Baseline
from .job import TrainingJob
from .rollout import Rollout, as_published, roll_out
from .windows import scenario_batch

__all__ = ["Validation", "validation_of"]


@dataclass(frozen=True, kw_only=True)
class Validation:
    """The scenarios that a training is validated on; calling it validates."""

    task: ScoredTask  # the valid subset
    frames: Mapping[int, int]  # frames to predict, by scenario id: later ones do not count
    compiled: bool = False  # whether the training compiles layers

    @property
    def metric(self) -> str:
        """Name of the metric that ranks; lower is better."""
        return ranking_metric(self.task.size)

    def __call__(self, model: Baseline) -> float:
        """Return the metric, the mean over scenarios; NaN where it is undefined.

        The model is rolled out with its weights rounded to bfloat16, as predictions use them, on a CPU
        one scenario after the other, as predictions are. A rollout that diverges counts with its frozen
        frames.
        """
        device = next((p.device for p in model.parameters()), torch.device("cpu"))
        ids = list(self.frames)
        groups = [[i] for i in ids] if device.type == "cpu" else [ids]
        tallies: dict[int, Tally] = {}
        # A rollout needs no gradients: its layers would be compiled anew.
        stance = torch.compiler.set_stance("force_eager") if self.compiled else nullcontext()
        with as_published(model), stance:
            for group in groups:
                paths = [self.task.truth.path(i) for i in group]
                given = scenario_batch(paths, slice(0, self.task.setting.input_frames)).to(device)
                for rollout in roll_out(model, given, max(self.frames[i] for i in group)):
                    tallies[rollout.scenario] = self._measured(rollout)
        found = score(METRICS[self.metric], tallies)
        return math.nan if found is None else found.mean

    def _measured(self, rollout: Rollout) -> Tally:
        """Return the statistics of a rollout, rounded as score files hold them."""
        metrics = select([self.metric])
        with self.task.opened(rollout.scenario) as truth:
            scenario, frames = truth.scenario, self.task.setting.predicted_frames
            predicted = snapshots(scenario, rollout.position.numpy())
            states = zip(frames, predicted, truth.snapshots(), strict=False)
            pairs = (FramePair(scenario, frame, true, guess) for frame, guess, true in states)
            return as_stored(tally(pairs, metrics, frames))


def validation_of(job: TrainingJob) -> Validation | None:
    """Return the validation of a training; None where the recipe wants none."""
    options, facts = job.recipe.training, job.facts
    if options.validate_every == 0:
        return None
    task = load_scored_task(job.registry.size(facts.split, facts.size), job.root, subset="valid")
    horizon = min(options.validation_frames or facts.horizon, facts.horizon)
    task = replace(task, setting=replace(task.setting, horizon=horizon))
    frames = {}
    for i in task.scenarios[: options.validation_scenarios]:
        with task.opened(i) as opened:
            frames[i] = len(opened.scenario.active)
    return Validation(task=task, frames=frames, compiled=options.compile)
