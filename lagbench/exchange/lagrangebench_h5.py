"""The format of LagrangeBench: HDF5 files with a group per trajectory, and metadata.json.

``train.h5``, ``valid.h5``, ``test.h5`` hold groups ``00000``, ``00001``, ... with ``position``
float32 [frame, particle, space] and ``particle_type`` [particle]. That reader takes the length
of ``00000`` for all trajectories of a file, and a ``force.py`` beside the data it executes: we
write none and run none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.errors import UnreadableFileError

from .metadata import Format, materials_of
from .trajectory import Frame, Trajectory, check_array, check_inflation

if TYPE_CHECKING:
    import h5py

__all__ = ["ENDING", "FORCE", "trajectories", "write"]

ENDING = ".h5"
FORCE = "force.py"
"""Name of the program that the other side would run."""

Run = tuple[int, Callable[[int], NDArray[np.float32]], NDArray[np.int64]]
"""Frames of a trajectory, what returns the positions of one of them, and the kind of each particle."""

_LEVEL = 1


def write(path: Path, runs: Iterable[Run], *, length: int, origin: Sequence[float]) -> list[tuple[int, int]]:
    """Write one subset; the file appears whole or not at all; return frames and particles of each trajectory.

    Every trajectory has ``length`` frames: longer runs become several, and what is left over at their
    end is not written. ``origin`` is taken off every position [length]. Chunks of one frame, with gzip
    and shuffle, are read there 5 to 10 times faster than those that HDF5 chooses.
    """
    import h5py

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
    import h5py

    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise UnreadableFileError("cannot read an HDF5 file", where=str(path), got=error) from error
    with file:
        with _whole(str(path)):
            keys = sorted(file)
        for key in keys:
            name = f"{path}, group {key!r}"
            with _whole(name):
                _check_links(name, file, key)
                found = _trajectory(name, file[key], kinds, np.asarray(origin, np.float32))
            yield found


@contextmanager
def _whole(name: str) -> Iterator[None]:
    """Tell what HDF5 says of damaged files, which it does by errors of many types, as one of ours."""
    try:
        yield
    except (OSError, RuntimeError, LookupError, TypeError, ValueError, MemoryError) as error:
        raise UnreadableFileError("a file is damaged", where=name, got=error) from error


def _check_links(name: str, file: h5py.File, key: str) -> None:
    """Refuse what HDF5 would fetch from other files: a stranger's file shall read none of ours."""
    import h5py

    places = [(file, key)]
    if isinstance(file.get(key, getlink=True), h5py.HardLink) and isinstance(file[key], h5py.Group):
        places += [(file[key], part) for part in file[key]]
    for parent, part in places:
        found = parent[part] if isinstance(parent.get(part, getlink=True), h5py.HardLink) else None
        elsewhere = isinstance(found, h5py.Dataset) and (found.is_virtual or found.external)
        if found is None or elsewhere:
            raise UnreadableFileError(
                "the file leads to another file",
                where=f"{name}, {part!r}",
                expected="data in the file itself",
                fix="write it again without links, virtual data sets and external storage",
            )


def _array(name: str, group: h5py.Group, part: str) -> h5py.Dataset:
    """Return an array of a trajectory that is one, and no larger than the file bears out."""
    import h5py

    found = group.get(part) if isinstance(group, h5py.Group) else None
    if not isinstance(found, h5py.Dataset) or found.shape is None:
        raise UnreadableFileError("this is no trajectory", where=name, expected="position and particle_type")
    check_inflation(f"{name}, {part}", packed=found.id.get_storage_size(), unpacked=found.nbytes)
    created = found.id.get_create_plist()
    filters = [created.get_filter(number)[0] for number in range(created.get_nfilters())]
    if len(filters) > len({*filters}):
        # Each round of the same filter may unpack to a thousand times its length.
        raise UnreadableFileError("a filter is applied twice", where=f"{name}, {part}", got=filters)
    return found


def _trajectory(
    name: str, group: h5py.Group, given: Mapping[int, str], origin: NDArray[np.float32]
) -> Trajectory:
    position, kinds = (_array(name, group, part) for part in ("position", "particle_type"))
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
            with _whole(f"{name}, frame {number}"):
                frame = position[number]
            yield (frame[kept] + origin if origin.any() else frame[kept]), None

    return Trajectory(name=name, frames=shape[0], material=material, read=read)
