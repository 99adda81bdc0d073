"""Import what other code bases hold, as a local split that can be trained on and scored."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from lagbench.data.checksums import HASHED_SUBSETS, file_sha256
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.work.progress import Progress

from . import gns_npz, lagrangebench_h5
from .description import Description, Wishes
from .exporting import parse_format
from .kinds import Format
from .local_split import LocalSplit, make_local_split, output_name
from .metadata import Source, read_source
from .trajectory import Frame, Trajectory

__all__ = ["import_split"]

_ENDINGS = {Format.GNS_NPZ: gns_npz.ENDING, Format.LAGRANGEBENCH_H5: lagrangebench_h5.ENDING}


def import_split(
    source: str | Path,
    *,
    format: str,
    output: str | Path,
    allow_pickle: bool = False,
    kinds: Mapping[int, str] | None = None,
    progress: Callable[[Progress], None] | None = None,
    **wishes: Unpack[Wishes],
) -> LocalSplit:
    """Make a local split of train, valid and test in another code base's format.

    Positions are taken over as they are, as float32; velocities are their differences over the
    frame interval. A ``force.py`` beside the data is left alone.

    Args:
        source: folder of the three files and metadata.json.
        format: "gns-npz" or "lagrangebench-h5".
        output: folder to make; its last part is the name of the split.
        allow_pickle: whether arrays that are stored as pickled objects (all of gns-npz) may be
            rebuilt; whatever else a pickle calls is refused even then.
        kinds: number of a kind of particles to the material that it stands for, or to "drop".
        progress: called as the work advances.
        **wishes: what shall hold instead of what the metadata say, see
            :class:`lagbench.exchange.description.Description`.

    Raises:
        UsageError: unknown format, pickled objects that may not be rebuilt, a folder that is
            there, a task that does not fit the data.
        UnreadableFileError: a file is missing, damaged or laid out otherwise, or holds particles
            of a kind that no material is known for.
        DataError: positions are not plane, not finite, outside the unit box, or cross a
            periodic one.
        WorkFailedError: the disk is full or not writable.
    """
    form, folder = parse_format(format), Path(source)
    files = {subset: folder / f"{subset}{_ENDINGS[form]}" for subset in HASHED_SUBSETS}
    missing = [path.name for path in files.values() if not path.is_file()]
    if missing:
        raise UnreadableFileError(
            "files are missing",
            where=str(folder),
            expected=", ".join(p.name for p in files.values()),
            got=f"no {', no '.join(missing)}",
            fix=_other_format(folder, form),
        )
    if form is Format.GNS_NPZ and not allow_pickle:
        next(gns_npz.trajectories(files["train"], allow_pickle=False, kinds={}))
    stated = read_source(folder, form)
    about = Description(
        name=output_name(output),
        source=f"{form.value}: " + ", ".join(f"{p.name} {file_sha256(p)[:16]}" for p in files.values()),
        **_stated(stated, wishes),
    )
    given = dict(kinds or {})

    def read(path: Path) -> Iterator[Trajectory]:
        if form is Format.GNS_NPZ:
            return gns_npz.trajectories(path, allow_pickle=allow_pickle, kinds=given)
        found = lagrangebench_h5.trajectories(path, kinds=given, origin=stated.hints.origin)
        return (_unbroken(trajectory, stated) for trajectory in found)

    subsets = {subset: read(path) for subset, path in files.items()}
    return make_local_split(about, subsets, output, command="import", progress=progress)


def _other_format(folder: Path, form: Format) -> str | None:
    """Return the format that the files of a folder do have, as a remedy; None where none fits."""
    for other, ending in _ENDINGS.items():
        if other is not form and all((folder / f"{subset}{ending}").is_file() for subset in HASHED_SUBSETS):
            return f"the folder holds {HASHED_SUBSETS[0]}{ending}: --format {other.value}"
    return None


def _stated(stated: Source, wishes: Wishes) -> dict[str, Any]:
    """Return the facts of the metadata, those of our own exports, and over both the user's."""
    hints = stated.hints
    if wishes.keys() & {"input_frames", "horizon"}:  # the frames belong to the exported task
        hints = hints.model_copy(update={"frames_of_interest": None})
    found: dict[str, Any] = {
        "radius": stated.radius,
        "frame_interval": stated.frame_interval,
        "bounds": hints.bounds or stated.bounds,
        "spacing": hints.spacing or stated.spacing,
        "density": hints.density,
        "input_frames": hints.input_frames,
        "horizon": hints.horizon,
        "frames_of_interest": hints.frames_of_interest,
        "cells": hints.cells,
        "full_box": hints.placement == "cell_centres",
        **wishes,
    }
    if found["frame_interval"] is None:
        raise UsageError("the metadata state no time between frames", fix="say it: --frame-interval SECONDS")
    return {name: value for name, value in found.items() if value is not None}


def _unbroken(trajectory: Trajectory, stated: Source) -> Trajectory:
    """Return a trajectory that raises where particles cross a periodic boundary."""
    if not any(stated.periodic):
        return trajectory
    sides = np.array([high - low for low, high in stated.bounds])
    half = np.where(stated.periodic, sides / 2.0, np.inf)

    def read() -> Iterator[Frame]:
        before: NDArray[np.floating] | None = None
        for number, (position, velocity) in enumerate(trajectory.read()):
            if before is not None and (np.abs(position - before) > half).any():
                raise DataError(
                    "particles cross a periodic boundary",
                    where=f"{trajectory.name}, frame {number}",
                    expected="positions that move on: velocities are their differences",
                    got="a jump of more than half the box",
                    fix="lagbench has no periodic boxes: leave such data out",
                )
            before = position
            yield position, velocity

    return replace(trajectory, read=read)
