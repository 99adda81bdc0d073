"""The template of a submission: the persistence prediction, which any model should beat."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lagbench.data.local import locate
from lagbench.data.registry import Registry
from lagbench.store.copy import bring

from .truth import Truth
from .writer import PredictionsWriter

__all__ = ["TemplateResult", "template"]


@dataclass(frozen=True, kw_only=True)
class TemplateResult:
    """A template that was written."""

    path: Path  # the file
    split: str  # name of the split
    size: str  # name of the size
    scenarios: tuple[int, ...]  # ids of the test scenarios
    frames: tuple[int, int]  # absolute numbers of the first and the last frame to predict
    particles: int  # particles in every frame
    bytes: int  # length of the file


def template(
    split: str,
    size: str = "full",
    *,
    output: str | Path = "predictions.nc",
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> TemplateResult:
    """Write a valid predictions.nc to fill: the last given frame, repeated.

    Args:
        split: name of the split.
        size: name of the size.
        output: file to write.
        root: folder of all data sets, see :func:`lagbench.data.layout.resolve_root`.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown split or size.
        DataError: test scenarios are missing or damaged, or their data set has no recorded hash.
        WorkFailedError: the disk is full or not writable.
    """
    entry, folder, described = locate(split, size, root=root, registry=registry)
    bring(entry, folder, entry.subsets["test"])
    truth = Truth(entry, folder)
    truth.require()
    writer = PredictionsWriter(
        output, split=entry.split, size=size, method="persistence", root=folder, registry=described
    )
    ids = tuple(sorted(entry.subsets["test"]))
    with writer:
        for scenario in ids:
            writer.add(scenario, np.broadcast_to(truth.given(scenario)[-1], writer.shape))
    task = entry.task
    return TemplateResult(
        path=writer.path,
        split=entry.split,
        size=size,
        scenarios=ids,
        frames=(task.input_frames, task.input_frames + task.horizon - 1),
        particles=entry.particles,
        bytes=writer.path.stat().st_size,
    )
