"""Run a season: predict its blind scenarios with the frozen models, and score them.

Every scored scenario is saved beside the blind data, so that an interrupted run goes on
where it stopped. The result, ``seasons/<name>/scores.yaml``, holds no date, no time and
no machine: everybody who repeats the run gets the same bytes, or on another kind of
processor values within the tolerance of docs/reproduce.md.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydantic import TypeAdapter

from lagbench.atomic import write_atomically
from lagbench.data.checksums import round_digits
from lagbench.data.layout import format_ids
from lagbench.data.local import load_rooted_registry, resolve_root
from lagbench.data.registry import Registry
from lagbench.data.scenario import read_scenario
from lagbench.errors import ChecksFailedError, DataError, UnreadableFileError
from lagbench.metrics.aggregate import Tally, score
from lagbench.metrics.frame import snapshots
from lagbench.metrics.table import METRICS, select
from lagbench.references.predictor import given_in
from lagbench.references.shipped import shipped
from lagbench.references.table import REFERENCES
from lagbench.scoring.boards import advise_board_check, board_option
from lagbench.scoring.references import check_train
from lagbench.scoring.scenario import SUBMISSION, measure_rows, predict_reference
from lagbench.scoring.score_file_checks import read_score_file
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.work.run import Meter, Progress

from .entry import Entry
from .entry_file import read_entry, require_unchanged_model, yaml_bytes
from .fields import RankingValue
from .folder import SEASON_SCORES, Folder, entry_path
from .lock import board_lock
from .reproduce import open_model, score_positions
from .scores_compared import DIGITS, TOLERANCE
from .season import (
    FrozenEntry,
    FrozenModel,
    Recorded,
    Season,
    SeasonDataSet,
    blind_size,
    read_season,
    season_path,
    season_root,
)
from .season_scores import (
    DataSetScores,
    ModelScores,
    SeasonScores,
    find_prediction,
    frozen_models,
    read_scores,
    values_of,
)

SAVED = "scores.json"
"""Name of the file beside the blind data with what is scored already."""

SAVED_VALUES = TypeAdapter(dict[str, dict[str, RankingValue]])
"""Its content: the ranking metric by what was scored, then by scenario and hash."""


@dataclass(frozen=True, kw_only=True)
class SeasonComparison:
    """How the scores of a repeated run compare with those on the board."""

    has_same_bytes: bool
    greatest: float  # greatest relative difference of a value
    values: int  # values that were compared


@dataclass(kw_only=True)
class SeasonResult:
    """What a run of a season did."""

    season: Season
    scores: SeasonScores
    path: Path  # the file of the scores
    predicted: list[str] = field(
        default_factory=list
    )  # as in "cavity/mini/gns, seed 0"
    comparison: SeasonComparison | None = None  # where the scores were compared only

    @property
    def exit_code(self) -> int:
        """1 where a repeated run has other scores than the board."""
        if self.comparison is None or self.comparison.greatest <= TOLERANCE:
            return 0
        return ChecksFailedError.exit_code


def run_season(
    board: str | Path,
    name: str,
    *,
    again: bool = False,
    comparing: bool = False,
    threads: int = 1,
    root: str | Path | None = None,
    registry: Registry | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> SeasonResult:
    """Score the frozen models of a season on its blind scenarios.

    What an earlier run has scored is not predicted again.

    Args:
        board: the leaderboard's folder.
        name: name of the season.
        again: whether to predict again what is saved.
        comparing: whether to compare the scores with those on the board, and to write
            nothing there.
        threads: threads of a model.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        registry: where splits are described; ours when None.
        progress: called as the work advances.

    Raises:
        UsageError: there is no such season, it waits for its random value, or an
            architecture is not installed.
        ChecksFailedError: a model is not the frozen one, or a value is missing.
        UnreadableFileError: a model cannot be read.
        DataError: blind scenarios, or the public data, are missing or others.
        WorkFailedError: the disk or the memory is full.
    """
    folder = Folder(board)
    folder.require()
    season = read_season(folder, name)
    stored = read_scores(folder, season)
    if comparing and stored is None:
        raise ChecksFailedError(
            "the season was not run yet: there is nothing to compare with",
            where=str(folder.path / season_path(name, SEASON_SCORES)),
            expected="the scores of an earlier run",
            got="no such file",
            fix=f"lagbench season run {name}{board_option(folder.path)}",
        )
    data_root = resolve_root(root)
    run = _SeasonRun(
        folder=folder,
        season=season,
        root=data_root,
        blind_root=season_root(name, root),
        registry=load_rooted_registry(data_root, registry),
        recorded={} if stored is None else stored.recorded,
        threads=threads,
        meter=Meter(progress),
    )
    if not again:
        run.load_saved()
    data_sets = [run.score(data_set) for data_set in season.data_sets]
    scores = SeasonScores(season=name, data_sets=tuple(data_sets))
    path = folder.path / season_path(name, SEASON_SCORES)
    result = SeasonResult(
        season=season, scores=scores, path=path, predicted=run.predicted
    )
    data = yaml_bytes(scores.model_dump(mode="python", exclude_none=True))
    if comparing and stored is not None:
        result.comparison = compare_scores(
            stored, scores, has_same_bytes=path.read_bytes() == data
        )
        return result
    folder.require_unlinked([season_path(name, SEASON_SCORES)])
    with board_lock(folder):
        write_atomically(path, data, option="--board")
    return result


def compare_scores(
    stored: SeasonScores, scores: SeasonScores, *, has_same_bytes: bool
) -> SeasonComparison:
    """Return the greatest relative difference of two runs of the same season.

    A value that only one of the runs has counts as a difference of 1.
    """
    before = list(_rows_of(stored))
    after = list(_rows_of(scores))
    greatest = 0.0
    count = 0
    for old_row, new_row in zip(before, after, strict=True):
        count += len(old_row)
        if old_row.keys() != new_row.keys():
            greatest = max(greatest, 1.0)
            continue
        for scenario, value in old_row.items():
            scale = max(value, float(np.finfo(np.float32).tiny))
            greatest = max(greatest, abs(new_row[scenario] - value) / scale)
    return SeasonComparison(
        has_same_bytes=has_same_bytes, greatest=greatest, values=count
    )


def _rows_of(scores: SeasonScores) -> Iterable[Mapping[int, float]]:
    """Yield the values of each predictor and model by scenario."""
    for data_set in scores.data_sets:
        yield data_set.public_reference
        yield data_set.blind_reference
        for model in data_set.models:
            yield model.public
            yield model.blind


@dataclass(kw_only=True)
class _SeasonRun:
    """One run of a season: its choices, and what is scored so far."""

    folder: Folder
    season: Season
    root: Path  # of the public data
    blind_root: Path
    registry: Registry
    recorded: Recorded
    threads: int
    meter: Meter
    predicted: list[str] = field(default_factory=list)
    # ranking metric by what was scored, then by id of the scenario
    _saved: dict[str, dict[str, float]] = field(default_factory=dict)

    def load_saved(self) -> None:
        """Read what an earlier run has scored; a damaged file counts as none."""
        try:
            content = json.loads((self.blind_root / SAVED).read_bytes())
            self._saved = SAVED_VALUES.validate_python(content)
        except (OSError, ValueError, RecursionError):
            self._saved = {}

    def score(self, data_set: SeasonDataSet) -> DataSetScores:
        """Return the scores of all models of a data set."""
        task = self._load_blind_task(data_set)
        hashes = {}
        for scenario in task.scenarios:
            with read_scenario(task.truth.path(scenario)) as file:
                hashes[scenario] = file.header.content_sha256
        models = []
        for frozen, model in frozen_models(data_set):
            models.append(self._score_model(data_set, frozen, model, task, hashes))
        return DataSetScores(
            split=data_set.split,
            size=data_set.size,
            draw_seed=str(data_set.draw_seed),
            scenarios=hashes,
            public_reference=self._public_reference(data_set),
            blind_reference=self._score_reference(data_set, task, hashes),
            models=tuple(models),
        )

    def _public_reference(self, data_set: SeasonDataSet) -> dict[int, float]:
        """Return the ranking metric of the naive predictor on test."""
        size = self.registry.size(data_set.split, data_set.size)
        reference = (shipped(size) or {}).get(data_set.reference)
        if reference is None or data_set.metric not in reference.scores:
            raise ChecksFailedError(
                "the naive predictor of the season was not measured on the data",
                where=f"{data_set.split} {data_set.size}",
                expected=f"{data_set.reference}, {data_set.metric}",
                got="no such scores",
                fix="check out the commit that closed the season",
            )
        return values_of(reference.scores[data_set.metric])

    def _load_blind_task(self, data_set: SeasonDataSet) -> ScoredTask:
        """Load the blind scenarios of a data set, with all that scoring them needs.

        Raises:
            DataError: a scenario is missing, or was drawn from another seed than the
                one that the season has for the data set.
        """
        size = blind_size(
            self.season,
            data_set,
            self.registry,
            self.recorded,
            board=self.folder.path,
        )
        fix = (
            f"lagbench generate --season {self.season.season} "
            f"--split {data_set.split} --size {data_set.size}"
            f"{board_option(self.folder.path)}"
        )
        missing = []
        for scenario in data_set.ids:
            if not size.path(self.blind_root, scenario).is_file():
                missing.append(scenario)
        if missing:
            raise DataError(
                "blind scenarios are not generated",
                where=str(size.folder(self.blind_root)),
                expected=f"scenarios {format_ids(data_set.ids)}",
                got=f"missing: {format_ids(missing)}",
                fix=fix,
            )
        try:
            task = load_scored_task(size, self.blind_root)
            self._check_seeds(task, data_set)
        except DataError as error:
            raise DataError(
                error.what,
                where=error.where,
                expected=error.expected,
                got=error.got,
                fix=f"{fix} --force",
            ) from error
        return task

    def _check_seeds(self, task: ScoredTask, data_set: SeasonDataSet) -> None:
        """Refuse scenarios that were drawn from another seed.

        The caller replaces what to do about them.
        """
        words = []
        for start in range(0, 64, 16):
            words.append(str(int(str(data_set.draw_seed)[start : start + 16], 16)))
        for scenario in task.scenarios:
            expected = ", ".join([*words, str(scenario)])
            path = task.truth.path(scenario)
            with read_scenario(path) as file:
                seed = file.header.seed
            if seed != expected:
                raise DataError(
                    "a blind scenario was drawn from another seed",
                    where=str(path),
                    expected=expected,
                    got=seed,
                    fix="remove the blind data, then: lagbench generate --season NAME",
                )

    def _score_reference(
        self, data_set: SeasonDataSet, task: ScoredTask, hashes: Mapping[int, str]
    ) -> dict[int, float]:
        """Return the ranking metric of the naive predictor; it may read train."""
        reference = REFERENCES[data_set.reference]
        public = self.registry.size(data_set.split, data_set.size)
        metric = data_set.metric
        check_train(public, self.root, [reference.name])

        def measure(scenario: int) -> Tally:
            with task.opened(scenario) as truth:
                given = given_in(truth.file, public, self.root)
                frames = predict_reference(reference, given)
                rows = {SUBMISSION: snapshots(truth.scenario, frames)}
                tallies, _ = measure_rows(
                    truth.scenario, truth.snapshots(), rows, metrics=select([metric])
                )
            return tallies[SUBMISSION]

        name = f"{data_set.split}/{data_set.size}, {reference.name}"
        key = f"{data_set.draw_seed} {reference.name}"
        return self._score_scenarios(name, key, metric, hashes, measure)

    def _score_model(
        self,
        data_set: SeasonDataSet,
        frozen: FrozenEntry,
        model: FrozenModel,
        task: ScoredTask,
        hashes: Mapping[int, str],
    ) -> ModelScores:
        """Return the ranking metric of a frozen model, in public and blind."""
        entry, index = self._find_model(data_set, frozen, model)
        stored = read_score_file(self.folder.path / entry.score_paths[index])
        public = score(METRICS[data_set.metric], stored.scores.tallies)
        if public is None:
            raise ChecksFailedError(
                "the ranking metric has no value",
                where=str(entry.score_paths[index]),
                expected=data_set.metric,
                got="scenarios without a value",
                fix=advise_board_check(self.folder.path),
            )
        wanted = dict(list(hashes.items())[: frozen.scenarios])
        # entries may share a model and still predict otherwise
        key = f"{data_set.draw_seed} {frozen.method} {model.seed} {model.sha256}"
        weights = entry.predictions[index].weights
        if weights is not None:
            require_unchanged_model(self.folder, weights)
        if self._is_saved(key, wanted):
            blind = self._saved_values(key, wanted)
        else:
            name = f"{data_set.split}/{data_set.size}/{frozen.method}"
            if model.seed is not None:
                name += f", seed {model.seed}"
            blind = self._predict(name, key, entry, index, task, data_set, wanted)
            self.predicted.append(name)
        return ModelScores(
            method=frozen.method,
            seed=model.seed,
            seeds=len(entry.predictions),
            model=model.sha256,
            public=values_of(public),
            blind=blind,
        )

    def _predict(
        self,
        name: str,
        key: str,
        entry: Entry,
        index: int,
        task: ScoredTask,
        data_set: SeasonDataSet,
        hashes: Mapping[int, str],
    ) -> dict[int, float]:
        """Return the metric of an entry's model in each blind scenario.

        Progress and errors call the model ``name``; its scores are saved under ``key``;
        ``index`` is the number of its prediction in the entry.
        """
        runner = open_model(
            self.folder,
            entry,
            entry.predictions[index],
            root=self.root,
            registry=self.registry,
            threads=self.threads,
        )

        def measure(scenario: int) -> Tally:
            position = runner.predict(task.truth.path(scenario))
            return score_positions(task, scenario, position, data_set.metric)

        try:
            return self._score_scenarios(name, key, data_set.metric, hashes, measure)
        finally:
            runner.close()

    def _find_model(
        self, data_set: SeasonDataSet, frozen: FrozenEntry, model: FrozenModel
    ) -> tuple[Entry, int]:
        """Return the entry with the frozen model, and the number of its prediction."""
        place = (data_set.split, data_set.size, frozen.method)
        path = self.folder.path / entry_path(place)
        try:
            entry = read_entry(path)
        except UnreadableFileError:
            entry = None
        if entry is not None:
            index = find_prediction(entry, model)
            if index is not None:
                return entry, index
        raise ChecksFailedError(
            "the frozen model is no longer on the board",
            where=str(path),
            expected=f"seed {model.seed}, a model with SHA-256 {model.sha256[:16]}, "
            f"predicted with {', '.join(model.options or ()) or 'its own options'}",
            got="no such model beside the entry, or other options",
            fix="check out the commit that closed the season",
        )

    def _score_scenarios(
        self,
        name: str,
        key: str,
        metric: str,
        hashes: Mapping[int, str],
        measure: Callable[[int], Tally],
    ) -> dict[int, float]:
        """Return the metric in each scenario; save each, take what is saved."""
        self.meter.begin(name, total=len(hashes), scenarios=len(hashes))
        row = self._saved.setdefault(key, {})
        for scenario, sha256 in hashes.items():
            place = f"{scenario} {sha256}"
            if place not in row:
                value = score(METRICS[metric], {scenario: measure(scenario)})
                if value is None or not np.isfinite(value.mean):
                    raise ChecksFailedError(
                        "the ranking metric has no value",
                        where=f"{name}, scenario {scenario}",
                        expected=metric,
                        got="no finite value",
                        fix="see whether the data are sound: lagbench verify",
                    )
                row[place] = round_digits(value.mean, DIGITS)
                data = json.dumps(self._saved, indent=1, sort_keys=True).encode()
                write_atomically(self.blind_root / SAVED, data, option="--root")
            self.meter.count(1, scenarios=1)
        return self._saved_values(key, hashes)

    def _is_saved(self, key: str, hashes: Mapping[int, str]) -> bool:
        row = self._saved.get(key, {})
        return all(f"{scenario} {sha256}" in row for scenario, sha256 in hashes.items())

    def _saved_values(self, key: str, hashes: Mapping[int, str]) -> dict[int, float]:
        values = {}
        for scenario, sha256 in hashes.items():
            values[scenario] = float(self._saved[key][f"{scenario} {sha256}"])
        return values
