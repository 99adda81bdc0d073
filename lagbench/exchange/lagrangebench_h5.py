"""The format of LagrangeBench: a group of an HDF5 file for each trajectory."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path

KINDS = {"liquid": 0, "jelly": 4, "snow": 5, "rope": 6, "wall": 1}
"""Number of each material."""

WALLS = (1, 2)
"""Numbers of the particles of a wall at rest, and of one that moves."""


def write(
    path: Path,
    runs: Iterable[tuple[NDArray[np.float32], NDArray[np.int64]]],
    *,
    length: int,
    origin: NDArray[np.float64],
) -> list[tuple[int, int]]:
    """Write one subset for LagrangeBench, whole or not at all.

    LagrangeBench takes the length of the first trajectory for all. So each run is cut
    into trajectories of one length, and the frames left over are not written.
    Chunks have one frame: LagrangeBench reads these 5 to 10 times faster than others.

    Args:
        path: the file.
        runs: positions [length], [frame, particle, axis], and the kind of each
            particle.
        length: frames of each trajectory.
        origin: point from which positions are measured [length], [axis].

    Returns:
        Frames and particles of each trajectory.
    """
    shapes: list[tuple[int, int]] = []
    with (
        atomic_path(path, option="--output") as temporary,
        h5py.File(temporary, "w", libver="earliest") as file,
    ):
        for position, kinds in runs:
            shift = origin.astype(np.float32)
            for start in range(0, len(position) - length + 1, length):
                group = file.create_group(f"{len(shapes):05d}")
                group.create_dataset(
                    "position",
                    data=position[start : start + length] - shift,
                    chunks=(1, *position.shape[1:]),
                    compression="gzip",
                    compression_opts=1,
                    shuffle=True,
                    track_times=False,
                )
                group.create_dataset(
                    "particle_type", data=kinds.astype("<i8"), track_times=False
                )
                shapes.append((length, len(kinds)))
    return shapes
