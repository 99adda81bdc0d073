"""Predictions of the scorer's own floors, so that they stand on the board as entries."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lagbench.data.layout import resolve_root
from lagbench.data.registry import Registry, load
from lagbench.errors import UsageError, nearest
from lagbench.floors import floors_of, given_in
from lagbench.scoring.task import load_scored_task
from lagbench.submission import PredictionsWriter

__all__ = ["write_floor"]


def write_floor(
    name: str,
    path: Path,
    *,
    split: str,
    size: str,
    root: str | Path | None = None,
    registry: Registry | None = None,
) -> Path:
    """Write the predictions of a floor."""
    described, folder = registry or load(), resolve_root(root)
    known = {floor.name: floor for floor in floors_of(described.size(split, size))}
    if name not in known:
        raise UsageError(f"no floor {name!r}", where="--floor", fix=nearest(name, known))
    exam = load_scored_task(described.size(split, size), folder)
    writer = PredictionsWriter(
        path, split=split, size=size, method=name, root=folder, registry=described, parameters=0
    )
    with writer:
        for number in exam.scenarios:
            with exam.opened(number) as truth:
                given = given_in(truth.file, exam.size, folder)
                writer.add(number, np.stack(list(known[name].predict(given))))
    return writer.path
