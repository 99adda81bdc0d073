"""Generated tiny data and submissions to it, for tests of the scorer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import Registry, Size
from lagbench.make.generate import GenerationResult
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.submission import write

Floats = NDArray[np.floating[Any]]
Predict = Callable[[Floats, int, int], Floats]
"""From all true positions [frame, particle, 2], given frames n and horizon h to
predictions.
"""


@dataclass(frozen=True)
class ScoreBench:
    """A generated data set whose hashes stand in its manifest only."""

    root: Path
    registry: Registry
    size: Size

    @property
    def task(self) -> ScoredTask:
        """Its test subset."""
        return load_scored_task(self.size, self.root)

    def truth(self, scenario: int) -> Floats:
        """All positions of a test scenario, shape [frame, particle, 2]."""
        with self.task.opened(scenario) as opened:
            return np.asarray(opened.file.read("position"))

    def submit(self, path: Path, predict: Predict, **labels: Any) -> Path:
        """Write the submission of a method."""
        task = self.size.task
        predictions = {}
        for scenario in self.size.subsets["test"]:
            truth = self.truth(scenario)
            predictions[scenario] = predict(truth, task.input_frames, task.horizon)
        default_labels: dict[str, Any] = {"method": "guess"}
        return write(
            path,
            predictions,
            split=self.size.split,
            size=self.size.name,
            root=self.root,
            registry=self.registry,
            **(default_labels | labels),
        )

    def evaluate(self, path: Path, **options: Any) -> ScoreCard:
        """Return the score card of a submission."""
        return score(
            path,
            root=self.root,
            registry=self.registry,
            write=False,
            **options,
        )

    def score(self, path: Path, **options: Any) -> ScoreCard:
        """Score a submission and write the card beside it."""
        folder = {"output_dir": path.parent}
        return score(
            path,
            root=self.root,
            registry=self.registry,
            **(folder | options),
        )


def bench_of(generated: GenerationResult, registry: Registry) -> ScoreBench:
    """Return the bench of a generated data set."""
    size = registry.size(generated.split, generated.size)
    return ScoreBench(generated.root, registry, size)


def right(truth: Floats, n: int, h: int) -> Floats:
    """Predict the truth."""
    return truth[n : n + h]


def still(truth: Floats, n: int, h: int) -> Floats:
    """Predict the last given frame."""
    last = truth[n - 1]
    future = truth[n : n + h]
    return np.broadcast_to(last, future.shape)


def straight(truth: Floats, n: int, h: int) -> Floats:
    """Predict motion at the last given velocity."""
    last = truth[n - 1].astype(np.float64)
    steps = np.arange(1, h + 1)[:, None, None]
    velocity = last - truth[n - 2]
    return np.asarray(last + steps * velocity)


def late(truth: Floats, n: int, h: int) -> Floats:
    """Predict the truth, one frame late."""
    return truth[n - 1 : n + h - 1]


def half_right(truth: Floats, n: int, h: int) -> Floats:
    """Predict the truth for half the horizon, then stand still."""
    half = h // 2
    prediction = np.array(truth[n : n + h])
    prediction[half:] = prediction[half - 1]
    return prediction
