"""Measure predictions of one scenario against the truth, frame by frame.

The truth's snapshots and fields are formed once for the submission and the references
beside it; memory is that of a few frames, whatever the horizon. The few pictures of a
submission that a board page shows, the preview, are taken while it is scored; their
packing in scores.nc is stated here too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics.aggregate import Tally, measure, round_statistics
from lagbench.metrics.distributions import BINS, histograms
from lagbench.metrics.frame import FramePair, Scenario, Snapshot
from lagbench.metrics.metric import Metric
from lagbench.references.predictor import (
    Given,
    Prediction,
    ReferencePredictor,
)
from lagbench.store.copy import update_working_copy
from lagbench.work.executor import Report

from .flags import Trace, Tracer

SUBMISSION = "submission"
"""Row of the submission; reference predictors have rows of their names."""

LAST_STEP = 65534
"""Greatest packed value of a preview."""

FILL_STEP = 65535
"""Packed value that marks a missing one."""

FILM_RANGE = (-0.5, 1.5)
"""Positions in the preview are clipped to this range [length]."""

FRAMES = 45
"""Frames of the particle film, evenly spaced over the horizon."""

PARTICLES = 200
"""Particles of the film, evenly spaced over the particle numbers."""

POSITION_LIMIT = 1e6
"""Positions in the film are clipped to this [length]."""

VORTICITY_LIMIT = 1e30
"""Vorticity in the maps is clipped to this [1/frame]."""


@dataclass(frozen=True, eq=False)
class Preview:
    """Pictures of one scenario; index 0 of ``side`` is the truth, 1 the prediction."""

    scenario: int  # id of the scenario
    map_frames: tuple[int, ...]  # frames of interest and the last one
    # at the compared nodes, NaN elsewhere [1/frame], shape [side, map frame, x node, y
    # node]
    vorticity: NDArray[np.float32]
    # shares of 64 bins over the truth's range of omega, NaN where there is none [1],
    # shape [side, map frame, bin]
    histogram: NDArray[np.float32]
    histogram_range: NDArray[np.float32]  # that range [1/frame], shape [map frame, 2]
    film_frames: tuple[int, ...]
    particles: tuple[int, ...]  # numbers of the particles in the film
    material: NDArray[np.int8]  # their materials, shape [film particle]
    # their positions [length], shape [side, film frame, film particle, axis]
    film: NDArray[np.float32]
    # centre and radius of a fixed obstacle [length], shape [axis + 1]; None without one
    obstacle: NDArray[np.float32] | None = None


class PreviewRecorder:
    """Takes the pictures of one scenario, its ``preview``, frame pair by frame pair."""

    def __init__(
        self,
        number: int,
        scenario: Scenario,
        *,
        obstacle: NDArray[np.float32] | None = None,
    ) -> None:
        config = scenario.config
        frames = config.predicted_frames
        map_frames = tuple(sorted(config.slow_frames.intersection(frames)))
        film_frames = tuple(frames[i] for i in spaced(len(frames), FRAMES))
        particles = tuple(spaced(len(scenario.material), PARTICLES))

        maps = (2, len(map_frames))
        nodes = config.grid.section.shape
        film = (2, len(film_frames), len(particles), config.box.dimension)
        nan = np.float32(np.nan)
        self.preview = Preview(
            scenario=number,
            map_frames=map_frames,
            vorticity=np.full((*maps, *nodes), nan),
            histogram=np.full((*maps, BINS), nan),
            histogram_range=np.full((len(map_frames), 2), nan),
            film_frames=film_frames,
            particles=particles,
            material=scenario.material[list(particles)].astype(np.int8),
            film=np.zeros(film, np.float32),
            obstacle=obstacle,
        )

    def add(self, pair: FramePair) -> None:
        """Take the pictures of a frame; most frames have none."""
        if pair.frame in self.preview.film_frames:
            self._add_to_film(pair)
        if pair.frame in self.preview.map_frames and pair.node_count:
            self._add_to_maps(pair)

    def _add_to_film(self, pair: FramePair) -> None:
        preview = self.preview
        i = preview.film_frames.index(pair.frame)
        particles = list(preview.particles)
        predicted = pair.prediction.position[particles]
        preview.film[0, i] = pair.truth.position[particles]
        preview.film[1, i] = np.clip(predicted, -POSITION_LIMIT, POSITION_LIMIT)

    def _add_to_maps(self, pair: FramePair) -> None:
        preview = self.preview
        i = preview.map_frames.index(pair.frame)
        truth = pair.true_vorticity
        prediction = pair.predicted_vorticity
        if pair.truth.fields.grid.dimension == 2:
            preview.vorticity[0, i][pair.nodes] = truth
            preview.vorticity[1, i][pair.nodes] = _clip_vorticity(prediction)
        else:
            section = pair.truth.fields.section
            predicted_section = pair.predicted_fields.section
            preview.vorticity[0, i] = section.vorticity
            preview.vorticity[1, i] = _clip_vorticity(predicted_section.vorticity)

        if not pair.truth_rotates:
            return
        distributions = histograms(truth, prediction)
        if distributions is not None:
            preview.histogram[:, i] = distributions
            preview.histogram_range[i] = (np.min(truth), np.max(truth))


def spaced(length: int, count: int) -> list[int]:
    """Return at most so many evenly spaced indices, first and last included.

    >>> spaced(10, 4), spaced(3, 5), spaced(7, 1)
    ([0, 3, 6, 9], [0, 1, 2], [6])
    """
    if length <= count:
        return list(range(length))
    last = length - 1
    if count == 1:
        return [last]
    indices = []
    for number in range(count):
        index = number * last // (count - 1)
        indices.append(index)
    return indices


def _clip_vorticity(vorticity: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.clip(vorticity, -VORTICITY_LIMIT, VORTICITY_LIMIT)


def predict_reference(reference: ReferencePredictor, given: Given) -> Prediction:
    """Return the prediction of a reference; train is fetched if it is read."""
    if reference.reads_train:
        update_working_copy(given.size, given.root, given.size.subsets["train"])
    return reference.predict(given)


def measure_rows(
    scenario: Scenario,
    truth: Iterator[Snapshot],
    rows: Mapping[str, Iterator[Snapshot]],
    *,
    metrics: tuple[Metric, ...],
    recorder: PreviewRecorder | None = None,
    report: Report = lambda _: None,
) -> tuple[dict[str, Tally], Trace]:
    """Measure rows of predictions of one scenario side by side, frame by frame.

    Returns:
        The rounded statistics by row, and the trace of the first row.
    """
    frames = scenario.config.predicted_frames
    tracer = Tracer(scenario)
    first = next(iter(rows))
    measured: dict[str, dict[int, dict[str, float]]] = {}
    for name in rows:
        measured[name] = {}

    for frame, true, *predicted in zip(frames, truth, *rows.values(), strict=True):
        for name, snapshot in zip(rows, predicted, strict=True):
            pair = FramePair(scenario, frame, true, snapshot)
            measured[name][frame] = measure(pair, metrics)
            if name == first:
                tracer.add(pair)
                if recorder is not None:
                    recorder.add(pair)
        report(1)

    names = []
    for metric in metrics:
        if metric.statistic is not None:
            names.append(metric.name)
    tallies = {}
    for name, values in measured.items():
        tallies[name] = round_statistics(Tally.of(names, frames, values))
    return tallies, tracer.result()
