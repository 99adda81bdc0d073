"""Score entries on ``shift``: predict it with their models (``leaderboard shift``).

Results go to shift.yaml after every model, so an interrupted run goes on where it
stopped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lagbench.data.checksums import round_digits
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry
from lagbench.errors import ChecksFailedError, DataError, LagbenchError, UsageError
from lagbench.metrics.aggregate import score
from lagbench.metrics.table import METRICS
from lagbench.scoring.task import load_scored_task
from lagbench.work.run import Progress

from .models import ModelRuns, exit_code_of, name_seed
from .shift import SHIFT_SCORES, SUBSET, ShiftModel, ShiftScores, shift_of

DIGITS = 9
"""Digits of a score in the file."""


@dataclass(kw_only=True)
class ShiftResult:
    """What a run scored."""

    folder: Path
    # scores by path of the entry, those of earlier runs among them
    entries: dict[str, ShiftScores] = field(default_factory=dict)
    # predicted in this run, as in "cavity/mini/gns, seed 0"
    predicted: list[str] = field(default_factory=list)
    # by name of the entry
    failures: dict[str, LagbenchError] = field(default_factory=dict)

    def to_plain(self) -> dict[str, object]:
        """Return plain values, which JSON can hold."""
        entries = {}
        for path, scores in self.entries.items():
            entries[path] = scores.model_dump(mode="json")
        return {
            "folder": str(self.folder),
            "entries": entries,
            "predicted": self.predicted,
            "failures": {name: str(error) for name, error in self.failures.items()},
        }

    @property
    def exit_code(self) -> int:
        """0 where all models ran, else the exit code of the first failure."""
        return exit_code_of(self.failures)


def score_on_shift(
    board: str | Path,
    entries: Sequence[str] = (),
    *,
    split: str | None = None,
    size: str | None = None,
    again: bool = False,
    threads: int = 1,
    root: str | Path | None = None,
    registry: Registry | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> ShiftResult:
    """Predict ``shift`` with the models of entries, score it, write shift.yaml.

    Args:
        board: the leaderboard's folder.
        entries: entries, as in ``cavity/mini/gns``; by default all that have models.
        split: only entries of this split.
        size: only entries of this size.
        again: whether to predict again what is recorded.
        threads: threads of a model.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        registry: where splits are described; ours when None.
        progress: called as the work advances.

    Raises:
        UsageError: there is no leaderboard, no such entry, one without a model, or
            nothing to run.
        LagbenchError: a named entry cannot be run; of all entries the others are run.
    """
    runs = ModelRuns.of(
        board, threads=threads, root=root, registry=registry, progress=progress
    )
    folder = runs.folder
    result = ShiftResult(folder=folder.path)
    chosen = runs.choose(entries, split=split, size=size)
    if not entries:
        chosen = [entry for entry in chosen if SUBSET in runs.size(entry).subsets]
    if not chosen:
        raise UsageError(
            "no entry to score on shift; `lagbench info SPLIT` shows subsets"
        )

    for entry in chosen:
        tier = runs.size(entry)
        try:
            for prediction in entry.predictions:
                if prediction.weights is None:
                    continue
                present = shift_of(entry, tier, SHIFT_SCORES.read(folder))
                seed = prediction.seed
                seeds = () if present is None else [one.seed for one in present.models]
                if seed in seeds and not again:
                    continue
                manifest = read_manifest(runs.root, tier.split, tier.name, tier.major)
                if manifest is None or SUBSET not in manifest.subset_sha256:
                    raise DataError(
                        f"no manifest with the hash of {SUBSET}; lagbench verify "
                        f"--split {tier.split} --size {tier.name}"
                    )
                task = load_scored_task(tier.scored_on(SUBSET), runs.root)
                tallies = runs.tallies(entry, prediction, task, task.scenarios)
                scores = score(METRICS[entry.score.ranking_metric], tallies)
                name = name_seed(entry, prediction)
                if scores is None or not np.isfinite(scores.values).all():
                    raise ChecksFailedError(f"{name}: no finite score on {SUBSET}")
                values = [round_digits(one, DIGITS) for one in scores.values.tolist()]
                written = ShiftModel(
                    seed=seed,
                    model=prediction.weights.sha256,
                    values=dict(zip(scores.scenarios, values, strict=True)),
                )
                with SHIFT_SCORES.changing(folder) as records:
                    models = [written]
                    present = shift_of(entry, tier, records)
                    if present is not None:
                        kept = (one for one in present.models if one.seed != seed)
                        models += kept
                    models.sort(key=lambda one: one.seed or 0)
                    records[entry.yaml_path.as_posix()] = ShiftScores(
                        metric=entry.score.ranking_metric,
                        dataset_sha256=entry.dataset.sha256,
                        subset_sha256=manifest.subset_sha256[SUBSET],
                        models=tuple(models),
                    )
                result.predicted.append(name)
        except LagbenchError as error:
            if entries:
                raise
            result.failures["/".join(entry.place)] = error
        present = shift_of(entry, tier, SHIFT_SCORES.read(folder))
        if present is not None:
            result.entries[entry.yaml_path.as_posix()] = present
    return result
