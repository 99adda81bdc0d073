"""Make a local split: scenario files, manifest and description in a folder of their own.

All of it is built beside the target and renamed at the end, so that a local split is there
whole or not at all. One frame of one trajectory is in memory at a time.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from lagbench.atomic import temporary_name
from lagbench.data.checksums import HASHED_SUBSETS
from lagbench.data.local import DESCRIPTION
from lagbench.data.manifest import Manifest
from lagbench.data.registry import load
from lagbench.errors import DataError, UsageError, WorkFailedError
from lagbench.work.progress import Meter, Progress

from .building import Building
from .description import SIZE, Description
from .trajectory import Trajectory

__all__ = ["LocalSplit", "Subsets", "make_local_split", "output_name"]

Subsets = Mapping[str, Iterable[Trajectory]]
"""Trajectories of train, valid and test, in order."""


@dataclass(frozen=True, kw_only=True)
class LocalSplit:
    """A local split that was made."""

    folder: Path  # its folder, which --split takes
    name: str
    size: str  # its only size
    scenarios: dict[str, int]  # number of scenarios by subset
    frames: int  # frames of all scenarios
    particles: tuple[int, int]  # the fewest and the most particles of a scenario
    input_frames: int  # frames given to a model
    horizon: int  # frames to predict
    spacing: float  # distance of neighbouring particles at first [length]
    bytes: int  # length of the scenario files [bytes]
    dataset_sha256: str  # hash of the data set
    notes: tuple[str, ...] = ()  # what a user should know


def output_name(output: str | Path) -> str:
    """Return the name of the split that a folder to make stands for: its last part."""
    return Path(os.path.abspath(Path(output).expanduser())).name


def make_local_split(
    about: Description,
    subsets: Subsets,
    output: str | Path,
    *,
    command: str,
    progress: Callable[[Progress], None] | None = None,
) -> LocalSplit:
    """Write a local split; it appears whole or not at all."""
    folder = Path(os.path.abspath(Path(output).expanduser()))
    if about.name in load().splits:
        raise UsageError(
            f"{about.name!r} is one of the splits of lagbench", where="--output", fix="use another name"
        )
    if folder.exists():
        raise UsageError(
            "the folder is there already", where=str(folder), fix="remove it, or use another name"
        )
    meter = Meter(progress)
    with _scratch(folder) as root:
        building = Building(about, root)
        for subset in HASHED_SUBSETS:
            before = len(building.entries)
            meter.begin(f"writing {subset}", total=0, scenarios=0)
            for trajectory in subsets[subset]:
                building.add(subset, trajectory)
                meter.count(1, scenarios=1)
            if len(building.entries) == before:
                raise DataError("a subset is empty", where=subset, expected="at least one trajectory")
        manifest = building.finish(command)
        size = load(root / about.name / DESCRIPTION).size(about.name, SIZE)
        (root / about.name).replace(folder)
    counts = sorted(entry.particles for entry in manifest.files)
    return LocalSplit(
        folder=folder,
        name=about.name,
        size=SIZE,
        scenarios={name: len(ids) for name, ids in size.subsets.items()},
        frames=sum(entry.frames for entry in manifest.files),
        particles=(counts[0], counts[-1]),
        input_frames=size.task.input_frames,
        horizon=size.task.horizon,
        spacing=building.spacing,
        bytes=sum(entry.bytes for entry in manifest.files),
        dataset_sha256=str(manifest.dataset_sha256),
        notes=tuple(_notes(manifest)),
    )


def _notes(manifest: Manifest) -> Iterator[str]:
    """Yield what limits the use of the split."""
    test = {entry.particles for entry in manifest.files if entry.subset == "test"}
    if len(test) > 1:
        yield (
            f"test scenarios have {min(test)} to {max(test)} particles: the split can be opened and "
            "trained on; predictions and scores need one number for all"
        )


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """Yield a folder beside the target that vanishes at the end."""
    root = temporary_name(folder)
    try:
        root.mkdir(parents=True)
        try:
            yield root
        finally:
            shutil.rmtree(root, ignore_errors=True)
    except (OSError, WorkFailedError) as error:
        raise WorkFailedError(
            "cannot write there",
            where=str(folder),
            got=error.got if isinstance(error, WorkFailedError) else error.strerror or error,
            fix="free disk space, or name another folder: --output",
        ) from error
