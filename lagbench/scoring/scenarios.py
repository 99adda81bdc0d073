"""Score the scenarios of a submission and of references, here or in workers."""

from __future__ import annotations

import itertools
import time
from collections.abc import Generator, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import LagbenchError
from lagbench.metrics.aggregate import Tally
from lagbench.metrics.frame import snapshots
from lagbench.metrics.metric import Metric
from lagbench.references.predictor import given_in
from lagbench.references.table import REFERENCES
from lagbench.submission.predictions import open_predictions
from lagbench.work.executor import Report
from lagbench.work.machine import available_cores, worker_count
from lagbench.work.run import Meter, run_all

from .flags import Trace
from .task import SUBMISSION, ScoredTask, measure_rows, predict_reference

WORTH_WORKERS = 1_000_000
"""Least particles times predicted frames for which worker processes are worth it."""


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


@dataclass(frozen=True, kw_only=True)
class ScenarioJob:
    """Input of a worker that scores one scenario."""

    task: ScoredTask
    scenario: int  # id of the scenario
    metrics: tuple[Metric, ...]
    predictions: Path | None  # a predictions.nc that has been validated
    references: tuple[str, ...]  # names of the references to measure


@dataclass(frozen=True, eq=False)
class ScenarioScores:
    """Result of a worker that scores one scenario."""

    scenario: int  # id of the scenario
    tallies: Mapping[str, Tally]  # statistics by row
    trace: Trace  # of the first row's error
    # processor time of the prediction of each frame by name of the reference [s]
    seconds: Mapping[str, list[float]]


def score_scenario(job: ScenarioJob, report: Report) -> ScenarioScores:
    """Score one scenario of a submission, if any, and of references."""
    number = job.scenario
    seconds: dict[str, list[float]] = {}
    rows = {}
    try:
        # where a metric fails, the traceback would keep files and predictions open
        with job.task.opened(number) as truth, ExitStack() as stack:
            if job.predictions is not None:
                opened = stack.enter_context(open_predictions(job.predictions))
                blocks = (block for _, block in opened.blocks(number))
                frames = itertools.chain.from_iterable(blocks)
                rows[SUBMISSION] = snapshots(truth.scenario, frames)
            for name in job.references:
                given = given_in(truth.file, job.task.size, job.task.truth.root)
                prediction = predict_reference(REFERENCES[name], given)
                if isinstance(prediction, Generator):
                    stack.callback(prediction.close)
                seconds[name] = []
                timed = time_frames(prediction, seconds[name])
                rows[name] = snapshots(truth.scenario, timed)
            tallies, trace = measure_rows(
                truth.scenario,
                truth.snapshots(),
                rows,
                metrics=job.metrics,
                report=report,
            )
    except LagbenchError as error:
        error.add_note(f"scenario {number}")
        raise
    return ScenarioScores(number, tallies, trace, seconds)


def score_scenarios(
    task: ScoredTask,
    *,
    metrics: tuple[Metric, ...],
    predictions: Path | None = None,
    references: tuple[str, ...] = (),
    workers: int | None,
    scheduler: str | None = None,
    meter: Meter,
) -> list[ScenarioScores]:
    """Return the statistics of every scenario, by ascending id.

    Args:
        task: the test subset.
        metrics: the metrics to measure.
        predictions: a predictions.nc that has been validated.
        references: names of the references to measure.
        workers: worker processes; None: one per core where the work is worth it.
        scheduler: address of a Dask scheduler that takes the scenarios instead.
        meter: counts the frames.
    """
    jobs = {}
    for scenario in task.scenarios:
        jobs[f"scenario {scenario}"] = ScenarioJob(
            task=task,
            scenario=scenario,
            metrics=metrics,
            predictions=predictions,
            references=references,
        )

    frame_count = len(jobs) * task.config.horizon
    default = 1
    if frame_count * task.size.particles >= WORTH_WORKERS:
        default = available_cores()
    meter.begin("scoring", total=frame_count, scenarios=len(jobs))
    return run_all(
        score_scenario,
        jobs,
        workers=worker_count(workers, default=default),
        scheduler=scheduler,
        report=meter.count,
    )
