"""Measure what a frame costs: models, our solver and reference predictors in one run.

Every row takes its turn in every repeat, on one core, and the least of the repeats
counts: other work on the machine can only add. The times are processor times, so
waiting does not count.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lagbench.data.checksums import round_digits
from lagbench.errors import LagbenchError
from lagbench.references.predictor import Given, Kind, ReferencePredictor, given_in
from lagbench.references.table import references_of
from lagbench.scoring.task import ScoredTask
from lagbench.work.machine import processor_name
from lagbench.work.run import Meter

from .entry import Entry, MeasuredCost
from .verified import today

REPEATS = 3
TIMED_FRAMES = 10
DIGITS = 4  # of a time

TimeSolver = Callable[[str, str], float | None]
"""From a split and size to the solver's processor time of a frame [s]."""


class Runner(Protocol):
    """A model that predicts scenarios one by one."""

    def predict(
        self, scenario_file: Path, frames: int | None = None
    ) -> NDArray[np.float32]:
        """Return positions of the next frames, [frame, particle, axis] [length]."""
        ...

    def time(self, scenario_file: Path, frames: int) -> float:
        """Return the processor time of a frame [s]."""
        ...

    def close(self) -> None:
        """Free what the model holds."""
        ...


@dataclass(frozen=True, kw_only=True)
class TimedEntry:
    """An entry with its model, ready to be timed."""

    entry: Entry
    runner: Runner


def measure_costs(
    timed: Sequence[TimedEntry],
    task: ScoredTask,
    *,
    root: Path,
    time_solver: TimeSolver | None,
    meter: Meter,
    keep_failure: Callable[[Entry, LagbenchError], None],
    repeats: int = REPEATS,
) -> list[tuple[Entry, MeasuredCost]]:
    """Return the cost of a frame for entries of one data set.

    An entry whose model fails has no cost. The solver has no time unless it ran in
    every repeat.

    Args:
        timed: entries of one split and size, with their models.
        task: the test subset of that data set; its first scenario is predicted.
        root: folder of all data sets.
        time_solver: function that returns the solver's time, None where the solver
            cannot run; None leaves it out.
        meter: counts the rows that are timed.
        keep_failure: receives an entry whose model fails, and the error.
        repeats: turns of every row.
    """
    size = task.size
    first_scenario = task.scenarios[0]
    path = task.truth.path(first_scenario)
    with task.opened(first_scenario) as truth:
        given = given_in(truth.file, size, root)
    # those that read train take minutes, and lie in files of the package already
    references = []
    for reference in references_of(size):
        if not reference.reads_train:
            references.append(reference)

    running = list(timed)
    rounds: list[dict[str, float]] = []
    row_count = len(timed) + len(references) + 1
    meter.begin(
        f"costs of {size.split} {size.name}", total=row_count * repeats, scenarios=0
    )
    for _ in range(repeats):
        seconds: dict[str, float] = {}
        if time_solver is not None:
            solver_seconds = time_solver(size.split, size.name)
            if solver_seconds is not None:
                seconds["solver"] = solver_seconds
        meter.count(1)
        for reference in references:
            seconds[f"reference {reference.name}"] = time_reference(reference, given)
            meter.count(1)
        frames = min(TIMED_FRAMES, task.config.horizon)
        for one in tuple(running):
            try:
                frame_seconds = one.runner.time(path, frames)
            except LagbenchError as error:
                keep_failure(one.entry, error)
                running.remove(one)
            else:
                seconds[f"model {one.entry.method}"] = frame_seconds
            meter.count(1)
        rounds.append(seconds)
        if not running:
            return []

    least = {}
    for name in rounds[-1]:
        times = [seconds[name] for seconds in rounds if name in seconds]
        if len(times) == len(rounds):
            least[name] = round_digits(min(times), DIGITS)
    kinds: dict[Kind, dict[str, float]] = {Kind.CLASSICAL: {}, Kind.NAIVE: {}}
    for reference in references:
        side = Kind.CLASSICAL if reference.kind.is_on_classical_side else Kind.NAIVE
        kinds[side][reference.name] = max(least[f"reference {reference.name}"], 1e-7)
    costs = []
    for one in running:
        cost = MeasuredCost(
            machine=describe_processor(),
            date=today(),
            repeats=repeats,
            seconds_per_frame=least[f"model {one.entry.method}"],
            solver=least.get("solver"),
            classical=kinds[Kind.CLASSICAL],
            naive=kinds[Kind.NAIVE],
        )
        costs.append((one.entry, cost))
    return costs


def time_reference(reference: ReferencePredictor, given: Given) -> float:
    """Return the processor time of a frame, mean over the first frames [s]."""
    started = time.process_time()
    frames = list(itertools.islice(reference.predict(given), TIMED_FRAMES))
    return (time.process_time() - started) / len(frames)


def describe_processor() -> str:
    """Return the processor and that one thread ran on it."""
    return f"{processor_name()}, 1 thread"
