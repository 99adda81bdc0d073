"""Who stands where: which rows are ranked, and what the leader's lead is worth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lagbench.data.layout import major_of
from lagbench.data.registry import Size
from lagbench.metrics import Score, compare, shared_ranks

from .entry import DataSet, Entry, Status

__all__ = ["Standing", "is_current", "is_ranked", "mean_loss", "standings"]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """The rank of a row."""

    rank: int  # from 1; shared by all that cannot be told from the leader at 5 %
    shared: bool  # whether another row has it too
    # of the sign-flip test against the leader; NaN for the leader itself and where fewer than six
    # scenarios allow no claim
    p: float


def is_current(dataset: DataSet, size: Size) -> bool:
    """Tell whether a data set is that of today: same MAJOR version, same hash where one is recorded."""
    recorded = size.measured.dataset_sha256 if size.measured else dataset.sha256
    return major_of(dataset.version) == size.major and dataset.sha256 == recorded


def is_ranked(entry: Entry, size: Size) -> bool:
    """Tell whether an entry takes part: active, on the data set of today, and no floor."""
    return entry.status is Status.ACTIVE and not entry.floor and is_current(entry.dataset, size)


def mean_loss(score: Score) -> float:
    """Return the mean over scenarios of the loss; infinite where nothing is defined."""
    losses = [score.metric.loss(value) for value in score.values.tolist() if not math.isnan(value)]
    return float(np.mean(losses)) if losses else math.inf


def standings(scores: Mapping[str, Score]) -> dict[str, Standing]:
    """Return the standing of each ranked method."""
    if not scores:
        return {}
    ranks = shared_ranks(scores)
    leader = min(scores, key=lambda name: (mean_loss(scores[name]), name))
    count = list(ranks.values())
    return {
        name: Standing(
            rank=rank,
            shared=count.count(rank) > 1,
            p=math.nan if name == leader else compare(scores[name], scores[leader]).p,
        )
        for name, rank in ranks.items()
    }
