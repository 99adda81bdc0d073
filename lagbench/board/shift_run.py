"""Score entries on ``shift``: predict it with their models (``leaderboard shift``).

Results go to shift.yaml after every model, so an interrupted run goes on where it
stopped. The task is that of ``test``; only the scenarios lie outside train.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lagbench.data.checksums import round_digits
from lagbench.data.local import load_rooted_registry, resolve_root
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.errors import ChecksFailedError, DataError, LagbenchError, UsageError
from lagbench.metrics.aggregate import score
from lagbench.metrics.table import METRICS
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.work.run import Meter, Progress

from .entry import Entry, Prediction
from .folder import Folder
from .reproduce import Failure, name_seed, open_model, score_positions
from .scores_compared import DIGITS
from .selection import choose_entries
from .shift import (
    SUBSET,
    ShiftModel,
    ShiftScores,
    read_shift,
    record_shift,
    shift_of,
)


@dataclass(kw_only=True)
class ShiftResult:
    """What a run scored."""

    folder: Path
    # scores by path of the entry, those of earlier runs among them
    entries: dict[str, ShiftScores] = field(default_factory=dict)
    # predicted in this run, as in "cavity/mini/gns, seed 0"
    predicted: list[str] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)

    def to_plain(self) -> dict[str, object]:
        """Return plain values, which JSON can hold."""
        entries = {}
        for path, scores in self.entries.items():
            entries[path] = scores.model_dump(mode="json")
        failures = {}
        for failure in self.failures:
            failures[failure.entry] = str(failure.error)
        return {
            "folder": str(self.folder),
            "entries": entries,
            "predicted": self.predicted,
            "failures": failures,
        }

    @property
    def exit_code(self) -> int:
        """0 where all models ran, else the exit code of the first failure."""
        if self.failures:
            return self.failures[0].error.exit_code
        return 0


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
        DataError: the data of a named entry are missing or others.
        ChecksFailedError: a model of a named entry is not the one that it names, or
            its ranking metric has no value.
        UnreadableFileError: a model of a named entry cannot be read.
        WorkFailedError: the disk or the memory is full.
    """
    folder = Folder(board)
    folder.require()
    data_root = resolve_root(root)
    rooted_registry = load_rooted_registry(data_root, registry)
    run = _ShiftRun(
        folder=folder,
        root=data_root,
        registry=rooted_registry,
        again=again,
        threads=threads,
        meter=Meter(progress),
        result=ShiftResult(folder=folder.path),
    )
    chosen = choose_entries(folder, entries, rooted_registry, split=split, size=size)
    if not entries:
        chosen = [entry for entry in chosen if _has_shift(entry, rooted_registry)]
        _require_some(chosen, folder, split, size)

    for entry in chosen:
        path = entry.yaml_path.as_posix()
        try:
            run.score(entry)
        except LagbenchError as error:
            if entries:
                raise
            run.result.failures.append(Failure(entry=path, error=error))
        scores = run.scores_of(entry)
        if scores is not None:
            run.result.entries[path] = scores
    return run.result


def _has_shift(entry: Entry, registry: Registry) -> bool:
    """Tell whether the data set of an entry has the subset ``shift``."""
    return SUBSET in registry.size(entry.split, entry.size).subsets


def _require_some(
    chosen: Sequence[Entry], folder: Folder, split: str | None, size: str | None
) -> None:
    """Refuse a choice of data sets in which there is nothing to run."""
    if chosen:
        return
    raise UsageError(
        f"no entry to score on {SUBSET}",
        where=str(folder.path),
        expected=f"active entries with models, of data sets with {SUBSET}",
        got=f"none of --split {split or 'any'} and --size {size or 'any'}",
        fix="`lagbench list` shows the subsets of a data set",
    )


@dataclass(kw_only=True)
class _ShiftRun:
    """One run of the command: its choices, and what it has loaded."""

    folder: Folder
    root: Path
    registry: Registry
    again: bool
    threads: int
    meter: Meter
    result: ShiftResult
    _tasks: dict[tuple[str, str], ScoredTask] = field(default_factory=dict)

    def score(self, entry: Entry) -> None:
        """Score all models of an entry that have no scores yet."""
        size = self._size(entry)
        for prediction in entry.predictions:
            if prediction.weights is None:
                continue
            if not self.again and self._is_recorded(entry, prediction):
                continue
            task = self._task(entry)
            # before the predictions, which may take hours
            subset_sha256 = self._subset_sha256(size)
            scores = ShiftModel(
                seed=prediction.seed,
                model=prediction.weights.sha256,
                values=self._predict(entry, prediction, task),
            )
            record_shift(self.folder, entry, size, scores, subset_sha256=subset_sha256)
            self.result.predicted.append(name_seed(entry, prediction))

    def scores_of(self, entry: Entry) -> ShiftScores | None:
        """Return the recorded scores of an entry."""
        return shift_of(entry, self._size(entry), read_shift(self.folder))

    def _size(self, entry: Entry) -> Size:
        return self.registry.size(entry.split, entry.size)

    def _subset_sha256(self, size: Size) -> str:
        """Return the hash of the files of ``shift`` that were predicted."""
        manifest = read_manifest(self.root, size.split, size.name, size.major)
        if manifest is None or SUBSET not in manifest.subset_sha256:
            raise DataError(
                "the data set has no manifest with the hash of shift",
                where=str(size.folder(self.root)),
                expected="a manifest with the hash of the subset",
                got="none",
                fix=f"lagbench verify --split {size.split} --size {size.name}",
            )
        return manifest.subset_sha256[SUBSET]

    def _is_recorded(self, entry: Entry, prediction: Prediction) -> bool:
        scores = self.scores_of(entry)
        if scores is None:
            return False
        return any(one.seed == prediction.seed for one in scores.models)

    def _task(self, entry: Entry) -> ScoredTask:
        key = (entry.split, entry.size)
        if key not in self._tasks:
            size = self._size(entry).scored_on(SUBSET)
            self._tasks[key] = load_scored_task(size, self.root)
        return self._tasks[key]

    def _predict(
        self, entry: Entry, prediction: Prediction, task: ScoredTask
    ) -> dict[int, float]:
        """Return the ranking metric of a model in each scenario."""
        metric = entry.score.ranking_metric
        name = name_seed(entry, prediction)
        model = open_model(
            self.folder,
            entry,
            prediction,
            root=self.root,
            registry=self.registry,
            threads=self.threads,
        )
        count = len(task.scenarios)
        self.meter.begin(f"{name}, shift", total=count, scenarios=count)
        values = {}
        try:
            for scenario in task.scenarios:
                position = model.predict(task.truth.path(scenario))
                tally = score_positions(task, scenario, position, metric)
                value = score(METRICS[metric], {scenario: tally})
                if value is None or not np.isfinite(value.mean):
                    raise ChecksFailedError(
                        "the ranking metric has no value",
                        where=f"{name}, scenario {scenario}",
                        expected=metric,
                        got="no finite value",
                        fix="see whether the data are sound: lagbench verify",
                    )
                values[scenario] = round_digits(value.mean, DIGITS)
                self.meter.count(1, scenarios=1)
        finally:
            model.close()
        return values
