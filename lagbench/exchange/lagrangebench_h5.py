"""The format of LagrangeBench: HDF5 files with a group per trajectory, and metadata.json.

``train.h5``, ``valid.h5``, ``test.h5`` hold groups ``00000``, ``00001``, ... with ``position``
float32 [frame, particle, space] and ``particle_type`` [particle]. That reader takes the length
of ``00000`` for all trajectories of a file, and a ``force.py`` beside the data it executes: we
write none and run none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.data.hdf5 import Structure, check_structure, opened, reading
from lagbench.errors import UnreadableFileError

from .metadata import Format, materials_of
from .trajectory import Frame, Trajectory, check_array

ENDING = ".h5"
FORCE = "force.py"  # name of the program that the other side would run

Run = tuple[int, Callable[[int], NDArray[np.float32]], NDArray[np.int64]]
"""Frames of a trajectory, what returns the positions of one of them, and the kind of each particle."""

_LEVEL = 1

MOST_TRAJECTORIES = 100_000  # most trajectories of a file that are looked at


def write(path: Path, runs: Iterable[Run], *, length: int, origin: Sequence[float]) -> list[tuple[int, int]]:
    """Write one subset; the file appears whole or not at all; return frames and particles of each trajectory.

    Every trajectory has ``length`` frames: longer runs become several, and what is left over at their
    end is not written. ``origin`` is taken off every position [length]. Chunks of one frame, with gzip
    and shuffle, are read there 5 to 10 times faster than those that HDF5 chooses.
    """
    shapes: list[tuple[int, int]] = []
    with (
        atomic_path(path, option="--output") as temporary,
        h5py.File(temporary, "w", libver="earliest") as out,
    ):
        for frames, position, kinds in runs:
            for start in range(0, frames - length + 1, length):
                group = out.create_group(f"{len(shapes):05d}")
                stored = group.create_dataset(
                    "position",
                    shape=(length, len(kinds), 2),
                    dtype="<f4",
                    chunks=(1, len(kinds), 2),
                    compression="gzip",
                    compression_opts=_LEVEL,
                    shuffle=True,
                    track_times=False,
                )
                for row in range(length):
                    stored[row] = position(start + row) - np.asarray(origin, np.float32)
                group.create_dataset("particle_type", data=kinds.astype("<i8"), track_times=False)
                shapes.append((length, len(kinds)))
    return shapes


def trajectories(
    path: Path, *, kinds: Mapping[int, str], origin: Sequence[float] = (0.0, 0.0)
) -> Iterator[Trajectory]:
    """Yield the trajectories of a file; frames are read when asked for.

    Kinds say what numbers of particles stand for, see :func:`.metadata.materials_of`; ``origin`` is added
    to every position [length]. A group that is no trajectory is an UnreadableFileError, positions that
    are not of two components are a DataError.
    """
    with opened(path) as file:
        # A stranger's file shall read none of ours, and hold no more than it shows.
        check_structure(file, path, Structure(members=MOST_TRAJECTORIES, groups=None))
        for key in sorted(file):
            name = f"{path}, group {key!r}"
            with reading(path):
                found = _trajectory(path, name, file[key], kinds, np.asarray(origin, np.float32))
            yield found


def _trajectory(
    path: Path, name: str, group: h5py.Group, given: Mapping[int, str], origin: NDArray[np.float32]
) -> Trajectory:
    parts = set() if isinstance(group, h5py.Dataset) else set(group)
    if not {"position", "particle_type"} <= parts:
        raise UnreadableFileError("this is no trajectory", where=name, expected="position and particle_type")
    position, kinds = group["position"], group["particle_type"]
    shape = position.shape
    check_array(name, shape, position.dtype)
    numbers = np.asarray(kinds)
    if numbers.shape != shape[1:2] or numbers.dtype.kind not in "iu":
        raise UnreadableFileError(
            "these are no kinds of particles",
            where=name,
            expected=f"{shape[1]} integers",
            got=f"{numbers.dtype} of shape {numbers.shape}",
        )
    material, kept = materials_of(Format.LAGRANGEBENCH_H5, numbers, given=given, where=name)

    def read() -> Iterator[Frame]:
        for number in range(shape[0]):
            with reading(path, f"{position.name}, frame {number}"):
                frame = position[number]
            yield (frame[kept] + origin if origin.any() else frame[kept]), None

    return Trajectory(name=name, frames=shape[0], material=material, read=read)
