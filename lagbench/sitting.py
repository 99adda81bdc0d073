"""One scenario of a submission against the truth: the unit of work that is spread.

The truth's snapshots and fields are formed once for the submission and both floors; memory
is that of a few frames, whatever the horizon.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .exam import Exam
from .floors import FLOORS
from .metrics import FramePair, Metric, Scenario, Snapshot, Tally, measure, select, snapshots
from .pool import Report
from .preview import Photographer, Preview
from .submission import Predictions, open_predictions
from .trace import Trace, Tracer

__all__ = ["SUBMISSION", "Job", "Outcome", "as_stored", "sit", "sit_scenario"]

SUBMISSION = "submission"
"""Row of the submission; the floors have rows of their names."""

LARGEST = float(np.finfo(np.float32).max)

LONG_ROLLOUT = 100
"""Predicted frames beyond which statistics are rounded more coarsely than float32."""

LONG_BITS = 11
"""Significant bits of statistics of a long rollout: a relative error of 4.9e-4 at most."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """What a worker needs to score one scenario.

    Attributes:
        exam: the test subset.
        scenario: id of the scenario.
        predictions: a predictions.nc that has been validated.
        metrics: names of the metrics.
        pictured: whether to take the preview.
    """

    exam: Exam
    scenario: int
    predictions: Path
    metrics: tuple[str, ...]
    pictured: bool = False


@dataclass(frozen=True, eq=False)
class Outcome:
    """What was measured of one scenario.

    Attributes:
        scenario: id of the scenario.
        tallies: statistics by row.
        trace: how the submission's error moves.
        preview: pictures, if they were asked for.
    """

    scenario: int
    tallies: Mapping[str, Tally]
    trace: Trace
    preview: Preview | None


def sit_scenario(job: Job, report: Report) -> Outcome:
    """Score one scenario of a submission and of the floors.

    Args:
        job: what to score.
        report: told the frames done.

    Raises:
        DataError: the truth is damaged.
        UnreadableFileError: the predictions are.
    """
    metrics = select(job.metrics)
    with job.exam.opened(job.scenario) as truth, open_predictions(job.predictions) as predictions:
        scenario = truth.scenario
        rows = {SUBMISSION: _predicted(predictions, job.scenario, scenario)}
        rows |= {name: floor(scenario) for name, floor in FLOORS.items()}
        photographer = Photographer(job.scenario, scenario) if job.pictured else None
        tallies, trace = sit(scenario, truth.snapshots(), rows, metrics, photographer, report)
    return Outcome(job.scenario, tallies, trace, photographer.result() if photographer else None)


def sit(
    scenario: Scenario,
    truth: Iterator[Snapshot],
    rows: Mapping[str, Iterator[Snapshot]],
    metrics: tuple[Metric, ...],
    photographer: Photographer | None = None,
    report: Report = lambda _: None,
) -> tuple[dict[str, Tally], Trace]:
    """Measure rows of predictions of one scenario side by side, frame by frame.

    Args:
        scenario: the scenario.
        truth: true snapshots of the predicted frames.
        rows: predicted snapshots of the same frames, by row; the first is traced and pictured.
        metrics: metrics to measure.
        photographer: takes the preview.
        report: told the frames done.

    Returns:
        Tally of each row as it is stored, and the trace of the first row.
    """
    frames = scenario.setting.predicted_frames
    tracer, first = Tracer(scenario), next(iter(rows))
    measured: dict[str, dict[int, dict[str, float]]] = {name: {} for name in rows}
    for frame, true, *predicted in zip(frames, truth, *rows.values(), strict=True):
        for name, snapshot in zip(rows, predicted, strict=True):
            pair = FramePair(scenario, frame, true, snapshot)
            measured[name][frame] = measure(pair, metrics)
            if name == first:
                tracer.add(pair)
                if photographer:
                    photographer.add(pair)
        report(1)
    names = [m.name for m in metrics if m.statistic is not None]
    tallies = {name: as_stored(Tally.of(names, frames, values)) for name, values in measured.items()}
    return tallies, tracer.result()


def as_stored(tally: Tally) -> Tally:
    """Return a tally rounded as scores.nc holds it: to float32, of long rollouts to 11 bits.

    Scores are formed from rounded statistics, so that whoever aggregates scores.nc again gets
    the same digits. Long rollouts have so many frames that their float32 would not fit into a
    small file, and that rounding averages out. Beyond float32 a statistic saturates.
    """
    total = tally.total
    if len(tally.frames) > LONG_ROLLOUT:
        mantissa, exponent = np.frexp(total)
        total = np.ldexp(np.rint(np.ldexp(mantissa, LONG_BITS)), exponent - LONG_BITS)
    stored = np.clip(total, -LARGEST, LARGEST).astype(np.float32)
    return replace(tally, total=stored.astype(np.float64))


def _predicted(predictions: Predictions, number: int, scenario: Scenario) -> Iterator[Snapshot]:
    frames = (frame for _, block in predictions.blocks(number) for frame in block)
    return snapshots(scenario, frames)
