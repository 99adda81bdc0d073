"""One scenario of a submission against the truth: the unit of work that is spread.

The truth's snapshots and fields are formed once for the submission and the floors
beside it; memory is that of a few frames, whatever the horizon.

The few pictures of a submission that a board page draws, taken while it is scored.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lagbench.metrics.aggregate import Tally, as_stored, measure
from lagbench.metrics.distributions import BINS, histograms
from lagbench.metrics.frame import FramePair, Scenario, Snapshot, snapshots
from lagbench.metrics.metric import Metric
from lagbench.metrics.table import select
from lagbench.references.predictor import (
    Given,
    Prediction,
    ReferencePredictor,
    given_in,
)
from lagbench.references.table import REFERENCES
from lagbench.store.copy import update_working_copy
from lagbench.submission.format import Anatomy
from lagbench.submission.predictions import open_predictions
from lagbench.work.pool import Report

from .card import FRAMES, PARTICLES, SUBMISSION, Preview
from .flags import Trace, Tracer
from .task import ScoredTask


class PreviewRecorder:
    """Takes the pictures of one scenario, its ``preview``, frame pair by frame pair."""

    def __init__(self, number: int, scenario: Scenario) -> None:
        frames = scenario.setting.predicted_frames
        setting = scenario.setting
        maps = tuple(sorted(setting.slow_frames.intersection(frames)))
        film_frames = _spaced(frames, FRAMES)
        particles = _spaced(range(len(scenario.material)), PARTICLES)
        shape = (2, len(maps), setting.grid.nodes, setting.grid.nodes)
        nan = np.float32(np.nan)
        self.preview = Preview(
            scenario=number,
            map_frames=maps,
            vorticity=np.full(shape, nan),
            histogram=np.full((*shape[:2], BINS), nan),
            histogram_range=np.full((shape[1], 2), nan),
            film_frames=film_frames,
            particles=particles,
            material=scenario.material[list(particles)].astype(np.int8),
            film=np.zeros((2, len(film_frames), len(particles), 2), np.float32),
        )

    def add(self, pair: FramePair) -> None:
        """Look at a frame; most are not pictured."""
        made = self.preview
        if pair.frame in made.film_frames:
            i = made.film_frames.index(pair.frame)
            shown = list(made.particles)
            made.film[0, i] = pair.truth.position[shown]
            made.film[1, i] = np.clip(pair.prediction.position[shown], -1e6, 1e6)
        if pair.frame in made.map_frames and pair.node_count:
            i = made.map_frames.index(pair.frame)
            truth = pair.true_vorticity
            prediction = pair.predicted_vorticity
            made.vorticity[0, i][pair.nodes] = truth
            made.vorticity[1, i][pair.nodes] = np.clip(prediction, -1e30, 1e30)
            if pair.truth_turns:
                shares = histograms(truth, prediction)
            else:
                shares = None
            if shares is not None:
                made.histogram[:, i] = shares
                made.histogram_range[i] = np.min(truth), np.max(truth)


def _spaced(numbers: range, count: int) -> tuple[int, ...]:
    """Return evenly spaced members of a range, first and last included; all if there
    are few.

    >>> _spaced(range(6, 16), 4)
    (6, 9, 12, 15)
    """
    if len(numbers) <= count:
        return tuple(numbers)
    return tuple(numbers[i * (len(numbers) - 1) // (count - 1)] for i in range(count))


@dataclass(frozen=True, kw_only=True)
class ScenarioJob:
    """What a worker needs to score one scenario."""

    task: ScoredTask  # the test subset
    scenario: int  # id of the scenario
    predictions: Path  # a predictions.nc that has been validated
    anatomy: Anatomy  # what its headers say
    metrics: tuple[str, ...]  # names of the metrics
    floors: tuple[str, ...] = ()  # names of the floors to measure beside it
    pictured: bool = False  # whether to take the preview


@dataclass(frozen=True, eq=False)
class ScenarioScores:
    """What was measured of one scenario."""

    scenario: int  # id of the scenario
    tallies: Mapping[str, Tally]  # statistics by row
    trace: Trace  # how the submission's error moves
    preview: Preview | None  # pictures, if they were asked for


# the search through installed packages takes as long as some frames
_selected = functools.cache(select)


def score_scenario(job: ScenarioJob, report: Report) -> ScenarioScores:
    """Score one scenario of a submission and of the floors that are to be measured."""
    number = job.scenario
    metrics = _selected(job.metrics)
    try:
        with (
            job.task.opened(number) as truth,
            open_predictions(job.predictions, checked=job.anatomy) as predictions,
        ):
            scenario = truth.scenario
            frames = (
                frame for _, block in predictions.blocks(number) for frame in block
            )
            rows = {SUBMISSION: snapshots(scenario, frames)}
            for name in job.floors:
                given = given_in(truth.file, job.task.size, job.task.truth.root)
                rows[name] = snapshots(scenario, predicted_by(REFERENCES[name], given))
            if job.pictured:
                photographer = PreviewRecorder(number, scenario)
            else:
                photographer = None
            tallies, trace = measure_rows(
                scenario, truth.snapshots(), rows, metrics, photographer, report
            )
    except Exception as error:
        # beside what a package's metric or our own code raises there
        error.add_note(f"scenario {number}")
        raise
    return ScenarioScores(
        number, tallies, trace, photographer.preview if photographer else None
    )


def predicted_by(floor: ReferencePredictor, given: Given) -> Prediction:
    """Return what a floor predicts; what it reads of train is brought first."""
    if floor.reads_train:
        update_working_copy(given.size, given.root, given.size.subsets["train"])
    return floor.predict(given)


def measure_rows(
    scenario: Scenario,
    truth: Iterator[Snapshot],
    rows: Mapping[str, Iterator[Snapshot]],
    metrics: tuple[Metric, ...],
    photographer: PreviewRecorder | None = None,
    report: Report = lambda _: None,
) -> tuple[dict[str, Tally], Trace]:
    """Measure rows of predictions of one scenario side by side, frame by frame."""
    frames = scenario.setting.predicted_frames
    tracer = Tracer(scenario)
    first = next(iter(rows))
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
    tallies = {
        name: as_stored(Tally.of(names, frames, values))
        for name, values in measured.items()
    }
    return tallies, tracer.result()
