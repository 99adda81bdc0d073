"""Readers of the two exchange formats that know only their description; test runs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

Trajectory = tuple[NDArray[Any], NDArray[Any]]


def read_gns(path: Path) -> list[Trajectory]:
    """Read an npz file as the GNS programs do: every key in zip order, unpickled."""
    with np.load(path, allow_pickle=True) as file:
        if "gns_data" in file:
            items = list(file["gns_data"])
        else:
            items = [file[key] for key in file.files]
    trajectories = []
    for item in items:
        position = item[0]
        kinds = np.full(position.shape[1], item[1], dtype=int)
        trajectories.append((position, kinds))
    return trajectories


def read_h5(path: Path) -> list[Trajectory]:
    """Read an HDF5 file as LagrangeBench does: the length of 00000 holds for all."""
    trajectories = []
    with h5py.File(path) as file:
        length = file["00000/position"].shape[0]
        for key in file:
            group = file[key]
            position = group["position"][:length]
            kinds = group["particle_type"][:]
            trajectories.append((position, kinds))
    return trajectories


def read_metadata(folder: Path) -> dict[str, Any]:
    """Read metadata.json."""
    return dict(json.loads((folder / "metadata.json").read_text()))


def frame_statistics(
    trajectories: Sequence[Trajectory],
) -> dict[str, NDArray[np.float64]]:
    """Compute mean and deviation of velocity and acceleration, per frame.

    They are taken over all particles at once.
    """
    velocities = []
    accelerations = []
    for position, _ in trajectories:
        velocity = np.diff(position.astype(np.float64), axis=0)
        acceleration = np.diff(velocity, axis=0)
        velocities.append(velocity.reshape(-1, 2))
        accelerations.append(acceleration.reshape(-1, 2))
    velocity = np.concatenate(velocities)
    acceleration = np.concatenate(accelerations)
    return {
        "vel_mean": velocity.mean(axis=0),
        "vel_std": velocity.std(axis=0),
        "acc_mean": acceleration.mean(axis=0),
        "acc_std": acceleration.std(axis=0),
    }


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
