"""Rollouts of a few scenarios of ``valid`` while a model is trained; ``test`` is never read."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from .baseline import Baseline
from .batch import Batch
from .job import Job
from .rollout import roll_out, single
from .windows import scenario_batch

__all__ = ["as_published", "validate", "validation_windows"]


def validation_windows(job: Job) -> Batch | None:
    """Return the windows of ``valid`` that are rolled out; None where the recipe wants none."""
    options, facts = job.recipe.training, job.facts
    if options.validate_every == 0:
        return None
    paths = job.files("valid")
    chosen = [paths[scenario] for scenario in sorted(paths)[: options.validation_scenarios]]
    frames = facts.input_frames + min(options.validation_frames, facts.horizon)
    return scenario_batch(chosen, slice(0, frames))


def validate(model: Baseline, truth: Batch) -> float:
    """Return the position RMSE of rollouts, the mean over windows [length].

    The model is rolled out with its weights rounded to bfloat16, as predictions use them. A
    rollout that diverges counts with its frozen frames.

    Args:
        model: the model.
        truth: windows of ``input_frames`` given frames and those to predict.
    """
    given = model.facts.input_frames
    rmse = []
    with as_published(model):
        device = next((p.device for p in model.parameters()), torch.device("cpu"))
        for window in range(truth.windows):
            part = single(truth, window)
            found = roll_out(model, part.part(slice(0, given)).to(device), part.frames - given)[0]
            error = found.position - part.position[:, given:].transpose(0, 1)
            rmse.append(float(error.double().square().mean().sqrt()))
    return sum(rmse) / len(rmse)


@contextmanager
def as_published(model: nn.Module) -> Iterator[None]:
    """Round the parameters to bfloat16 for a while."""
    kept: list[tuple[Tensor, Tensor]] = []
    with torch.no_grad():
        for parameter in model.parameters():
            kept.append((parameter, parameter.detach().clone()))
            parameter.copy_(parameter.to(torch.bfloat16))
    try:
        yield
    finally:
        with torch.no_grad():
            for tensor, value in kept:
                tensor.copy_(value)
