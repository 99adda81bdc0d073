"""Scores of entries on the subset ``shift``, leaderboard/shift.yaml.

``shift`` lies outside train on purpose. The file has the ranking metric of every
scenario; ``lagbench leaderboard shift`` writes it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from pydantic import Field

from lagbench.data.registry import Size
from lagbench.metrics.aggregate import Score
from lagbench.metrics.table import METRICS

from .entry import Entry, Hash, Label, Seed, Strict
from .folder import SHIFT
from .records import Record, RecordFile, record_of

SUBSET = "shift"

RankingValue = Annotated[float, Field(ge=0.0, le=1e75, allow_inf_nan=False)]


class ShiftModel(Strict):
    """The ranking metric of one model in each scenario of ``shift``."""

    seed: Seed | None = None
    model: Hash
    values: Annotated[dict[int, RankingValue], Field(min_length=1, max_length=1000)]


class ShiftScores(Record):
    """The scores of an entry on ``shift``."""

    metric: Label
    dataset_sha256: Hash
    subset_sha256: Hash
    models: Annotated[
        tuple[ShiftModel, ...], Field(min_length=1, max_length=100, strict=False)
    ]

    def is_of(self, entry: Entry) -> bool:
        """Return whether the scores are of the data and models of an entry."""
        stated = (entry.score.ranking_metric, entry.dataset.sha256)
        models = {(one.seed, one.model) for one in self.models}
        return stated == (self.metric, self.dataset_sha256) and models <= entry.models


SHIFT_SCORES = RecordFile(SHIFT, ShiftScores)
"""The file shift.yaml."""


def shift_of(
    entry: Entry, size: Size, shift: Mapping[str, ShiftScores]
) -> ShiftScores | None:
    """Return the scores of an entry; None without any, or of other data or models."""
    scores = record_of(entry, shift)
    # the hash of a data set does not cover shift
    if scores is None or size.measured is None:
        return scores
    is_current = scores.subset_sha256 == size.measured.subset_sha256.get(SUBSET)
    return scores if is_current else None


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
