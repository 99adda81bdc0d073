"""Trajectories of particles for tests of data that are not ours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def vortex(
    seed: int, frames: int = 16, side: int = 12, speed: float = 0.06
) -> NDArray[np.float32]:
    """Return a square of particles [frame, particle, 2] that turns around its middle.

    A particle moves 0.01 or less in a frame, a fifth of the spacing 0.05.
    """
    line = 0.2 + 0.6 * (np.arange(side) + 0.5) / side
    start = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    start += np.random.default_rng(seed).uniform(-0.01, 0.01, start.shape)
    offset = start @ [1, 1j] - (0.5 + 0.5j)
    angle = np.arange(frames)[:, None] * speed * np.exp(-(abs(offset) ** 2) / 0.05)
    path = offset * np.exp(1j * angle)
    return np.stack([path.real, path.imag], -1).astype(np.float32) + np.float32(0.5)


def straight_runs(
    count: int,
    *,
    frames: int = 12,
    particles: int = 40,
    seed: int = 0,
    box: float = 1.0,
) -> list[NDArray[np.float32]]:
    """Return trajectories of particles that fly straight inside a box.

    Each has shape [frame, particle, 2].
    """
    rng = np.random.default_rng(seed)
    shape = (count, 1, particles, 2)
    start = 0.3 + 0.4 * rng.random(shape)
    largest_step = min(0.02, 0.5 / frames)
    step = largest_step * (rng.random(shape) - 0.5)
    time = np.arange(frames)[None, :, None, None]
    position = box * (start + step * time)
    return list(position.astype(np.float32))
