"""Data in the two exchange formats, written as their own code bases write them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

SUBSETS = ("train", "valid", "test")
METADATA: dict[str, Any] = {
    "bounds": [[0.1, 0.9], [0.1, 0.9]],
    "sequence_length": 12,
    "default_connectivity_radius": 0.1,
    "dim": 2,
    "dt": 0.01,
    "write_every": 5,
    "periodic_boundary_conditions": [False, False],
}


def write_gns(folder: Path, runs: list[Any], kinds: Any = 5, **changes: Any) -> Path:
    """Write a run for each subset with numpy.savez, as the GNS programs do."""
    folder.mkdir(parents=True, exist_ok=True)
    for subset, run in zip(SUBSETS, runs, strict=True):
        pair = np.empty(2, dtype=object)
        pair[0] = run
        pair[1] = kinds
        np.savez(folder / f"{subset}.npz", simulation_trajectory_0=pair)
    write_metadata(folder, changes)
    return folder


def write_h5(folder: Path, runs: list[Any], kinds: Any = None, **changes: Any) -> Path:
    """Write a run for each subset, as LagrangeBench's own script does."""
    folder.mkdir(parents=True, exist_ok=True)
    for subset, run in zip(SUBSETS, runs, strict=True):
        particle_type = kinds
        if kinds is None:
            particle_type = np.zeros(run.shape[1], int)
        with h5py.File(folder / f"{subset}.h5", "w") as file:
            file.create_dataset("00000/position", data=run, compression="gzip")
            file["00000/particle_type"] = particle_type
    write_metadata(folder, changes)
    return folder


def write_metadata(folder: Path, changes: dict[str, Any]) -> None:
    """Write metadata.json with some values changed."""
    text = json.dumps({**METADATA, **changes})
    (folder / "metadata.json").write_text(text)
