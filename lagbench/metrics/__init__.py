"""Metrics of particle rollouts: statistics per frame, then aggregates.

A statistic is a pure function of a :class:`FramePair`; tallies of statistics add;
scores are functions of their series over frames. :data:`METRICS` holds name, unit and
direction of all.
"""

from __future__ import annotations

from .aggregate import (
    Resampling,
    Score,
    Tally,
    aggregate,
    bootstrap_interval,
    mean_over_seeds,
    measure,
    resample,
    score,
    tally,
)
from .frame import FramePair, Scenario, Snapshot, TaskConfig, snapshots
from .metric import (
    Direction,
    Metric,
    always,
    at_slow_frames,
    enough_nodes,
    mean,
    metric,
)
from .significance import (
    Comparison,
    Standing,
    compare,
    differ,
    holm,
    sign_flip_p,
    standings,
)
from .table import CHOSEN, FAMILIES, METRICS, available, select

__all__ = [
    "CHOSEN",
    "FAMILIES",
    "METRICS",
    "Comparison",
    "Direction",
    "FramePair",
    "Metric",
    "Resampling",
    "Scenario",
    "Score",
    "Snapshot",
    "Standing",
    "Tally",
    "TaskConfig",
    "aggregate",
    "always",
    "at_slow_frames",
    "available",
    "bootstrap_interval",
    "compare",
    "differ",
    "enough_nodes",
    "holm",
    "mean",
    "mean_over_seeds",
    "measure",
    "metric",
    "resample",
    "score",
    "select",
    "sign_flip_p",
    "snapshots",
    "standings",
    "tally",
]
