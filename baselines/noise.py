"""Random-walk noise on training windows: a model learns to undo its own rollout errors.

Sanchez-Gonzalez et al. (2020): the velocities of the given frames are moved by a random walk,
the positions by its sum. The frames to predict move with the last given position, so that the
target is the true next velocity, and the acceleration that leads to it undoes the noise.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["noisy", "random_walk"]


def random_walk(particles: int, frames: int, std: float, generator: torch.Generator) -> Tensor:
    """Return position noise whose last velocity has the given deviation.

    The velocity noise is a walk of ``frames - 1`` steps of ``std / sqrt(frames - 1)`` each; the
    position noise is its sum, 0 in the first frame.

    Args:
        particles: particles P.
        frames: frames F of the history, at least 2.
        std: standard deviation of the last velocity, per component [length/frame].
        generator: source of randomness; the noise is drawn on its device.

    Returns:
        Position noise [length], shape [P, F, 2].
    """
    steps = frames - 1
    shape = (particles, steps, 2)
    step = torch.randn(shape, generator=generator, device=generator.device) * (std / math.sqrt(steps))
    position = step.cumsum(dim=1).cumsum(dim=1)
    return torch.cat([torch.zeros_like(position[:, :1]), position], dim=1)


def noisy(position: Tensor, history: int, std: float, generator: torch.Generator) -> Tensor:
    """Return windows with noise on their history; the frames after it move along.

    Args:
        position: positions of the window [length], shape [particle, frame, 2]; left unchanged.
        history: frames given to the model, the first ones of the window.
        std: standard deviation of the last given velocity, per component [length/frame].
        generator: source of randomness; equal seeds give equal noise on every device.
    """
    walk = random_walk(len(position), history, std, generator).to(position)
    after = walk[:, -1:].expand(-1, position.shape[1] - history, -1)
    return position + torch.cat([walk, after], dim=1)
