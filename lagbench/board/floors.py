"""The floors of a board: the one place that knows where their scores come from.

Which floors there are, :mod:`lagbench.floors` says, and of our data sets also what they score. Those
of a split of somebody's own the scorer measures beside a submission, and ``lagbench submit`` keeps
that under ``floors/``: statistics that are equal whoever submits, in the layout of a score file whose
pictures show the truth alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from lagbench.data.registry import Size
from lagbench.errors import UnreadableFileError
from lagbench.floors.shipped import FloorScores, shipped
from lagbench.floors.table import FLOORS as KNOWN
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.scenario import SUBMISSION
from lagbench.scoring.score_file import write_statistics

from .entry import DataSet
from .folder import FLOORS, Folder
from .ranking import combine, is_current
from .score_file import read_stored

__all__ = ["dataset_of", "floor_names", "read_floors", "write_floors"]


def floor_names() -> tuple[str, ...]:
    """Return the names that no method may have."""
    return tuple(KNOWN)


def read_floors(folder: Folder, size: Size) -> tuple[FloorScores, ...]:
    """Return the floors of a split and size, those of another data set left out."""
    if known := shipped(size):
        return tuple(known.values())
    found = []
    for path in folder.floor_files(size.split, size.name):
        scores = read_stored(folder.path / path).scores
        if path.stem not in KNOWN or not is_current(dataset_of(scores.identity), size):
            continue
        read_stored(folder.path / path, size)
        held = {name: made.score for name, made in combine([scores]).items()}
        found.append(
            FloorScores(name=path.stem, scores=held, seconds_per_frame=math.nan, correlation=np.empty(0))
        )
    return tuple(found)


def dataset_of(identity: Mapping[str, str]) -> DataSet:
    """Return the data set that scores say they belong to."""
    return DataSet.model_construct(version=identity["dataset_version"], sha256=identity["dataset_sha256"])


def write_floors(card: ScoreCard, folder: Folder) -> tuple[Path, ...]:
    """Write the floors that a score card has and the folder lacks; return their paths."""
    written = []
    header, preview = card.header, card.preview
    nothing = np.full_like(preview.vorticity[0], np.nan)
    truth = replace(
        preview,
        vorticity=np.stack([preview.vorticity[0], nothing]),
        histogram=np.stack([preview.histogram[0], np.full_like(preview.histogram[0], np.nan)]),
        film=np.stack([preview.film[0], preview.film[0]]),
    )
    for name in card.tallies.keys() - {SUBMISSION}:
        path = folder.path / FLOORS / header.split / header.size / f"{name}.nc"
        if _dataset_in(path) == header.dataset_sha256:
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        write_statistics(
            replace(
                card,
                header=replace(header, method=name),
                predictions_sha256="0" * 64,
                tallies={SUBMISSION: card.tallies[name]},
                preview=truth,
            ),
            path,
        )
        written.append(path)
    return tuple(sorted(written))


def _dataset_in(path: Path) -> str | None:
    """Return the data set of a floor's file; None where there is no sound one."""
    try:
        return read_stored(path).scores.identity["dataset_sha256"]
    except UnreadableFileError:
        return None
