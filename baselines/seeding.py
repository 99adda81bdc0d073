"""Random numbers of a training as a function of seed, step and process, and of nothing else.

No state of any generator has to be stored: a training that was interrupted draws, at every
step, what an uninterrupted one draws there, whatever happened in between.

Random-walk noise on training windows: a model learns to undo its own rollout errors.

Sanchez-Gonzalez et al. (2020): the velocities of the given frames are moved by a random walk,
the positions by its sum. The frames to predict move with the last given position, so that the
target is the true next velocity, and the acceleration that leads to it undoes the noise.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

__all__ = [
    "generators_kept",
    "reseed",
    "seed_of",
    "noisy",
    "random_walk",
]


def seed_of(seed: int, *place: int) -> int:
    """Return a seed of 63 bits for a place in a training, such as (step, process)."""
    return int(np.random.SeedSequence((seed, *place)).generate_state(1, np.uint64)[0] >> np.uint64(1))


def reseed(seed: int) -> None:
    """Set the global generators of Python, NumPy and torch, which layers of others draw from."""
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 (what PyTorch Geometric may draw from)
    torch.manual_seed(seed)


@contextmanager
def generators_kept() -> Iterator[None]:
    """Give the caller's global generators back as they were."""
    python, numpy = random.getstate(), np.random.get_state()  # noqa: NPY002 (the global one)
    with torch.random.fork_rng():
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy)  # noqa: NPY002


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
