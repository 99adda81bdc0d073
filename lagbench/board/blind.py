"""Blind tests: the models of entries on test scenarios that nobody has seen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from lagbench.data.drawn import drawn_root, drawn_size
from lagbench.data.local import load_rooted_registry, resolve_root
from lagbench.data.registry import Registry
from lagbench.metrics.aggregate import Tally, score
from lagbench.metrics.frame import snapshots
from lagbench.metrics.table import METRICS, select
from lagbench.references.predictor import given_in
from lagbench.references.shipped import shipped
from lagbench.references.table import NAIVE, REFERENCES
from lagbench.scoring.references import check_train
from lagbench.scoring.score_file import read_statistics
from lagbench.scoring.skill import best_reference
from lagbench.scoring.task import (
    SUBMISSION,
    load_scored_task,
    measure_rows,
    predict_reference,
)
from lagbench.work.run import Meter, Progress

from .entry import Entry
from .folder import Folder
from .models import choose_entries, name_seed, open_model, predict_tallies


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
    folder = Folder(board)
    folder.require()
    data_root = resolve_root(root)
    rooted = load_rooted_registry(data_root, registry)
    chosen = choose_entries(folder, entries, rooted, split=split, size=size)
    meter = Meter(progress)
    scores = []
    for entry in chosen:
        scores += _score_entry(
            folder,
            entry,
            draw_seed,
            threads=threads,
            root=data_root,
            registry=rooted,
            meter=meter,
        )
    return scores


def _score_entry(
    folder: Folder,
    entry: Entry,
    draw_seed: str,
    *,
    threads: int,
    root: Path,
    registry: Registry,
    meter: Meter,
) -> list[BlindScore]:
    public_size = registry.size(entry.split, entry.size)
    size = drawn_size(public_size, draw_seed)
    task = load_scored_task(size, drawn_root(root, draw_seed))
    metric = METRICS[entry.score.ranking_metric]

    naive_scores = {}
    for name, reference in (shipped(public_size) or {}).items():
        if name in NAIVE and metric.name in reference.scores:
            naive_scores[name] = reference.scores[metric.name]
    best = best_reference(naive_scores)
    public_naive = blind_naive = float("nan")
    if best is not None:
        public_naive = naive_scores[best].mean
        check_train(public_size, root, [best])
        naive_tallies: dict[int, Tally] = {}
        for scenario in task.scenarios:
            with task.opened(scenario) as truth:
                given = given_in(truth.file, public_size, root)
                frames = predict_reference(REFERENCES[best], given)
                rows = {SUBMISSION: snapshots(truth.scenario, frames)}
                tallies, _ = measure_rows(
                    truth.scenario,
                    truth.snapshots(),
                    rows,
                    metrics=select([metric.name]),
                )
            naive_tallies[scenario] = tallies[SUBMISSION]
        naive = score(metric, naive_tallies)
        if naive is not None:
            blind_naive = naive.mean

    scores = []
    for index, prediction in enumerate(entry.predictions):
        if prediction.weights is None:
            continue
        name = name_seed(entry, prediction)
        model = open_model(
            folder, entry, prediction, root=root, registry=registry, threads=threads
        )
        meter.begin(name, total=len(task.scenarios), scenarios=len(task.scenarios))
        try:
            model_tallies = predict_tallies(
                model,
                task,
                metric.name,
                task.scenarios,
                done=lambda: meter.count(1, scenarios=1),
            )
        finally:
            model.close()
        stored = read_statistics(folder.path / entry.score_paths[index])
        public = score(metric, stored.tallies)
        blind = score(metric, model_tallies)
        public_mean = float("nan") if public is None else public.mean
        blind_mean = float("nan") if blind is None else blind.mean
        scores.append(
            BlindScore(
                name=name,
                public=public_mean,
                blind=blind_mean,
                public_skill=1.0 - public_mean / public_naive,
                blind_skill=1.0 - blind_mean / blind_naive,
            )
        )
    return scores
