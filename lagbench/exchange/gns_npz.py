"""The format of the PyTorch GNS code bases: npz files of pickled pairs.

``train.npz``, ``valid.npz``, ``test.npz`` hold one object array per trajectory:
positions [frame, particle, space] and the kind of each particle. NumPy stores such an
array as a pickle, which could call any function; the reader lets it name NumPy's arrays
and nothing else.
"""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.errors import UnreadableFileError

JOINT = "gns_data"
"""Key under which some files hold all trajectories together."""

SUFFIX = ".npz"

KINDS = {"liquid": 5, "snow": 6, "jelly": 7, "rope": 8, "wall": 3}
"""Number of each material."""

ALLOWED = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy.core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy.core.multiarray", "scalar"),
    ("numpy._core.multiarray", "scalar"),
}
"""What a pickle of arrays and numbers may name."""


class _ArrayUnpickler(pickle.Unpickler):
    """Unpickler that makes arrays and numbers, and calls nothing else."""

    def find_class(self, module: str, name: str) -> Any:  # noqa: ANN401
        if (module, name) not in ALLOWED:
            raise pickle.UnpicklingError(f"the pickle wants to call {module}.{name}")
        return super().find_class(module, name)


def is_pickled(path: Path) -> bool:
    """Return whether the first array of an npz file holds objects."""
    with zipfile.ZipFile(path) as archive:
        for member in archive.namelist():
            with archive.open(member) as stream:
                return bool(_read_header(stream).hasobject)
    return False


def _read_header(stream: IO[bytes]) -> np.dtype[Any]:
    """Return the type of the values of a .npy stream, which then stands behind it."""
    if np.lib.format.read_magic(stream) == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)[2]
    return np.lib.format.read_array_header_2_0(stream)[2]


def list_trajectories(path: Path) -> list[tuple[str, Callable[[], xr.Dataset]]]:
    """Return name and opener of each trajectory of a file, in its order."""
    with zipfile.ZipFile(path) as archive:
        keys = [name.removesuffix(".npy") for name in archive.namelist()]
    trajectories: list[tuple[str, Callable[[], xr.Dataset]]] = []
    for key in keys:
        if key != JOINT:
            trajectories.append((key, partial(_read, path, key)))
            continue
        for number in range(len(_load(path, key))):
            trajectories.append((f"{key} {number}", partial(_read, path, key, number)))
    return trajectories


def _read(path: Path, key: str, number: int | None = None) -> xr.Dataset:
    """Return the positions and kinds of a trajectory."""
    item = _load(path, key)
    if number is not None:
        item = item[number]
    parts = list(item) if np.ndim(item) or isinstance(item, tuple) else []
    if len(parts) not in (2, 3) or np.ndim(parts[0]) != 3:
        raise UnreadableFileError(
            f"{path}, {key} holds no trajectory; save positions [frame, particle, "
            "space] and a kind for each particle in an object array of two items"
        )
    position = np.asarray(parts[0])
    kinds = np.broadcast_to(np.asarray(parts[1]).squeeze(), position.shape[1:2])
    return xr.Dataset(
        {
            "position": (("frame", "particle", "space"), position),
            "particle_type": ("particle", kinds),
        },
        attrs={"kinds": {value: material for material, value in KINDS.items()}},
    )


def _load(path: Path, key: str) -> Any:  # noqa: ANN401
    """Return the object array of a member, made of arrays and numbers only."""
    with zipfile.ZipFile(path) as archive, archive.open(f"{key}.npy") as stream:
        _read_header(stream)
        return _ArrayUnpickler(stream, encoding="latin1").load()


def write(
    path: Path, runs: Iterable[tuple[NDArray[np.float32], NDArray[np.int64]]]
) -> None:
    """Write one subset, whole or not at all.

    Equal data give equal bytes: members have zip's earliest time and are not
    compressed, since compressed bytes change with the version of zlib.
    """
    with (
        atomic_path(path, option="--output") as temporary,
        zipfile.ZipFile(temporary, "w") as archive,
    ):
        for number, run in enumerate(runs):
            pair = np.empty(2, dtype=object)
            pair[0], pair[1] = run
            member = zipfile.ZipInfo(f"simulation_{number}.npy")
            member.external_attr = 0o644 << 16
            with archive.open(member, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, pair, (1, 0))
