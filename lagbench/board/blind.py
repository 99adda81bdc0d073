"""Blind tests: the models of entries on test scenarios that nobody has seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.drawn import drawn_root, drawn_size
from lagbench.data.registry import Registry
from lagbench.metrics.aggregate import Tally, score
from lagbench.metrics.metric import Metric
from lagbench.metrics.table import METRICS
from lagbench.references.predictor import given_in
from lagbench.references.shipped import shipped
from lagbench.references.table import NAIVE, REFERENCES
from lagbench.scoring.score import check_train
from lagbench.scoring.score_file import read_statistics
from lagbench.scoring.skill import best_reference
from lagbench.scoring.task import load_scored_task, predict_reference
from lagbench.work.run import Progress

from .models import ModelRuns, name_seed, score_positions


@dataclass(frozen=True, kw_only=True)
class BlindScore:
    """A model on the scenarios of test and on drawn ones: its ranking metric, and the
    skill over the same naive baseline; NaN where undefined.
    """

    name: str  # as in "cavity/mini/gns, seed 0"
    public: float
    blind: float
    public_skill: float
    blind_skill: float


def score_blind(
    board: str | Path,
    entries: Sequence[str],
    draw_seed: str,
    *,
    split: str | None = None,
    size: str | None = None,
    threads: int = 1,
    root: str | Path | None = None,
    registry: Registry | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> list[BlindScore]:
    """Score the models of entries on scenarios of ``generate --draw-seed``.

    Args:
        board: the leaderboard's folder.
        entries: entries, as in ``cavity/mini/gns``; by default all that have models.
        draw_seed: seed of the scenarios [64 hexadecimal digits].
        split: only entries of this split.
        size: only entries of this size.
        threads: threads of a model.
        root: folder of all data sets.
        registry: where splits are described; ours when None.
        progress: called as the work advances.

    Raises:
        UsageError: the seed has another form, or no such entry or no model.
        DataError: the scenarios are not generated, or were drawn from another seed.
        ChecksFailedError: a model is not the one that its entry names.
    """
    runs = ModelRuns.of(
        board, threads=threads, root=root, registry=registry, progress=progress
    )
    scores = []
    for entry in runs.choose(entries, split=split, size=size):
        public_size = runs.size(entry)
        task = load_scored_task(
            drawn_size(public_size, draw_seed), drawn_root(runs.root, draw_seed)
        )
        metric = METRICS[entry.score.ranking_metric]
        naive_scores = {}
        for name, reference in (shipped(public_size) or {}).items():
            if name in NAIVE and metric.name in reference.scores:
                naive_scores[name] = reference.scores[metric.name]
        best = best_reference(naive_scores)
        public_naive = blind_naive = math.nan
        if best is not None:
            public_naive = naive_scores[best].mean
            check_train(public_size, runs.root, [best])
            naive_tallies = {}
            for scenario in task.scenarios:
                with task.opened(scenario) as truth:
                    given = given_in(truth.file, public_size, runs.root)
                    frames = predict_reference(REFERENCES[best], given)
                naive_tallies[scenario] = score_positions(
                    task, scenario, frames, metric.name
                )
            blind_naive = _mean(metric, naive_tallies)

        for index, prediction in enumerate(entry.predictions):
            if prediction.weights is None:
                continue
            stored = read_statistics(runs.folder.path / entry.score_paths[index])
            public = _mean(metric, stored.tallies)
            blind = _mean(metric, runs.tallies(entry, prediction, task, task.scenarios))
            scores.append(
                BlindScore(
                    name=name_seed(entry, prediction),
                    public=public,
                    blind=blind,
                    public_skill=1.0 - public / public_naive,
                    blind_skill=1.0 - blind / blind_naive,
                )
            )
    return scores


def _mean(metric: Metric, tallies: Mapping[int, Tally]) -> float:
    formed = score(metric, tallies)
    return math.nan if formed is None else formed.mean
