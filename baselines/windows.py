"""Whole scenarios as batches, for rollouts and validation; training windows are `lagbench.torch`'s."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lagbench.data.local import locate
from lagbench.data.registry import Registry
from lagbench.data.scenario import read_scenario
from lagbench.errors import UsageError
from lagbench.store.copy import scenario_files
from lagbench.store.windows import window_of
from lagbench.torch import Batch, Window, collate, tensors

__all__ = [
    "scenario_batch",
    "scenario_paths",
]


def scenario_batch(paths: Path | Sequence[Path], frames: slice = slice(None)) -> Batch:
    """Return the same frames of one or several whole scenarios, for rollouts and validation."""
    return collate([_read(path, frames) for path in ([paths] if isinstance(paths, Path) else paths)])


def scenario_paths(
    split: str,
    *,
    subset: str = "test",
    size: str | None = None,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> dict[int, Path]:
    """Return the files of a subset by scenario id; all of them exist."""
    entry, folder, _ = locate(split, size, root=root, registry=registry)
    return scenario_files(entry, folder, (subset,))


def _read(path: Path, frames: slice) -> Window:
    """Read frames of one file without a cache."""
    with read_scenario(path) as file:
        numbers = range(file.header.frames)[frames]
        if not numbers or numbers.step != 1:
            raise UsageError(
                "no consecutive frames",
                where=str(path),
                expected=f"frames of 0:{file.header.frames}",
                got=frames,
            )
        run = slice(numbers.start, numbers.stop)
        held = file.variables
        position = file.read("position", run)
        material = file.read("material") if "material" in held else np.zeros(position.shape[1], np.int8)
        # The forcing is given for all frames, so that a rollout from these knows what comes.
        walls = file.read("wall_velocity", slice(run.start, None)) if "wall_velocity" in held else None
        return tensors(window_of(list(position), material, walls, file.header.key.scenario, numbers.start))
