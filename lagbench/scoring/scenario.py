"""One scenario of a submission against the truth: the unit of work that is spread.

The truth's snapshots and fields are formed once for the submission and the floors beside it;
memory is that of a few frames, whatever the horizon.

The few pictures of a submission that a board page draws, taken while it is scored.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lagbench.floors.floor import Floor, Given, Prediction, given_in
from lagbench.floors.table import FLOORS
from lagbench.metrics.aggregate import Tally, as_stored, measure
from lagbench.metrics.distributions import BINS, histograms
from lagbench.metrics.frame import FramePair, Scenario, Snapshot, snapshots
from lagbench.metrics.metric import Metric
from lagbench.metrics.table import select
from lagbench.store.copy import bring
from lagbench.submission.format import Anatomy
from lagbench.submission.predictions import Predictions, open_predictions
from lagbench.work.pool import Report

from .card import FRAMES, PARTICLES, SUBMISSION, Preview
from .flags import Trace, Tracer
from .task import OpenScenario, ScoredTask


class PreviewRecorder:
    """Takes the pictures of one scenario, frame pair by frame pair."""

    def __init__(self, number: int, scenario: Scenario) -> None:
        setting = scenario.setting
        frames = setting.predicted_frames
        self._number, self._scenario = number, scenario
        self._maps = tuple(sorted(setting.slow_frames.intersection(frames)))
        self._film_frames = _spaced(frames, FRAMES)
        self._particles = _spaced(range(len(scenario.material)), PARTICLES)
        shape = (2, len(self._maps), setting.grid.nodes, setting.grid.nodes)
        self._vorticity = np.full(shape, np.nan, np.float32)
        self._histogram = np.full((*shape[:2], BINS), np.nan, np.float32)
        self._range = np.full((shape[1], 2), np.nan, np.float32)
        self._film = np.zeros((2, len(self._film_frames), len(self._particles), 2), np.float32)

    def add(self, pair: FramePair) -> None:
        """Look at a frame; most are not pictured."""
        if pair.frame in self._film_frames:
            shown = list(self._particles)
            i = self._film_frames.index(pair.frame)
            self._film[0, i] = pair.truth.position[shown]
            self._film[1, i] = np.clip(pair.prediction.position[shown], -1e6, 1e6)
        if pair.frame in self._maps and pair.node_count:
            self._map(self._maps.index(pair.frame), pair)

    def _map(self, i: int, pair: FramePair) -> None:
        truth, prediction = pair.true_vorticity, pair.predicted_vorticity
        self._vorticity[0, i][pair.nodes] = truth
        self._vorticity[1, i][pair.nodes] = np.clip(prediction, -1e30, 1e30)
        shares = histograms(truth, prediction) if pair.truth_turns else None
        if shares is not None:
            self._histogram[:, i] = shares
            self._range[i] = np.min(truth), np.max(truth)

    def result(self) -> Preview:
        """Return the pictures."""
        return Preview(
            scenario=self._number,
            map_frames=self._maps,
            vorticity=self._vorticity,
            histogram=self._histogram,
            histogram_range=self._range,
            film_frames=self._film_frames,
            particles=self._particles,
            material=self._scenario.material[list(self._particles)].astype(np.int8),
            film=self._film,
        )


def _spaced(numbers: range, count: int) -> tuple[int, ...]:
    """Return evenly spaced members of a range, first and last included; all if there are few.

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


_selected = functools.cache(select)  # the search through installed packages takes as long as some frames


def score_scenario(job: ScenarioJob, report: Report) -> ScenarioScores:
    """Score one scenario of a submission and of the floors that are to be measured."""
    metrics = _selected(job.metrics)
    with (
        _told_of(job.scenario),
        job.task.opened(job.scenario) as truth,
        open_predictions(job.predictions, checked=job.anatomy) as predictions,
    ):
        scenario = truth.scenario
        rows = {SUBMISSION: _predicted(predictions, job.scenario, scenario)}
        rows |= {name: floor_snapshots(name, truth, job.task) for name in job.floors}
        photographer = PreviewRecorder(job.scenario, scenario) if job.pictured else None
        tallies, trace = measure_rows(scenario, truth.snapshots(), rows, metrics, photographer, report)
    return ScenarioScores(job.scenario, tallies, trace, photographer.result() if photographer else None)


@contextmanager
def _told_of(scenario: int) -> Iterator[None]:
    """Name the scenario beside what a package's metric or our own code raises there."""
    try:
        yield
    except Exception as error:
        error.add_note(f"scenario {scenario}")
        raise


def floor_snapshots(name: str, truth: OpenScenario, task: ScoredTask) -> Iterator[Snapshot]:
    """Yield the snapshots that a floor predicts."""
    given = given_in(truth.file, task.size, task.truth.root)
    return snapshots(truth.scenario, predicted_by(FLOORS[name], given))


def predicted_by(floor: Floor, given: Given) -> Prediction:
    """Return what a floor predicts; what it reads of train is brought first."""
    if floor.reads_train:
        bring(given.size, given.root, given.size.subsets["train"])
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


def _predicted(predictions: Predictions, number: int, scenario: Scenario) -> Iterator[Snapshot]:
    frames = (frame for _, block in predictions.blocks(number) for frame in block)
    return snapshots(scenario, frames)
