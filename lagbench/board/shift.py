"""Scores of entries on the subset ``shift``, leaderboard/shift.yaml.

``shift`` lies outside train on purpose. ``lagbench leaderboard shift`` writes the
ranking metric of every scenario. A line holds while the entry has the very models that
the line names and the data are the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated

import numpy as np
from pydantic import Field, RootModel

from lagbench.atomic import write_atomically
from lagbench.data.registry import Registry, Size
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import LagbenchError
from lagbench.metrics.aggregate import Score
from lagbench.metrics.table import METRICS

from .entry import Entry, Hash, Label, Seed, Strict, validate, yaml_bytes
from .folder import SHIFT, Folder

SUBSET = "shift"

RankingValue = Annotated[float, Field(ge=0.0, le=1e75, allow_inf_nan=False)]


class ShiftModel(Strict):
    """The ranking metric of one model in each scenario of ``shift``."""

    seed: Seed | None = None
    model: Hash
    values: Annotated[dict[int, RankingValue], Field(min_length=1, max_length=1000)]


class ShiftScores(Strict):
    """The scores of an entry on ``shift``."""

    metric: Label
    dataset_sha256: Hash
    subset_sha256: Hash
    models: Annotated[
        tuple[ShiftModel, ...], Field(min_length=1, max_length=100, strict=False)
    ]

    def is_of(self, entry: Entry) -> bool:
        """Return whether the models are those of an entry."""
        return entry.models.issuperset((one.seed, one.model) for one in self.models)


class ShiftFile(RootModel[dict[str, ShiftScores]]):
    """Entries by path, relative to the leaderboard's folder."""


def read_shift(folder: Folder) -> dict[str, ShiftScores]:
    """Return the scores on ``shift`` by path of the entry; empty without the file.

    Raises:
        UnreadableFileError: the file cannot be read.
        ChecksFailedError: it holds something else.
    """
    path = folder.path / SHIFT
    content = read_yaml(path) if path.exists() else None
    return validate(ShiftFile, content or {}, path).root


def shift_of(
    entry: Entry, size: Size, shift: Mapping[str, ShiftScores]
) -> ShiftScores | None:
    """Return the scores of an entry; None without any, or of other data or models."""
    scores = shift.get(entry.yaml_path.as_posix())
    if scores is None or scores.metric != entry.score.ranking_metric:
        return None
    if size.measured is not None:
        recorded = (
            size.measured.dataset_sha256,
            size.measured.subset_sha256.get(SUBSET),
        )
        if (scores.dataset_sha256, scores.subset_sha256) != recorded:
            return None
    return scores if scores.is_of(entry) else None


def scores_of_seeds(scores: ShiftScores) -> list[Score]:
    """Return the score of each seed, without values per frame."""
    seeds = []
    for model in scores.models:
        scenarios, values = zip(*sorted(model.values.items()), strict=True)
        seeds.append(
            Score(
                metric=METRICS[scores.metric],
                scenarios=scenarios,
                frames=(),
                per_frame=np.empty((len(scenarios), 0)),
                values=np.array(values),
                undefined=(0,) * len(scenarios),
            )
        )
    return seeds


def record_shift(
    folder: Folder, entry: Entry, size: Size, written: ShiftModel, subset_sha256: str
) -> None:
    """Write the scores of one model; those of earlier models and data are let go."""
    with folder.lock():
        shift = read_shift(folder)
        present = shift_of(entry, size, shift)
        models = [written]
        if present is not None:
            models += [one for one in present.models if one.seed != written.seed]
        models.sort(key=lambda one: one.seed or 0)
        shift[entry.yaml_path.as_posix()] = ShiftScores(
            metric=entry.score.ranking_metric,
            dataset_sha256=entry.dataset.sha256,
            subset_sha256=subset_sha256,
            models=tuple(models),
        )
        _write(folder, shift)


def remove_stale_scores(folder: Folder, entry: Entry) -> bool:
    """Remove the scores of other models of an entry; return whether there were."""
    shift = read_shift(folder)
    scores = shift.get(entry.yaml_path.as_posix())
    if scores is None or scores.is_of(entry):
        return False
    del shift[entry.yaml_path.as_posix()]
    _write(folder, shift)
    return True


def check_shift(
    folder: Folder, entries: Mapping[str, Entry], registry: Registry
) -> Iterator[str]:
    """Yield lines that belong to no entry, or to other models or data."""
    try:
        shift = read_shift(folder)
    except LagbenchError as error:
        yield str(error)
        return
    for name in shift:
        entry = entries.get(name)
        if entry is None:
            yield f"{SHIFT}, {name}: no such entry; remove the line"
        elif shift_of(entry, registry.size(entry.split, entry.size), shift) is None:
            yield f"{SHIFT}, {name}: scores of other models or data; remove the line"


def _write(folder: Folder, shift: Mapping[str, ShiftScores]) -> None:
    lines = {name: scores.model_dump() for name, scores in sorted(shift.items())}
    write_atomically(folder.path / SHIFT, yaml_bytes(lines), option="--board")
