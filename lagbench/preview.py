"""The few pictures of a submission that a board page draws, taken while it is scored."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .metrics import FramePair, Scenario
from .metrics.distributions import BINS, histograms

__all__ = ["FRAMES", "PARTICLES", "Photographer", "Preview"]

FRAMES = 45
"""Frames of the particle film, evenly spaced over the horizon."""

PARTICLES = 200
"""Particles of the film, evenly spaced over the particle numbers."""


@dataclass(frozen=True, eq=False)
class Preview:
    """Pictures of one scenario; index 0 of ``side`` is the truth, 1 the prediction.

    Attributes:
        scenario: id of the scenario.
        map_frames: frames of interest and the last one.
        vorticity: at the compared nodes, NaN elsewhere [1/frame], shape [side, map frame,
            x node, y node].
        histogram: shares of 64 bins over the truth's range of omega, NaN where there is none
            [1], shape [side, map frame, bin].
        histogram_range: that range [1/frame], shape [map frame, 2].
        film_frames: frames of the film.
        particles: numbers of the particles in the film.
        material: their materials, shape [film particle].
        film: their positions [length], shape [side, film frame, film particle, 2].
    """

    scenario: int
    map_frames: tuple[int, ...]
    vorticity: NDArray[np.float32]
    histogram: NDArray[np.float32]
    histogram_range: NDArray[np.float32]
    film_frames: tuple[int, ...]
    particles: tuple[int, ...]
    material: NDArray[np.int8]
    film: NDArray[np.float32]


class Photographer:
    """Takes the pictures of one scenario, frame pair by frame pair.

    Args:
        number: id of the scenario.
        scenario: the scenario.
    """

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
        shares = histograms(truth, prediction)
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
