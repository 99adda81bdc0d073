"""Metrics of particle rollouts: statistics per frame, then aggregates.

A statistic is a pure function of a :class:`FramePair`; tallies of statistics add; scores are
functions of their series over frames. :data:`METRICS` holds name, unit and direction of all.
"""

from __future__ import annotations

from .aggregate import Score, aggregate, score
from .comparison import Comparison, compare, shared_ranks, sign_flip_p
from .frame import FramePair, Scenario, Setting, Snapshot, snapshots
from .intervals import bootstrap_interval
from .metric import Direction, Metric, always, at_slow_frames, enough_nodes
from .table import FAMILIES, METRICS, available, select
from .tally import Tally, measure, tally

__all__ = [
    "FAMILIES",
    "METRICS",
    "Comparison",
    "Direction",
    "FramePair",
    "Metric",
    "Scenario",
    "Score",
    "Setting",
    "Snapshot",
    "Tally",
    "aggregate",
    "always",
    "at_slow_frames",
    "available",
    "bootstrap_interval",
    "compare",
    "enough_nodes",
    "measure",
    "score",
    "select",
    "shared_ranks",
    "sign_flip_p",
    "snapshots",
    "tally",
]
