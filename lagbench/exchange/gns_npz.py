"""The format of the PyTorch GNS code bases: npz files of pickled pairs, and metadata.json.

``train.npz``, ``valid.npz``, ``test.npz`` hold one object array per trajectory: positions
[frame, particle, space] and the kind of each particle; ``metadata.json`` the box, the number of
frames, the radius, and mean and deviation of velocity and acceleration per frame over train.
"""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.data.scenario import ScenarioFile, read_scenario
from lagbench.errors import UnreadableFileError, UsageError

from .inflation import check_inflation
from .kinds import Format, materials_of, numbers_of
from .object_array import read_objects, write_pair
from .trajectory import Trajectory, check_array, frames_of

__all__ = ["ENDING", "trajectories", "write"]

ENDING = ".npz"
JOINT = "gns_data"
"""Key under which some files hold all trajectories together."""

_EPOCH = (1980, 1, 1, 0, 0, 0)
"""Time of every member: the earliest that zip knows, so that equal data give equal bytes."""


def write(path: Path, scenarios: Iterable[Path]) -> list[tuple[int, int]]:
    """Write one subset; the file appears whole or not at all.

    Members are stored uncompressed, as ``numpy.savez`` stores them: compressed bytes would
    change with the version of zlib.
    """
    with atomic_path(path, option="--output") as temporary, zipfile.ZipFile(temporary, "w") as archive:
        return [_add(archive, f"simulation_{number}", file) for number, file in enumerate(scenarios)]


def _add(archive: zipfile.ZipFile, key: str, path: Path) -> tuple[int, int]:
    with read_scenario(path) as file:
        shape = (file.header.frames, file.header.particles, 2)
        kinds = numbers_of(Format.GNS_NPZ, file.read("material"))
        member = zipfile.ZipInfo(f"{key}.npy", date_time=_EPOCH)
        member.external_attr = 0o644 << 16
        with archive.open(member, "w", force_zip64=True) as stream:
            write_pair(stream, _frames(file), shape, kinds)
    return shape[:2]


def _frames(file: ScenarioFile) -> Iterator[NDArray[np.float32]]:
    return (frame for block in file.blocks("position") for frame in block)


def trajectories(path: Path, *, allow_pickle: bool, kinds: Mapping[int, str]) -> Iterator[Trajectory]:
    """Yield the trajectories of a file, one in memory at a time."""
    if not allow_pickle:
        raise UsageError(
            "the trajectories in this format are pickled objects",
            where=str(path),
            expected="leave to rebuild them",
            fix="add --allow-pickle: arrays are rebuilt, any other call in the file is refused",
        )
    with _opened(path) as archive:
        for name, item in _items(archive, path):
            yield _trajectory(name, item, kinds)


def _opened(path: Path) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(path)
    except (OSError, zipfile.BadZipFile) as error:
        raise UnreadableFileError(
            "cannot read an npz file", where=str(path), got=f"{type(error).__name__}: {error}"
        ) from error


def _items(archive: zipfile.ZipFile, path: Path) -> Iterator[tuple[str, object]]:
    """Yield name and object of each trajectory, in the order of the zip file."""
    for member in archive.namelist():
        key = member.removesuffix(".npy")
        name = f"{path}, key {key!r}"
        with _member(archive, member, name) as stream:
            array = read_objects(stream, name)
        if key == JOINT and array.ndim:
            yield from ((f"{name}, item {i}", item) for i, item in enumerate(array))
        else:
            yield name, array


def _member(archive: zipfile.ZipFile, member: str, name: str) -> io.BufferedReader:
    about = archive.getinfo(member)
    check_inflation(name, packed=about.compress_size, unpacked=about.file_size)
    try:
        return io.BufferedReader(archive.open(member))  # type: ignore[arg-type]
    except (OSError, RuntimeError, zipfile.BadZipFile, NotImplementedError) as error:
        raise UnreadableFileError("a member of an npz file is damaged", where=name, got=error) from error


def _trajectory(name: str, item: object, given: Mapping[int, str]) -> Trajectory:
    """Return the trajectory of a pair (positions, kinds) or a triple with a material property."""
    several = isinstance(item, tuple) or (isinstance(item, np.ndarray) and item.ndim == 1)
    parts = list(item) if several else []  # type: ignore[call-overload]
    if len(parts) not in (2, 3) or not isinstance(parts[0], np.ndarray):
        raise UnreadableFileError(
            "this is no trajectory", where=name, expected="positions, kinds[, a material property]", got=item
        )
    position = parts[0]
    check_array(name, position.shape, position.dtype)
    numbers = _kinds(name, parts[1], position.shape[1])
    material, kept = materials_of(Format.GNS_NPZ, numbers, given=given, where=name)
    parameters = {}
    if len(parts) == 3:
        values = np.unique(np.asarray(parts[2], dtype=np.float64))
        parameters = {"material_property": values[0]} if len(values) == 1 else {}
    chosen = position if kept.all() else position[:, kept]
    return Trajectory(
        name=name,
        frames=len(position),
        material=material,
        read=lambda: frames_of(chosen),
        parameters=parameters,
    )


def _kinds(name: str, value: object, particles: int) -> NDArray[np.integer]:
    """Return the kind of each particle; one number stands for all."""
    numbers = np.asarray(value)
    if numbers.dtype.kind not in "iu" or numbers.shape not in ((), (1,), (particles,)):
        raise UnreadableFileError(
            "these are no kinds of particles",
            where=name,
            expected=f"an integer, or {particles} of them",
            got=f"{numbers.dtype} of shape {numbers.shape}",
        )
    return np.broadcast_to(numbers, (particles,))
