"""Reproduce entries: run their models again, and compare the scores.

``lagbench leaderboard reproduce`` predicts test scenarios with the model that lies
beside an entry, scores the prediction, and compares it with the score file, scenario by
scenario. Then it measures what a frame costs (`measured_cost`). Results go to
verified.yaml after every model, so an interrupted run goes on where it stopped.

The same model does not give the same bits on every processor. docs/reproduce.md says
how far two processors differ; :data:`TOLERANCE` follows from that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.local import load_rooted_registry, resolve_root
from lagbench.data.registry import Registry, Size
from lagbench.errors import (
    ChecksFailedError,
    LagbenchError,
    UsageError,
    check_installed,
)
from lagbench.metrics.aggregate import Tally
from lagbench.metrics.frame import snapshots
from lagbench.metrics.table import select
from lagbench.models.onnx_model import open_onnx
from lagbench.scoring.scenario import SUBMISSION, measure_rows
from lagbench.scoring.score_file_checks import read_score_file
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.work.run import Meter, Progress

from .entry import (
    Entry,
    Level,
    MeasuredCost,
    Prediction,
    Reproduction,
    Verification,
)
from .entry_file import require_unchanged_model
from .folder import Folder
from .measured_cost import Runner, TimedEntry, TimeSolver, measure_costs
from .scores_compared import compare, sample_scenarios
from .selection import choose_entries, name_submit_command
from .verified import read_verified, record, verification_of


@dataclass(frozen=True, kw_only=True)
class Failure:
    """An entry that could not be run."""

    # path of its YAML file in the leaderboard's folder; the data set (split/size) where
    # the costs of all its entries failed
    entry: str
    error: LagbenchError


@dataclass(kw_only=True)
class ReproduceResult:
    """What came of running the models of entries again."""

    folder: Path
    # lines of verified.yaml by path of the entry, those of earlier runs among them
    lines: dict[str, Verification] = field(default_factory=dict)
    # predicted in this run, as in "cavity/mini/gns, seed 0"
    predicted: list[str] = field(default_factory=list)
    # whose costs were measured in this run, as in "cavity/mini/gns"
    measured: list[str] = field(default_factory=list)
    failures: list[Failure] = field(default_factory=list)

    @property
    def differing(self) -> list[str]:
        """Entries with a model that gives other scores."""
        names = []
        for path, line in self.lines.items():
            if not all(one.agrees for one in line.reproduced):
                names.append(path)
        return names

    def to_plain(self) -> dict[str, object]:
        """Return plain values, which JSON can hold."""
        lines = {}
        for path, line in self.lines.items():
            lines[path] = line.model_dump(mode="json", exclude_none=True)
        failures = {}
        for failure in self.failures:
            failures[failure.entry] = str(failure.error)
        return {
            "folder": str(self.folder),
            "entries": lines,
            "predicted": self.predicted,
            "measured": self.measured,
            "differing": self.differing,
            "failures": failures,
        }

    @property
    def exit_code(self) -> int:
        """0 where all scores agree, 1 where some differ, else that of a failure."""
        if self.differing:
            return ChecksFailedError.exit_code
        if self.failures:
            return self.failures[0].error.exit_code
        return 0


def reproduce(
    board: str | Path,
    entries: Sequence[str] = (),
    *,
    split: str | None = None,
    size: str | None = None,
    scenarios: int | None = None,
    scores: bool = True,
    costs: bool = True,
    again: bool = False,
    recording: bool = True,
    threads: int = 1,
    root: str | Path | None = None,
    registry: Registry | None = None,
    time_solver: TimeSolver | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> ReproduceResult:
    """Run the models of entries, compare their scores, measure their costs.

    Entries that are recorded for the same models and scores, with as many scenarios,
    are not run again. Costs are compared inside a data set, so they are measured for
    all its entries, unless all of them have costs of one run.

    If no entry is named, an error of one entry is kept in the result, and the other
    entries are run.

    Args:
        board: the leaderboard's folder.
        entries: entries, as in ``cavity/mini/gns``; by default all that have models.
        split: only entries of this split.
        size: only entries of this size.
        scenarios: predict only so many scenarios of each; by default all.
        scores: whether to predict and compare scores.
        costs: whether to measure costs.
        again: whether to run also what is recorded.
        recording: whether to write verified.yaml.
        threads: threads of a model while it predicts; costs are those of one.
        root: folder of all data sets; else LAGBENCH_ROOT, else the user data folder.
        registry: where splits are described; ours when None.
        time_solver: function that returns the solver's processor time of a frame [s].
            The caller gives it, because a board does not import the solver.
        progress: called as the work advances.

    Raises:
        UsageError: there is no leaderboard, no such entry, or one without a model; or
            torch is missing.
        DataError: the data of a named entry are missing or others.
        ChecksFailedError: a model of a named entry is not the one that it names.
        UnreadableFileError: a model of a named entry cannot be read.
        WorkFailedError: the disk or the memory is full.
    """
    folder = Folder(board)
    folder.require()
    data_root = resolve_root(root)
    rooted_registry = load_rooted_registry(data_root, registry)
    chosen = choose_entries(folder, entries, rooted_registry, split=split, size=size)

    run = _Reproduction(
        folder=folder,
        root=data_root,
        registry=rooted_registry,
        scenarios=scenarios,
        again=again,
        recording=recording,
        threads=threads,
        meter=Meter(progress),
        result=ReproduceResult(folder=folder.path),
    )
    is_named = bool(entries)
    if scores:
        for entry in chosen:
            try:
                run.reproduce(entry)
            except LagbenchError as error:
                if is_named:
                    raise
                path = entry.yaml_path.as_posix()
                run.result.failures.append(Failure(entry=path, error=error))
    if costs:
        run.measure_frame_costs(chosen, time_solver, is_named=is_named)
    for entry in chosen:
        line = run.line_of(entry)
        if line is not None:
            run.result.lines[entry.yaml_path.as_posix()] = line
    return run.result


def open_model(
    folder: Folder,
    entry: Entry,
    prediction: Prediction,
    *,
    root: Path,
    registry: Registry,
    threads: int = 1,
) -> Runner:
    """Return the model of a seed, ready to predict.

    Raises:
        UsageError: the seed has no model, or its architecture is not installed.
        ChecksFailedError: the file is not the one that the entry names.
        UnreadableFileError: the file is damaged.
        DataError: it was trained on other data.
    """
    if prediction.weights is None:
        raise UsageError(
            "the seed has no model",
            where=str(entry.yaml_path),
            expected="a model of every seed beside the entry",
            got="none",
            fix="its submitter may add one: "
            f"{name_submit_command(entry.yaml_path, folder.path)}",
        )
    path = require_unchanged_model(folder, prediction.weights)
    if path.suffix == ".onnx":
        return open_onnx(path, size=registry.size(entry.split, entry.size), root=root)

    check_installed("torch", extra="baselines")
    from lagbench.baselines.runner import WeightsRunner

    return WeightsRunner(
        path,
        size=entry.size,
        root=root,
        registry=registry,
        settings=entry.settings_of(prediction),
        threads=threads,
    )


def score_positions(
    task: ScoredTask, scenario: int, position: NDArray[np.float32], metric: str
) -> Tally:
    """Return the statistics of a predicted scenario that a metric needs."""
    with task.opened(scenario) as truth:
        rows = {SUBMISSION: snapshots(truth.scenario, position)}
        tallies, _ = measure_rows(
            truth.scenario, truth.snapshots(), rows, metrics=select([metric])
        )
    return tallies[SUBMISSION]


@dataclass(kw_only=True)
class _Reproduction:
    """One run of the command: its choices, and what it has loaded."""

    folder: Folder
    root: Path
    registry: Registry
    scenarios: int | None
    again: bool
    recording: bool
    threads: int
    meter: Meter
    result: ReproduceResult
    _tasks: dict[tuple[str, str], ScoredTask] = field(default_factory=dict)
    # lines that are not written where the run records nothing
    _lines: dict[str, Verification] = field(default_factory=dict)

    def line_of(self, entry: Entry) -> Verification | None:
        """Return the line of an entry: of this run, else the recorded one."""
        line = self._lines.get(entry.yaml_path.as_posix())
        if line is None:
            line = verification_of(entry, read_verified(self.folder))
        return line

    def reproduce(self, entry: Entry) -> None:
        """Predict with every model of an entry, and record how the scores compare."""
        for index, prediction in enumerate(entry.predictions):
            if prediction.weights is None:
                continue
            task = self._task(entry)
            chosen = sample_scenarios(
                task.scenarios, prediction.weights.sha256, self.scenarios
            )
            if not self.again and self._is_recorded(entry, prediction, len(chosen)):
                continue
            reproduction = self._predict(entry, index, task, chosen)
            self._record(entry, reproduction)
            self.result.predicted.append(name_seed(entry, prediction))

    def _is_recorded(self, entry: Entry, prediction: Prediction, count: int) -> bool:
        line = self.line_of(entry)
        if line is None:
            return False
        for one in line.reproduced:
            if one.seed == prediction.seed and one.scenarios >= count:
                return True
        return False

    def _task(self, entry: Entry) -> ScoredTask:
        size = self._size(entry)
        key = (entry.split, entry.size)
        if key not in self._tasks:
            self._tasks[key] = load_scored_task(size, self.root)
        return self._tasks[key]

    def _size(self, entry: Entry) -> Size:
        return self.registry.size(entry.split, entry.size)

    def _predict(
        self, entry: Entry, index: int, task: ScoredTask, chosen: Sequence[int]
    ) -> Reproduction:
        """Predict scenarios with a model and compare the ranking metric."""
        prediction = entry.predictions[index]
        metric = entry.score.ranking_metric
        stored = read_score_file(self.folder.path / entry.score_paths[index])
        model = open_model(
            self.folder,
            entry,
            prediction,
            root=self.root,
            registry=self.registry,
            threads=self.threads,
        )
        self.meter.begin(
            name_seed(entry, prediction), total=len(chosen), scenarios=len(chosen)
        )
        tallies = {}
        stored_tallies = {}
        try:
            for scenario in chosen:
                position = model.predict(task.truth.path(scenario))
                tallies[scenario] = score_positions(task, scenario, position, metric)
                stored_tallies[scenario] = stored.scores.tallies[scenario]
                self.meter.count(1, scenarios=1)
        finally:
            model.close()
        return compare(
            metric,
            stored_tallies,
            tallies,
            seed=prediction.seed,
            model=str(prediction.weights and prediction.weights.sha256),
            of=len(task.scenarios),
        )

    def _record(self, entry: Entry, reproduction: Reproduction) -> None:
        def change(line: Verification) -> Verification:
            return with_reproduction(line, reproduction, seeds=len(entry.predictions))

        self._change_line(entry, change)

    def _change_line(
        self, entry: Entry, change: Callable[[Verification], Verification]
    ) -> None:
        """Change the verification of an entry: in verified.yaml, or without recording
        only in memory.
        """
        if self.recording:
            record(self.folder, entry, change)
            return
        line = self.line_of(entry)
        if line is None:
            line = Verification.model_construct(
                scores=(), level=Level.AS_SUBMITTED, reproduced=(), cost=None
            )
        self._lines[entry.yaml_path.as_posix()] = change(line)

    def measure_frame_costs(
        self,
        entries: Sequence[Entry],
        time_solver: TimeSolver | None,
        *,
        is_named: bool,
    ) -> None:
        """Measure what a frame costs each model on the data sets of some entries.

        Costs compare within one run only. So all active entries of such a data set are
        timed, not the given ones alone, unless all have costs of one run already.
        """
        by_data_set: dict[tuple[str, str], list[Entry]] = {}
        for entry in entries:
            by_data_set.setdefault((entry.split, entry.size), []).append(entry)
        for (split, size), named in by_data_set.items():
            group = choose_entries(
                self.folder, (), self.registry, split=split, size=size
            )
            for entry in named:
                if entry not in group:
                    group.append(entry)
            if not self.again and self._have_costs_of_one_run(group):
                continue
            try:
                self._measure_costs_of_data_set(group, time_solver)
            except LagbenchError as error:
                if is_named:
                    raise
                failure = Failure(entry=f"{split}/{size}", error=error)
                self.result.failures.append(failure)

    def _have_costs_of_one_run(self, entries: Sequence[Entry]) -> bool:
        costs = []
        for entry in entries:
            line = self.line_of(entry)
            if line is None or line.cost is None:
                return False
            costs.append(line.cost)
        return all(cost.is_of_same_run(costs[0]) for cost in costs)

    def _measure_costs_of_data_set(
        self, entries: Sequence[Entry], time_solver: TimeSolver | None
    ) -> None:
        """Time the models of entries of one data set in one run, and keep the costs.

        The first model of an entry that opens is timed. An entry without such a model,
        or whose model fails, gets no cost; the result has its error. Costs go to
        verified.yaml, or stay in memory if nothing is recorded.
        """
        timed = []
        opened: list[Runner] = []
        try:
            for entry in entries:
                runner = self._open_a_model(entry)
                if runner is not None:
                    opened.append(runner)
                    timed.append(TimedEntry(entry=entry, runner=runner))
            if not timed:
                return
            task = self._task(entries[0])
            costs = measure_costs(
                timed,
                task,
                root=self.root,
                time_solver=time_solver,
                meter=self.meter,
                keep_failure=self._keep_failure,
            )
        finally:
            for runner in opened:
                runner.close()
        measured = {}
        for entry, cost in costs:
            measured[entry.yaml_path] = cost
        for entry in entries:
            new_cost = measured.get(entry.yaml_path)
            if new_cost is not None:
                self.result.measured.append("/".join(entry.place))
            elif self.line_of(entry) is None:
                continue
            # a cost of an earlier run does not compare with those of this one
            self._change_line(entry, partial(_with_cost, cost=new_cost))

    def _open_a_model(self, entry: Entry) -> Runner | None:
        """Return the first model of an entry that can be opened, None without one.

        The first error is kept in the result.
        """
        for prediction in entry.predictions:
            if prediction.weights is None:
                continue
            try:
                return open_model(
                    self.folder,
                    entry,
                    prediction,
                    root=self.root,
                    registry=self.registry,
                )
            except LagbenchError as error:
                self._keep_failure(entry, error)
        return None

    def _keep_failure(self, entry: Entry, error: LagbenchError) -> None:
        """Keep the first error of an entry in the result."""
        path = entry.yaml_path.as_posix()
        failed = {failure.entry for failure in self.result.failures}
        if path not in failed:
            self.result.failures.append(Failure(entry=path, error=error))


def _with_cost(line: Verification, cost: MeasuredCost | None) -> Verification:
    return line.model_copy(update={"cost": cost})


def with_reproduction(
    line: Verification, reproduction: Reproduction, *, seeds: int
) -> Verification:
    """Return a line with one more reproduction, at the level that follows.

    Args:
        line: the line of an entry.
        reproduction: the result of one of its models.
        seeds: number of predictions of the entry.
    """
    others = []
    for one in line.reproduced:
        if one.seed != reproduction.seed:
            others.append(one)
    reproduced = sorted([*others, reproduction], key=lambda one: one.seed or 0)
    is_reproduced = len(reproduced) == seeds and all(one.agrees for one in reproduced)
    level = line.level
    if is_reproduced and level.rank < Level.REPRODUCED.rank:
        level = Level.REPRODUCED
    elif not is_reproduced and level.rank >= Level.REPRODUCED.rank:
        level = Level.AS_SUBMITTED
    return line.model_copy(update={"reproduced": tuple(reproduced), "level": level})


def name_seed(entry: Entry, prediction: Prediction) -> str:
    """Return the name of one seed of an entry, as in ``cavity/mini/gns, seed 0``."""
    name = "/".join(entry.place)
    if prediction.seed is None:
        return name
    return f"{name}, seed {prediction.seed}"
