"""Readers of the two exchange formats that know only their description, and data to
adopt.
"""

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
        items = (
            list(file["gns_data"])
            if "gns_data" in file
            else [file[key] for key in file.files]
        )
    return [(item[0], np.full(item[0].shape[1], item[1], dtype=int)) for item in items]


def read_h5(path: Path) -> list[Trajectory]:
    """Read an HDF5 file as LagrangeBench does: keys in order, the length of 00000 for
    all.
    """
    with h5py.File(path) as file:
        length = file["00000/position"].shape[0]
        return [
            (file[key]["position"][:length], file[key]["particle_type"][:])
            for key in file
        ]


def read_metadata(folder: Path) -> dict[str, Any]:
    """Read metadata.json."""
    return dict(json.loads((folder / "metadata.json").read_text()))


def frame_statistics(
    trajectories: Sequence[Trajectory],
) -> dict[str, NDArray[np.float64]]:
    """Compute vel_mean, vel_std, acc_mean, acc_std per frame over all particles, in one
    go.
    """
    velocity = [
        np.diff(position.astype(np.float64), axis=0) for position, _ in trajectories
    ]
    acceleration = [np.diff(v, axis=0) for v in velocity]
    joined = {
        "vel": np.concatenate([v.reshape(-1, 2) for v in velocity]),
        "acc": np.concatenate([a.reshape(-1, 2) for a in acceleration]),
    }
    return {
        f"{name}_{what}": getattr(values, what)(axis=0)
        for name, values in joined.items()
        for what in ("mean", "std")
    }


def straight_runs(
    count: int,
    *,
    frames: int = 12,
    particles: int = 40,
    seed: int = 0,
    box: float = 1.0,
) -> list[NDArray[np.float32]]:
    """Return trajectories of particles that fly straight inside a box, [frame,
    particle, 2].
    """
    rng = np.random.default_rng(seed)
    start = 0.3 + 0.4 * rng.random((count, 1, particles, 2))
    speed = min(0.02, 0.5 / frames) * (rng.random((count, 1, particles, 2)) - 0.5)
    time = np.arange(frames)[None, :, None, None]
    return list((box * (start + speed * time)).astype(np.float32))
