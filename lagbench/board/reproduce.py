"""Reproduce entries: run their models again, compare the scores, measure the costs.

``lagbench leaderboard reproduce`` predicts test scenarios with the model of an entry,
scores the prediction, and compares it with the score file. Then it measures what a
frame costs. Results go to verified.yaml after every model, so an interrupted run goes
on where it stopped.

The same model does not give the same bits on every processor. docs/reproduce.md says
how far two processors differ; :data:`TOLERANCE` follows from that.
"""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from lagbench.data.checksums import round_digits
from lagbench.data.registry import Registry
from lagbench.errors import ChecksFailedError, LagbenchError, WorkFailedError
from lagbench.metrics.aggregate import Tally, score
from lagbench.metrics.table import METRICS
from lagbench.references.predictor import Kind, given_in
from lagbench.references.table import references_of
from lagbench.scoring.score import time_frames
from lagbench.scoring.score_file import read_statistics
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.work.machine import available_cores, processor_name
from lagbench.work.run import Meter, Progress

from .entry import Entry, today
from .models import ModelRuns, Runner, exit_code_of, name_seed
from .records import record_of
from .verified import (
    VERIFICATIONS,
    Level,
    MeasuredCost,
    Reproduction,
    Verification,
    empty_record,
    record,
    relative_difference,
)

TOLERANCE = 1e-3
"""Relative difference of the ranking metric, its mean over scenarios, up to which a
score counts as reproduced.
"""

SCORE_DIGITS = 9
DIFFERENCE_DIGITS = 2
TIME_DIGITS = 4

REPEATS = 3
"""Turns of every row whose time is measured."""

TIMED_FRAMES = 32
"""Frames of each turn: whole calls of models that predict up to 16 frames a call."""

BUSY = 0.25
"""Other running processes per core from which on costs are not recorded."""

TimeSolver = Callable[[str, str], float | None]
"""From a split and size to the solver's processor time of a frame [s]."""


