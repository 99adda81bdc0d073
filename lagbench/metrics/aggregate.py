"""From tallies to scores: frames become one number per scenario, scenarios a mean.

RMSE is the root of the frame mean of MSE within a scenario, then the mean over scenarios;
every other metric is the mean over frames, then over scenarios. Undefined frames are left
out and counted; so is a scenario without a defined frame. Scenarios are taken in id order.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .frame import Floats
from .intervals import bootstrap_interval
from .metric import Metric
from .reductions import mean
from .tally import Tally

__all__ = ["Score", "aggregate", "score"]


@dataclass(frozen=True, eq=False)
class Score:
    """What a metric says of one prediction."""

    metric: Metric
    scenarios: tuple[int, ...]  # scenario ids, ascending
    frames: tuple[int, ...]  # absolute numbers of the predicted frames
    per_frame: Floats  # value at each frame, NaN where not measured or undefined, shape [scenario, frame]
    values: Floats  # value over the horizon, shape [scenario]
    undefined: tuple[int, ...]  # measured frames without a value, shape [scenario]

    @property
    def mean(self) -> float:
        """Mean over the scenarios that have a value."""
        return mean(self.values)

    @cached_property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the mean, by bootstrap over scenarios."""
        return bootstrap_interval(self.values)

    def at(self, frame: int) -> Floats:
        """Return the value at one absolute frame, shape [scenario]."""
        return self.per_frame[:, self.frames.index(frame)]


def score(metric: Metric, tallies: Mapping[int, Tally]) -> Score | None:
    """Return the score of one metric, None where it was measured nowhere or the task is too short."""
    scenarios = tuple(sorted(tallies))
    frames = tallies[scenarios[0]].frames
    asked = np.stack([_measured(metric, tallies[i]) for i in scenarios])
    if metric.horizon > len(frames) or not asked.any():
        return None
    series = np.stack([_series(metric, tallies[i]) for i in scenarios])
    return Score(
        metric=metric,
        scenarios=scenarios,
        frames=frames,
        per_frame=series,
        values=np.array([metric.over_frames(row) for row in series]),
        undefined=tuple(np.count_nonzero(asked & np.isnan(series), axis=1).tolist()),
    )


def _series(metric: Metric, tally: Tally) -> Floats:
    return np.asarray(metric.series(*(tally.series(name) for name in metric.of)), np.float64)


def _measured(metric: Metric, tally: Tally) -> NDArray[np.bool_]:
    return np.asarray(np.all([tally.measured(name) for name in metric.of], axis=0), np.bool_)


def aggregate(metrics: Iterable[Metric], tallies: Mapping[int, Tally]) -> dict[str, Score]:
    """Return the scores of all metrics that this split and size have, by name."""
    scores = {metric.name: score(metric, tallies) for metric in metrics}
    return {name: found for name, found in scores.items() if found is not None}
