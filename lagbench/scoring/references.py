"""The scores of reference predictors: shipped with the package, or measured.

:func:`measure` produces the shipped ones
(``python -m lagbench.scoring.measure_references``), and they are checked against it.
With ``resume`` each measured scenario is saved under the root folder, so that an
interrupted measurement continues where it stopped.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.data.layout import has_file
from lagbench.data.local import check_contents
from lagbench.data.registry import Registry, Size, load
from lagbench.metrics.aggregate import Score, Tally, aggregate
from lagbench.metrics.frame import snapshots
from lagbench.metrics.table import METRICS, select
from lagbench.references.predictor import ReferencePredictor, given_in
from lagbench.references.shipped import ReferenceScores, correlation_of
from lagbench.references.table import REFERENCES, references_of
from lagbench.store.copy import update_working_copy
from lagbench.work.executor import Report
from lagbench.work.run import Meter, Progress, run_all

from .scenario import measure_rows, predict_reference
from .task import ScoredTask, load_scored_task

TIMED_SCENARIOS = 2
"""Test scenarios on which the references are timed."""

TOLERANCE = 1e-4
"""Relative difference of equal values: libraries round differently."""


def measurable(size: Size, root: Path) -> tuple[str, ...]:
    """Return the names of the references that scoring measures where none are shipped.

    These are the ones that count.
    """
    references = _with_data(size, root)
    return tuple(reference.name for reference in references if reference.counts)


def check_train(size: Size, root: Path, references: Collection[str]) -> None:
    """Fetch and hash train where a reference looks things up there.

    Raises:
        DataError: a scenario of train is not the recorded one.
    """
    if any(REFERENCES[name].reads_train for name in references):
        scenarios = size.subsets["train"]
        update_working_copy(size, root, scenarios)
        check_contents(size, root, scenarios)


def _with_data(size: Size, root: Path) -> list[ReferencePredictor]:
    """Return the references of a size; those that read train only if it is there."""
    references = references_of(size)
    if _has_files(size, root, "train"):
        return list(references)
    usable_references = []
    for reference in references:
        if not reference.reads_train:
            usable_references.append(reference)
    return usable_references


def _has_files(size: Size, root: Path, subset: str) -> bool:
    """Return whether all files of a subset, which is not empty, are there."""
    ids = size.subsets.get(subset, ())
    return bool(ids) and all(has_file(size.path(root, i)) for i in ids)


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
        name: the only size, of the splits that have it; with a split it is returned
            whether its files are there or not.
        registry: the splits; ours when None.

    Raises:
        UsageError: there is no such split, or no such size.
    """
    if registry is None:
        registry = load()
    sizes = []
    for one_split in _choose_splits(registry, split, name):
        names = [name] if name else list(registry.split(one_split).sizes)
        for one_name in names:
            sizes.append(registry.size(one_split, one_name))
    if split and name:
        return sizes
    sizes_with_data = []
    for size in sizes:
        if _has_files(size, root, "test"):
            sizes_with_data.append(size)
    return sizes_with_data


def _choose_splits(
    registry: Registry, split: str | None, name: str | None
) -> list[str]:
    """Return the named split; else those that have a size of the name."""
    if split:
        return [split]
    every = list(registry.splits)
    if not name:
        return every
    chosen = []
    for one_split in every:
        if name in registry.split(one_split).sizes:
            chosen.append(one_split)
    # a name that no split has is refused where the first one is looked up
    return chosen or every


@dataclass(frozen=True, kw_only=True)
class ReferenceJob:
    """Input of a worker that measures the references on one scenario."""

    task: ScoredTask  # the subset that is scored
    scenario: int  # id of the scenario
    references: tuple[str, ...]  # their names
    metrics: tuple[str, ...]  # names of the metrics
    saved: Path | None = None  # file of the result of an earlier run, or for this one


@dataclass(frozen=True, eq=False)
class ReferenceTallies:
    """Statistics of the references on one scenario."""

    scenario: int  # id of the scenario
    tallies: Mapping[str, Tally]  # statistics by name of the reference
    # CPU time of the prediction, median over frames [s]
    seconds_per_frame: Mapping[str, float]


