"""Who stands where: which rows are ranked, and what the leader's lead is worth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from lagbench.data.layout import major_of
from lagbench.data.registry import Size
from lagbench.metrics import Score
from lagbench.metrics import standings as standings_of
from lagbench.metrics.significance import mean_loss

from .entry import DataSet, Entry, Status

__all__ = ["Standing", "is_current", "is_ranked", "mean_loss", "standings"]


@dataclass(frozen=True, kw_only=True)
class Standing:
    """The rank of a row."""

    rank: int  # from 1, in the order of the mean
    shared: bool  # whether the row cannot be told from the leader at 5 %
    # of the test against the leader, Holm-corrected; NaN for the leader itself and where fewer than six
    # scenarios allow no claim
    p: float


def is_current(dataset: DataSet, size: Size) -> bool:
    """Tell whether a data set is that of today: same MAJOR version, same hash where one is recorded."""
    recorded = size.measured.dataset_sha256 if size.measured else dataset.sha256
    return major_of(dataset.version) == size.major and dataset.sha256 == recorded


def is_ranked(entry: Entry, size: Size) -> bool:
    """Tell whether an entry takes part: active, on the data set of today, and no floor."""
    return entry.status is Status.ACTIVE and not entry.floor and is_current(entry.dataset, size)


def standings(scores: Mapping[str, Score]) -> dict[str, Standing]:
    """Return the standing of each ranked method."""
    if not scores:
        return {}
    return {
        name: Standing(rank=place.rank, shared=place.tied, p=place.p)
        for name, place in standings_of(scores).items()
    }
