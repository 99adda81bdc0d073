"""The scores of reference predictors: shipped with the package, or measured.

:func:`measure` produces the shipped ones
(``python -m lagbench.scoring.measure_references``), and they are checked against it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.local import check_contents
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import UsageError, suggest_name
from lagbench.metrics.aggregate import Tally, aggregate
from lagbench.metrics.frame import snapshots
from lagbench.metrics.table import METRICS, select
from lagbench.references.predictor import given_in
from lagbench.references.shipped import ReferenceScores, correlation_of
from lagbench.references.table import REFERENCES, references_of
from lagbench.store.copy import update_working_copy
from lagbench.work.executor import Report
from lagbench.work.run import Meter, Progress, run_all

from .task import ScoredTask, load_scored_task, measure_rows, predict_reference

TIMED_SCENARIOS = 2
"""Test scenarios on which the references are timed."""


def measurable(size: Size, root: Path) -> tuple[str, ...]:
    """Return the names of the references that scoring measures where none are shipped.

    These are the ones that count.
    """
    has_train = _has_files(size, root, "train")
    names = []
    for reference in references_of(size):
        if reference.counts and (has_train or not reference.reads_train):
            names.append(reference.name)
    return tuple(names)


def check_train(size: Size, root: Path, references: Collection[str]) -> None:
    """Fetch and hash train where a reference looks things up there.

    Raises:
        DataError: a scenario of train is not the recorded one.
    """
    if any(REFERENCES[name].reads_train for name in references):
        scenarios = size.subsets["train"]
        update_working_copy(size, root, scenarios)
        check_contents(size, root, scenarios)


def _has_files(size: Size, root: Path, subset: str) -> bool:
    """Return whether all files of a subset, which is not empty, are there."""
    ids = size.subsets.get(subset, ())
    return bool(ids) and all(size.path(root, i).is_file() for i in ids)


def sizes_with_test_files(
    root: Path,
    *,
    split: str | None = None,
    name: str | None = None,
    registry: Registry | None = None,
) -> list[Size]:
    """Return the sizes of our splits whose test subset lies under a root.

    Args:
        root: folder of all data sets.
        split: the only split.
        name: the only size; with a split it is returned whether its files are there or
            not.
        registry: the splits; ours when None.

    Raises:
        UsageError: there is no such split, or no such size.
    """
    if registry is None:
        registry = load()
    if split and name:
        return [registry.size(split, name)]
    sizes = []
    known = {size for one in registry.splits.values() for size in one.sizes}
    if name is not None and name not in known:
        raise UsageError(f"no size {name!r}; {suggest_name(name, known)}")
    for one_split in [split] if split else registry.splits:
        for one_name in registry.split(one_split).sizes:
            size = registry.size(one_split, one_name)
            if name in (None, one_name) and _has_files(size, root, "test"):
                sizes.append(size)
    return sizes


@dataclass(frozen=True, kw_only=True)
class ReferenceJob:
    """Input of a worker that measures the references on one scenario."""

    task: ScoredTask  # the subset that is scored
    scenario: int  # id of the scenario
    references: tuple[str, ...]  # their names


@dataclass(frozen=True, eq=False)
class ReferenceTallies:
    """Statistics of the references on one scenario."""

    scenario: int  # id of the scenario
    tallies: Mapping[str, Tally]  # statistics by name of the reference
    # CPU time of the prediction of each frame by name of the reference [s]
    seconds: Mapping[str, list[float]]


def measure_scenario(job: ReferenceJob, report: Report) -> ReferenceTallies:
    """Measure the references on one scenario."""
    seconds: dict[str, list[float]] = {name: [] for name in job.references}
    with job.task.opened(job.scenario) as truth:
        given = given_in(truth.file, job.task.size, job.task.truth.root)
        rows = {}
        for name in job.references:
            frames = predict_reference(REFERENCES[name], given)
            timed = time_frames(frames, seconds[name])
            rows[name] = snapshots(truth.scenario, timed)
        tallies, _ = measure_rows(
            truth.scenario,
            truth.snapshots(),
            rows,
            metrics=select(known=METRICS),
            report=report,
        )
    return ReferenceTallies(job.scenario, tallies, seconds)


def time_references(size: Size, root: Path) -> dict[str, float]:
    """Return the processor time of a frame by name of the reference [s].

    The median over the frames of the first test scenarios, one core, no scoring.
    """
    task = load_scored_task(size, root)
    seconds: dict[str, list[float]] = {}
    for scenario in task.scenarios[:TIMED_SCENARIOS]:
        with task.opened(scenario) as truth:
            given = given_in(truth.file, size, root)
        for reference in references_of(size):
            times = seconds.setdefault(reference.name, [])
            for _ in time_frames(predict_reference(reference, given), times):
                pass
    return {name: float(np.median(times)) for name, times in seconds.items()}


def time_frames(
    frames: Iterator[NDArray[np.float32]], seconds: list[float]
) -> Iterator[NDArray[np.float32]]:
    """Yield frames; append the CPU time of each to ``seconds`` [s]."""
    while True:
        start = time.process_time()
        frame = next(frames, None)
        if frame is None:
            return
        seconds.append(time.process_time() - start)
        yield frame


def measure(
    size: Size,
    root: Path,
    *,
    names: Collection[str] | None = None,
    workers: int = 1,
    progress: Callable[[Progress], None] | None = None,
) -> dict[str, ReferenceScores]:
    """Return the scores of references of a data set by name.

    The scored subset must be there, and train for those that look things up there; the
    values of both are hashed and compared with the recorded hashes.

    Args:
        size: the split and size, and the subset that it scores.
        root: folder of all data sets.
        names: names of the references; by default all.
        workers: worker processes.
        progress: called with the state of the work.
    """
    task = load_scored_task(size, root)
    metrics = select(known=METRICS)
    references = tuple(
        one.name for one in references_of(size) if names is None or one.name in names
    )
    check_train(size, root, references)
    jobs = {}
    for scenario in task.scenarios:
        jobs[f"references on scenario {scenario}"] = ReferenceJob(
            task=task, scenario=scenario, references=references
        )

    meter = Meter(progress)
    meter.begin(
        "measuring references",
        total=len(jobs) * task.config.horizon,
        scenarios=len(jobs),
    )
    results = run_all(measure_scenario, jobs, workers=workers, report=meter.count)

    measured = {}
    for name in references:
        tallies = {result.scenario: result.tallies[name] for result in results}
        scores = aggregate(metrics, tallies)
        medians = [np.median(result.seconds[name]) for result in results]
        measured[name] = ReferenceScores(
            name=name,
            scores=scores,
            seconds_per_frame=float(np.median(medians)),
            correlation=correlation_of(scores),
        )
    return measured