def measure_scenario(job: ReferenceJob, report: Report) -> ReferenceTallies:
    """Measure the references on one scenario, or read the result of an earlier run.

    A result of other references does not count.
    """
    if job.saved is not None and job.saved.is_file():
        earlier = _load(job.scenario, job.saved)
        if earlier.tallies.keys() == set(job.references):
            report(job.task.config.horizon)
            return earlier

    seconds: dict[str, list[float]] = {name: [] for name in job.references}
    with job.task.opened(job.scenario) as truth:
        given = given_in(truth.file, job.task.size, job.task.truth.root)
        rows = {}
        for name in job.references:
            frames = predict_reference(REFERENCES[name], given)
            timed = _time_frames(frames, seconds[name])
            rows[name] = snapshots(truth.scenario, timed)
        tallies, _ = measure_rows(
            truth.scenario,
            truth.snapshots(),
            rows,
            metrics=select(job.metrics),
            report=report,
        )

    medians = {}
    for name in seconds:
        medians[name] = float(np.median(seconds[name]))
    result = ReferenceTallies(job.scenario, tallies, medians)
    if job.saved is not None:
        _save(result, job.saved)
    return result


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
            for _ in _time_frames(predict_reference(reference, given), times):
                pass
    return {name: float(np.median(times)) for name, times in seconds.items()}


def _time_frames(
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


def _save(result: ReferenceTallies, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    tallies = list(result.tallies.values())
    with atomic_path(path, option="--root") as temporary, open(temporary, "wb") as file:
        np.savez(
            file,
            floors=list(result.tallies),
            names=tallies[0].names,
            frames=tallies[0].frames,
            total=[tally.total for tally in tallies],
            weight=[tally.weight for tally in tallies],
            undefined=[tally.undefined for tally in tallies],
            seconds_per_frame=list(result.seconds_per_frame.values()),
        )


def _load(scenario: int, path: Path) -> ReferenceTallies:
    with np.load(path, allow_pickle=False) as arrays:
        references = arrays["floors"].tolist()
        names = tuple(arrays["names"].tolist())
        frames = tuple(arrays["frames"].tolist())
        seconds = arrays["seconds_per_frame"].tolist()
        totals = arrays["total"]
        weights = arrays["weight"]
        undefined = arrays["undefined"]

    tallies = {}
    for i, reference in enumerate(references):
        tallies[reference] = Tally(names, frames, totals[i], weights[i], undefined[i])
    return ReferenceTallies(
        scenario, tallies, dict(zip(references, seconds, strict=True))
    )


def saved_folder(size: Size, root: Path) -> Path:
    """Return the folder in which an interrupted measurement of a data set is saved."""
    sha256 = "unrecorded"
    if size.measured:
        sha256 = size.measured.dataset_sha256
    name = f"{size.split}-{size.name}"
    if size.scored_subset != "test":
        name += f"-{size.scored_subset}"
    return root / ".floors" / f"{name}-{sha256[:16]}"


def measure(
    size: Size,
    root: Path,
    *,
    names: Collection[str] | None = None,
    workers: int = 1,
    resume: bool = False,
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
        resume: whether each scenario is saved under the root, and read if it was saved
            by an earlier run.
        progress: called with the state of the work.
    """
    task = load_scored_task(size, root)
    metrics = select(known=METRICS)
    names_to_measure = []
    for reference in references_of(size):
        if names is None or reference.name in names:
            names_to_measure.append(reference.name)
    references = tuple(names_to_measure)
    check_train(size, root, references)
    folder = saved_folder(size, root)
    jobs = {}
    for scenario in task.scenarios:
        saved = None
        if resume:
            saved = folder / f"{scenario:04d}.npz"
        jobs[f"references on scenario {scenario}"] = ReferenceJob(
            task=task,
            scenario=scenario,
            references=references,
            metrics=tuple(metric.name for metric in metrics),
            saved=saved,
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
        tallies = {}
        for result in results:
            tallies[result.scenario] = result.tallies[name]
        scores = aggregate(metrics, tallies)
        seconds = []
        for result in results:
            seconds.append(result.seconds_per_frame[name])
        measured[name] = ReferenceScores(
            name=name,
            scores=scores,
            seconds_per_frame=float(np.median(seconds)),
            correlation=correlation_of(scores),
        )
    return measured


def differences(
    expected: Mapping[str, ReferenceScores], measured: Mapping[str, ReferenceScores]
) -> dict[str, tuple[str, ...]]:
    """Return by reference the metrics whose values per scenario differ.

    A metric that only one of the two has differs.
    """
    unequal = {}
    for name in {**expected, **measured}:
        before = _scores_of(expected, name)
        after = _scores_of(measured, name)
        metrics = []
        for metric in {**before, **after}:
            if not _are_equal(before.get(metric), after.get(metric)):
                metrics.append(metric)
        if metrics:
            unequal[name] = tuple(metrics)
    return unequal


def _scores_of(
    references: Mapping[str, ReferenceScores], name: str
) -> Mapping[str, Score]:
    if name in references:
        return references[name].scores
    return {}


def _are_equal(before: Score | None, after: Score | None) -> bool:
    if before is None or after is None:
        return False
    return np.allclose(
        before.values, after.values, rtol=TOLERANCE, atol=1e-12, equal_nan=True
    )
