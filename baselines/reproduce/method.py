"""A trained model as tables and sentences see it: scores of all its seeds, what it cost."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics import Score, mean

__all__ = ["Cost", "Method", "Seeded"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a predicted frame costs."""

    seconds_per_frame: float  # of the model [s]
    device: str  # where it ran
    # of the solver on the same machine [s]; None where not measured
    solver_seconds_per_frame: float | None = None

    @property
    def speed_up(self) -> float | None:
        """Solver time over model time; None where the solver was not measured."""
        solver = self.solver_seconds_per_frame
        return None if solver is None else solver / self.seconds_per_frame


@dataclass(frozen=True, kw_only=True, eq=False)
class Seeded:
    """One training of a model."""

    seed: int | None  # its seed; None for what has none
    scores: Mapping[str, Score]  # scores by metric
    record: Mapping[str, Any]  # what training.json says; empty where it is not there
    path: Path  # file of the scores

    @property
    def cpu_hours(self) -> float | None:
        """Processor time of the training [h]."""
        seconds = self.record.get("cpu_seconds")
        return None if seconds is None else float(seconds) / 3600.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Method:
    """A model with all its seeds."""

    name: str  # as in 'gns' or 'gns-novorticity'
    seeds: tuple[Seeded, ...]  # one entry per training
    cost: Cost | None = None  # of a predicted frame; None where it was not measured
    parameters: int | None = None  # trained numbers; None where unknown

    @cached_property
    def scores(self) -> Mapping[str, Score]:
        """Scores by metric: the mean over the seeds that have a value, per scenario and frame."""
        common = [n for n in self.seeds[0].scores if all(n in held.scores for held in self.seeds)]
        return {name: _joined([held.scores[name] for held in self.seeds]) for name in common}

    def of_seeds(self, seeds: Collection[int | None]) -> Method:
        """Return this model with the trainings of some seeds only."""
        return replace(self, seeds=tuple(held for held in self.seeds if held.seed in seeds))

    def spread(self, metric: str) -> float:
        """Return the sample deviation over seeds of the mean over scenarios; NaN for one seed."""
        means = [held.scores[metric].mean for held in self.seeds]
        return float(np.std(means, ddof=1)) if len(means) > 1 else float("nan")

    def at(self, metric: str, frame: int, scenario: int | None = None) -> float:
        """Return a metric at an absolute frame, of one scenario or in the mean over all."""
        score = self.scores[metric]
        values = score.at(frame)
        return mean(values) if scenario is None else float(values[score.scenarios.index(scenario)])

    def frozen_at(self, metric: str, frame: int) -> Score:
        """Return a metric's score with its values at one frame in place of those over the horizon."""
        return replace(self.scores[metric], values=self.scores[metric].at(frame))


def _joined(scores: Sequence[Score]) -> Score:
    if len(scores) == 1:
        return scores[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # undefined for all seeds: NaN
        frames: Floats = np.nanmean([score.per_frame for score in scores], axis=0)
        values: Floats = np.nanmean([score.values for score in scores], axis=0)
    undefined = tuple(map(sum, zip(*(score.undefined for score in scores), strict=True)))
    return replace(scores[0], per_frame=frames, values=values, undefined=undefined)
