"""Rollouts: a model fed with its own predictions, frozen where it ceases to be finite or leaves for far.

One function serves validation during training and the predictions that are scored.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from lagbench.submission.checks import MAX_DISTANCE

from .baseline import Baseline, Batch

__all__ = [
    "Rollout",
    "roll_out",
    "single",
    "as_published",
]


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """Predicted positions of one window."""

    scenario: int  # scenario id
    position: Tensor  # positions [length], float32, on the CPU, shape [frame, particle, 2]
    diverged_at: int | None  # absolute frame from which the positions are frozen; None where none is


@torch.no_grad()
def roll_out(model: Baseline, given: Batch, frames: int) -> list[Rollout]:
    """Predict frames after the given ones, for every window.

    A window that ceases to be finite is frozen at its last finite frame (the last given one if
    need be). Where that happens beside other windows, all are predicted again one by one, so
    that no window can disturb another.
    """
    was_training = model.training
    model.eval()
    try:
        found = _together(model, given, frames)
        if found is None:
            parts = [single(given, window) for window in range(given.windows)]
            return [_alone(model, part, frames) for part in parts]
        return found
    finally:
        model.train(was_training)


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
    )


def _together(model: Baseline, given: Batch, frames: int) -> list[Rollout] | None:
    """Return the rollouts of all windows; None where one of several diverges."""
    if given.windows == 1:
        return [_alone(model, given, frames)]
    predicted, finite = _advance(model, given, frames)
    if finite < frames:
        return None
    sample = given.sample.cpu()
    return [
        Rollout(scenario=int(scenario), position=predicted[:, sample == window], diverged_at=None)
        for window, scenario in enumerate(given.scenario)
    ]


def _alone(model: Baseline, given: Batch, frames: int) -> Rollout:
    """Return the rollout of the only window, frozen where it diverges."""
    predicted, finite = _advance(model, given, frames)
    scenario = int(given.scenario[0])
    if finite == frames:
        return Rollout(scenario=scenario, position=predicted, diverged_at=None)
    last = predicted[finite - 1] if finite else given.position[:, -1].cpu().float()
    predicted[finite:] = last
    mark = int(given.frame[0]) + given.frames + finite
    return Rollout(scenario=scenario, position=predicted, diverged_at=mark)


def _advance(model: Baseline, given: Batch, frames: int) -> tuple[Tensor, int]:
    """Return positions, shape [frame, particle, 2], and how many frames are finite and near the box."""
    predicted = torch.empty((frames, len(given.position), 2), dtype=torch.float32)
    state = model.start(given)
    for frame in range(frames):
        state, position = model.advance(state)
        predicted[frame] = position
        # The scorer refuses what lies farther out; of NaN nothing is true.
        if not ((predicted[frame] - 0.5).abs() <= MAX_DISTANCE).all():
            return predicted, frame
    return predicted, frames


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
