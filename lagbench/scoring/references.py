"""The scores of floors: shipped with the package, or measured where they are not.

:func:`measure` is what the shipped ones come from
(``python -m lagbench.scoring.record``) and what they are checked against. A scenario
that is measured is kept under the root folder, so that an interrupted measurement goes
on where it stopped.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.atomic import atomic_path
from lagbench.data.registry import Registry, Size, load
from lagbench.metrics.aggregate import Tally, aggregate
from lagbench.metrics.frame import snapshots
from lagbench.metrics.table import select
from lagbench.references.predictor import ReferencePredictor, given_in
from lagbench.references.shipped import ReferenceScores, correlation_of, shipped
from lagbench.references.table import REFERENCES, references_of
from lagbench.work.pool import Report
from lagbench.work.progress import Meter, Progress
from lagbench.work.run import run_all

from .scenario import measure_rows, predicted_by
from .task import ScoredTask, load_scored_task

TOLERANCE = 1e-4
"""Relative difference up to which shipped and measured values are equal: libraries
round differently.
"""


def measurable(size: Size, root: Path) -> tuple[str, ...]:
    """Return the names of the floors that scoring measures where none are shipped:
    those that count.
    """
    return tuple(floor.name for floor in _possible(size, root) if floor.counts)


def _possible(size: Size, root: Path) -> list[ReferencePredictor]:
    """Return the floors of a size; what looks at train only where all of train is
    there.
    """
    trained = _has(size, root, "train")
    return [floor for floor in references_of(size) if trained or not floor.reads_train]


def _has(size: Size, root: Path, subset: str) -> bool:
    """Tell whether all files of a subset, which is not empty, are there."""
    ids = size.subsets.get(subset, ())
    return bool(ids) and all(size.path(root, i).is_file() for i in ids)


def measured_sizes(
    root: Path,
    *,
    split: str | None = None,
    name: str | None = None,
    registry: Registry | None = None,
) -> list[Size]:
    """Return the sizes of our splits whose test subset lies under a root, or those that
    are named.
    """
    described = registry or load()
    sizes = [
        described.size(one, tier)
        for one in ((split,) if split else described.splits)
        for tier in ((name,) if name else described.split(one).sizes)
    ]
    return [size for size in sizes if (split and name) or _has(size, root, "test")]


def measured_again(
    size: Size, root: Path, *, progress: Callable[[Progress], None] | None = None
) -> tuple[tuple[str, ...], dict[str, tuple[str, ...]]]:
    """Measure the shipped floors of a data set again: which were measured, and what
    differs in them.
    """
    names = tuple(floor.name for floor in _possible(size, root))
    known = {
        name: held for name, held in (shipped(size) or {}).items() if name in names
    }
    return names, differences(
        known, measure(size, root, floors=names, progress=progress)
    )


@dataclass(frozen=True, kw_only=True)
class ReferenceJob:
    """What a worker needs to measure the floors on one scenario."""

    task: ScoredTask  # the test subset
    scenario: int  # id of the scenario
    floors: tuple[str, ...]  # names of the floors
    metrics: tuple[str, ...]  # names of the metrics
    keep: Path | None = None  # file that holds the result once it is there


@dataclass(frozen=True, eq=False)
class ReferenceTallies:
    """What was measured of the floors on one scenario."""

    scenario: int  # id of the scenario
    tallies: Mapping[str, Tally]  # statistics by name of the floor
    # CPU time of the prediction, median over frames [s]
    seconds_per_frame: Mapping[str, float]


def measure_scenario(job: ReferenceJob, report: Report) -> ReferenceTallies:
    """Measure the floors on one scenario, or read what was measured before."""
    if job.keep is not None and job.keep.is_file():
        report(job.task.setting.horizon)
        return _kept(job, job.keep)
    seconds: dict[str, list[float]] = {name: [] for name in job.floors}
    with job.task.opened(job.scenario) as truth:
        given = given_in(truth.file, job.task.size, job.task.truth.root)
        rows = {
            name: snapshots(
                truth.scenario, _timed(predicted_by(REFERENCES[name], given), taken)
            )
            for name, taken in seconds.items()
        }
        tallies, _ = measure_rows(
            truth.scenario, truth.snapshots(), rows, select(job.metrics), report=report
        )
    medians = {name: float(np.median(taken)) for name, taken in seconds.items()}
    found = ReferenceTallies(job.scenario, tallies, medians)
    if job.keep is not None:
        _keep(found, job.keep)
    return found


def _timed(
    frames: Iterator[NDArray[np.float32]], seconds: list[float]
) -> Iterator[NDArray[np.float32]]:
    """Yield frames; add the CPU time that each took."""
    while True:
        start = time.process_time()
        frame = next(frames, None)
        if frame is None:
            return
        seconds.append(time.process_time() - start)
        yield frame


def _keep(found: ReferenceTallies, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    first, *_ = tallies = list(found.tallies.values())
    held: dict[str, Any] = {
        "floors": list(found.tallies),
        "names": first.names,
        "frames": first.frames,
    }
    held |= {
        part: [getattr(tally, part) for tally in tallies]
        for part in ("total", "weight", "undefined")
    }
    with atomic_path(path, option="--root") as temporary, open(temporary, "wb") as file:
        np.savez(file, **held, seconds_per_frame=list(found.seconds_per_frame.values()))


def _kept(job: ReferenceJob, path: Path) -> ReferenceTallies:
    with np.load(path, allow_pickle=False) as held:
        names = tuple(held["names"].tolist())
        frames = tuple(held["frames"].tolist())
        sums = zip(held["total"], held["weight"], held["undefined"], strict=True)
        floors = held["floors"].tolist()
        return ReferenceTallies(
            job.scenario,
            {
                name: Tally(names, frames, *parts)
                for name, parts in zip(floors, sums, strict=True)
            },
            dict(zip(floors, held["seconds_per_frame"].tolist(), strict=True)),
        )


def kept_in(size: Size, root: Path) -> Path:
    """Return the folder in which an interrupted measurement of a data set is kept."""
    if size.measured:
        sha256 = size.measured.dataset_sha256
    else:
        sha256 = "unrecorded"
    return root / ".floors" / f"{size.split}-{size.name}-{sha256[:16]}"


def measure(
    size: Size,
    root: Path,
    *,
    floors: Collection[str] | None = None,
    workers: int = 1,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> dict[str, ReferenceScores]:
    """Return the scores of floors of a data set, by default all, those of single frames
    by scenario.

    The test subset must be there, and train for ``analog``. With ``resume`` what is
    measured is kept under the root, and what is kept there is taken.
    """
    task = load_scored_task(size, root)
    names = tuple(
        floor.name
        for floor in references_of(size)
        if floors is None or floor.name in floors
    )
    jobs = {
        f"floors on scenario {i}": ReferenceJob(
            task=task,
            scenario=i,
            floors=names,
            metrics=tuple(metric.name for metric in select()),
            keep=kept_in(size, root) / f"{i:04d}.npz" if resume else None,
        )
        for i in task.scenarios
    }
    meter = Meter(progress)
    meter.begin(
        "measuring floors", total=len(jobs) * task.setting.horizon, scenarios=len(jobs)
    )
    found = run_all(measure_scenario, jobs, workers=workers, report=meter.count)
    floors_scores = {}
    for name in names:
        scores = aggregate(
            select(), {held.scenario: held.tallies[name] for held in found}
        )
        floors_scores[name] = ReferenceScores(
            name=name,
            scores=scores,
            seconds_per_frame=float(
                np.median([held.seconds_per_frame[name] for held in found])
            ),
            correlation=correlation_of(scores),
        )
    return floors_scores


def differences(
    expected: Mapping[str, ReferenceScores], found: Mapping[str, ReferenceScores]
) -> dict[str, tuple[str, ...]]:
    """Return by floor the metrics whose values per scenario differ, those that one
    lacks included.
    """
    near = partial(np.allclose, rtol=TOLERANCE, atol=1e-12, equal_nan=True)
    unlike = {}
    for name in {**expected, **found}:
        one, two = (
            held[name].scores if name in held else {} for held in (expected, found)
        )
        unlike[name] = tuple(
            metric
            for metric in {**one, **two}
            if not (
                metric in one
                and metric in two
                and near(one[metric].values, two[metric].values)
            )
        )
    return {name: metrics for name, metrics in unlike.items() if metrics}