@dataclass(kw_only=True)
class ReproduceResult:
    """What came of running the models of entries again."""

    folder: Path
    # records by path of the entry, those of earlier runs among them
    lines: dict[str, Verification] = field(default_factory=dict)
    # predicted in this run, as in "cavity/mini/gns, seed 0"
    predicted: list[str] = field(default_factory=list)
    # whose costs were measured in this run, as in "cavity/mini/gns"
    measured: list[str] = field(default_factory=list)
    # by name of the entry, the first of each
    failures: dict[str, LagbenchError] = field(default_factory=dict)

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
        return {
            "folder": str(self.folder),
            "entries": lines,
            "predicted": self.predicted,
            "measured": self.measured,
            "differing": self.differing,
            "failures": {name: str(error) for name, error in self.failures.items()},
        }

    @property
    def exit_code(self) -> int:
        """0 where all scores agree, 1 where some differ, else that of a failure."""
        if self.differing:
            return ChecksFailedError.exit_code
        return exit_code_of(self.failures)


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

    Models with a record of as many scenarios are not run again, and entries with a cost
    are not timed again. Entries of one data set are timed together; no others are. If
    no entry is named, an error of one entry is kept in the result, and the other
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
        WorkFailedError: the machine is too busy to record costs, or the disk or the
            memory is full.
    """
    runs = ModelRuns.of(
        board, threads=threads, root=root, registry=registry, progress=progress
    )
    run = _Run(
        runs=runs,
        scenarios=scenarios,
        again=again,
        recording=recording,
        result=ReproduceResult(folder=runs.folder.path),
        raises=bool(entries),
    )
    chosen = runs.choose(entries, split=split, size=size)
    if scores:
        for entry in chosen:
            try:
                run.reproduce(entry)
            except LagbenchError as error:
                run.keep(entry, error)
    if costs:
        run.measure(chosen, time_solver)
    for entry in chosen:
        line = run.line_of(entry)
        if line is not None:
            run.result.lines[entry.yaml_path.as_posix()] = line
    return run.result


@dataclass(kw_only=True)
class _Run:
    """One run of the command: its choices, and what it has loaded."""

    runs: ModelRuns
    scenarios: int | None
    again: bool
    recording: bool
    result: ReproduceResult
    raises: bool  # whether errors of an entry end the run
    _tasks: dict[tuple[str, str], ScoredTask] = field(default_factory=dict)
    # records that are not written where the run records nothing
    _lines: dict[str, Verification] = field(default_factory=dict)

    def line_of(self, entry: Entry) -> Verification | None:
        """Return the record of an entry: of this run, else the written one."""
        line = self._lines.get(entry.yaml_path.as_posix())
        if line is None:
            line = record_of(entry, VERIFICATIONS.read(self.runs.folder))
        return line

    def keep(self, entry: Entry, error: LagbenchError) -> None:
        """Keep the first error of an entry, or raise it."""
        if self.raises:
            raise error
        self.result.failures.setdefault("/".join(entry.place), error)

    def _task(self, entry: Entry) -> ScoredTask:
        key = (entry.split, entry.size)
        if key not in self._tasks:
            self._tasks[key] = load_scored_task(self.runs.size(entry), self.runs.root)
        return self._tasks[key]

    def _change(
        self, entry: Entry, change: Callable[[Verification], Verification]
    ) -> None:
        """Change the record of an entry; without recording only in memory."""
        if self.recording:
            record(self.runs.folder, entry, change)
        else:
            line = self.line_of(entry) or empty_record(entry)
            self._lines[entry.yaml_path.as_posix()] = change(line)

    def reproduce(self, entry: Entry) -> None:
        """Predict with every model of an entry, and record how the scores compare."""
        models = [one for one in entry.predictions if one.weights is not None]
        for prediction, score_path in zip(
            entry.predictions, entry.score_paths, strict=True
        ):
            if prediction.weights is None:
                continue
            task = self._task(entry)
            chosen = sample_scenarios(
                task.scenarios, prediction.weights.sha256, self.scenarios
            )
            line = self.line_of(entry)
            if line is not None and not self.again:
                recorded = {one.seed: one.scenarios for one in line.reproduced}
                if recorded.get(prediction.seed, 0) >= len(chosen):
                    continue
            stored = read_statistics(self.runs.folder.path / score_path)
            reproduction = compare(
                entry.score.ranking_metric,
                {scenario: stored.tallies[scenario] for scenario in chosen},
                self.runs.tallies(entry, prediction, task, chosen),
                seed=prediction.seed,
                model=prediction.weights.sha256,
                of=len(task.scenarios),
            )
            self._change(
                entry,
                partial(
                    with_reproduction, reproduction=reproduction, models=len(models)
                ),
            )
            self.result.predicted.append(name_seed(entry, prediction))

    def measure(self, entries: Sequence[Entry], time_solver: TimeSolver | None) -> None:
        """Measure what a frame costs the models of entries, by data set."""
        groups: dict[tuple[str, str], list[Entry]] = {}
        for entry in entries:
            line = self.line_of(entry)
            if self.again or line is None or line.cost is None:
                groups.setdefault((entry.split, entry.size), []).append(entry)
        for group in groups.values():
            if self.recording:
                require_idle_machine()
            with ExitStack() as opened:
                runners = {}
                for entry in group:
                    first = next(one for one in entry.predictions if one.weights)
                    try:
                        runner = self.runs.open(entry, first)
                    except LagbenchError as error:
                        self.keep(entry, error)
                        continue
                    opened.callback(runner.close)
                    runners[entry.method] = runner
                if not runners:
                    continue
                try:
                    costs = measure_costs(
                        runners,
                        self._task(group[0]),
                        root=self.runs.root,
                        time_solver=time_solver,
                        meter=self.runs.meter,
                    )
                except LagbenchError as error:
                    self.keep(group[0], error)
                    continue
            for entry in group:
                if entry.method in costs:
                    update = {"cost": costs[entry.method]}
                    self._change(entry, partial(Verification.model_copy, update=update))
                    self.result.measured.append("/".join(entry.place))


def sample_scenarios(
    scenarios: Collection[int], model_sha256: str, count: int | None
) -> tuple[int, ...]:
    """Return the scenarios to predict anew, ascending.

    A sample follows from the model, so it is the same in every run.
    """
    if count is None or count >= len(scenarios):
        return tuple(sorted(scenarios))

    def digest(scenario: int) -> bytes:
        return hashlib.sha256(f"{model_sha256} {scenario}".encode()).digest()

    return tuple(sorted(sorted(scenarios, key=digest)[:count]))


def compare(
    metric: str,
    submitted: Mapping[int, Tally],
    reproduced: Mapping[int, Tally],
    *,
    seed: int | None,
    model: str,
    of: int,
) -> Reproduction:
    """Return how a metric of the same scenarios compares.

    Raises:
        ChecksFailedError: one side has no value.
    """
    before = score(METRICS[metric], submitted)
    after = score(METRICS[metric], reproduced)
    if before is None or after is None:
        raise ChecksFailedError(f"{metric} has no value in some scenario")
    differences = []
    for submitted_value, value in zip(before.values, after.values, strict=True):
        differences.append(relative_difference(submitted_value, value))
    difference = relative_difference(before.mean, after.mean)
    return Reproduction(
        seed=seed,
        model=model,
        metric=metric,
        scenarios=len(reproduced),
        of=of,
        submitted=round_digits(before.mean, SCORE_DIGITS),
        reproduced=round_digits(after.mean, SCORE_DIGITS),
        difference=round_digits(difference, DIFFERENCE_DIGITS),
        tolerance=TOLERANCE,
        greatest=round_digits(float(np.max(differences)), DIFFERENCE_DIGITS),
    )


def with_reproduction(
    line: Verification, reproduction: Reproduction, *, models: int
) -> Verification:
    """Return a record with one more reproduction, at the level that follows.

    Args:
        line: the record of an entry.
        reproduction: the result of one of its models.
        models: number of models of the entry.
    """
    others = [one for one in line.reproduced if one.seed != reproduction.seed]
    reproduced = sorted([*others, reproduction], key=lambda one: one.seed or 0)
    level = line.level
    if len(reproduced) == models and all(one.agrees for one in reproduced):
        level = Level.REPRODUCED
    elif level is Level.REPRODUCED:
        level = Level.AS_SUBMITTED
    return line.model_copy(update={"reproduced": tuple(reproduced), "level": level})


def require_idle_machine() -> None:
    """Refuse to record costs beside other work, which makes them longer.

    Raises:
        WorkFailedError: other processes run.
    """
    others = os.getloadavg()[0] - 1.0  # this process was at work until now
    if others > BUSY * available_cores():
        raise WorkFailedError(
            f"the machine is busy (load {others:.1f} beside this process), so costs "
            "would be wrong; wait, or leave them out: --no-costs"
        )


def measure_costs(
    runners: Mapping[str, Runner],
    task: ScoredTask,
    *,
    root: Path,
    time_solver: TimeSolver | None,
    meter: Meter,
) -> dict[str, MeasuredCost]:
    """Return the cost of a frame by method: models of one data set in one run.

    Every row takes its turn in every repeat, on one core, and the least of the repeats
    counts: other work on the machine can only add. The times are processor times.

    Args:
        runners: models of one split and size, by method.
        task: the test subset of that data set; its first scenario is predicted.
        root: folder of all data sets.
        time_solver: function that returns the solver's time, None where the solver
            cannot run; None leaves it out.
        meter: counts the rows that are timed.
    """
    size = task.size
    first_scenario = task.scenarios[0]
    path = task.truth.path(first_scenario)
    with task.opened(first_scenario) as truth:
        given = given_in(truth.file, size, root)
    # those that read train take minutes, and lie in files of the package already
    references = [one for one in references_of(size) if not one.reads_train]
    frames = min(TIMED_FRAMES, task.config.horizon)

    times: dict[tuple[str, str], list[float]] = {}
    row_count = len(runners) + len(references) + 1
    meter.begin(
        f"costs of {size.split} {size.name}", total=row_count * REPEATS, scenarios=0
    )
    for _ in range(REPEATS):
        if time_solver is not None:
            seconds = time_solver(size.split, size.name)
            if seconds is not None:
                times.setdefault(("solver", ""), []).append(seconds)
        meter.count(1)
        for reference in references:
            # the median: a solver compiles its kernels before its first frame
            of_frames: list[float] = []
            list(
                itertools.islice(
                    time_frames(reference.predict(given), of_frames), frames
                )
            )
            seconds = float(np.median(of_frames))
            times.setdefault((reference.kind, reference.name), []).append(seconds)
            meter.count(1)
        for method, runner in runners.items():
            seconds = runner.time(path, frames)
            times.setdefault(("model", method), []).append(seconds)
            meter.count(1)

    least: dict[str, dict[str, float]] = {}
    for (kind, name), seconds_of_turns in times.items():
        seconds = max(round_digits(min(seconds_of_turns), TIME_DIGITS), 1e-7)
        least.setdefault(kind, {})[name] = seconds
    classical = {**least.get(Kind.CLASSICAL, {}), **least.get(Kind.CALIBRATED, {})}
    costs = {}
    for method, seconds in least["model"].items():
        costs[method] = MeasuredCost(
            machine=f"{processor_name()}, 1 thread",
            date=today(),
            repeats=REPEATS,
            seconds_per_frame=seconds,
            solver=least.get("solver", {}).get(""),
            classical=classical,
            naive=least.get(Kind.NAIVE, {}),
        )
    return costs
