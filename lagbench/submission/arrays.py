"""Write a predictions.nc from arrays in memory."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from lagbench.data.registry import Registry, spell_ids
from lagbench.errors import UsageError

from .header import DIMS
from .writer import Label, PredictionsWriter

__all__ = ["write"]


def write(
    path: str | Path,
    positions: Mapping[int, ArrayLike] | ArrayLike,
    *,
    split: str,
    size: str = "full",
    method: str,
    velocities: Mapping[int, ArrayLike] | ArrayLike | None = None,
    diverged_at: Mapping[int, int] | None = None,
    dataset_sha256: str | None = None,
    root: str | Path | None = None,
    registry: Registry | None = None,
    **labels: Label,
) -> Path:
    """Write a predictions.nc from arrays.

    Args:
        path: file to write.
        positions: scenario id to positions [length], shape [frame, particle, space]; or one
            array [scenario, frame, particle, space] with the test scenarios by ascending id.
        split: name of the split.
        size: name of the size.
        method: what made the predictions.
        velocities: velocities [length/s], in the same form; stored, not scored.
        diverged_at: scenario id to the absolute frame from which its rollout is frozen.
        dataset_sha256: hash of the data set that the model was given; else the recorded one.
        root: folder of all data sets; asked only where no hash is recorded.
        registry: where splits are described; ours when None.
        **labels: seconds_per_frame, device, seed, parameters, training.

    Returns:
        The path.

    Raises:
        UsageError: unknown names, wrong shapes, missing scenarios, values that are not finite.
        DataError: the hash of the data set is not known.
        WorkFailedError: the disk is full or not writable.
    """
    writer = PredictionsWriter(
        path,
        split=split,
        size=size,
        method=method,
        velocity=velocities is not None,
        dataset_sha256=dataset_sha256,
        root=root,
        registry=registry,
        **labels,
    )
    ids = sorted(writer.size.subsets["test"])
    placed, moving = _by_id(positions, ids), None if velocities is None else _by_id(velocities, ids)
    with writer:
        for scenario, values in placed.items():
            velocity = None if moving is None else moving.get(scenario)
            writer.add(scenario, values, velocity, diverged_at=(diverged_at or {}).get(scenario))
    return writer.path


def _by_id(values: Mapping[int, ArrayLike] | ArrayLike, ids: list[int]) -> Mapping[int, ArrayLike]:
    if isinstance(values, Mapping):
        return values
    array = np.asarray(values)
    if array.ndim != len(DIMS) or len(array) != len(ids):
        raise UsageError(
            "the array does not hold one entry per test scenario",
            expected=f"{len(ids)} scenarios ({spell_ids(ids)}) first, 4 dimensions",
            got=f"shape {array.shape}",
            fix="or give a mapping of scenario id to array",
        )
    return dict(zip(ids, array, strict=True))
