"""How a prediction's error moves from frame to frame: evidence for the flags.

An honest rollout builds on its own last frame, so its error e(f) = x_pred(f) - x_true(f)
carries over; a prediction that was put together from the truth leaves other traces.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from .grid import counted_nodes
from .metrics import FramePair, Scenario

__all__ = ["SHIFTS", "Trace", "Tracer"]

Floats = NDArray[np.float64]

SHIFTS = (-2, -1, 1, 2)
"""Frames by which the truth is shifted against the prediction."""


@dataclass(frozen=True, eq=False)
class Trace:
    """Means over particles and components, at each predicted frame of one scenario.

    Attributes:
        error: ``e(f)^2`` [length^2], shape [frame].
        overlap: ``e(f) e(f-1)`` [length^2], NaN at the first frame, shape [frame].
        motion: ``u_true(f)^2`` [length^2/frame^2], shape [frame].
        predicted_motion: ``u_pred(f)^2`` [length^2/frame^2], shape [frame].
        shifted: ``(x_pred(f) - x_true(f+s))^2`` by shift s [length^2], NaN where frame f+s is
            not predicted yet nor given, shape [frame].
        occupancy: nodes that the prediction fills over those that the truth fills [1], shape
            [frame].
        outside: share of particles outside the unit box [1], shape [frame].
    """

    error: Floats
    overlap: Floats
    motion: Floats
    predicted_motion: Floats
    shifted: Mapping[int, Floats]
    occupancy: Floats
    outside: Floats

    def __reduce__(self) -> tuple[object, ...]:
        """Cross process borders, which a mapping proxy does not."""
        first = (self.error, self.overlap, self.motion, self.predicted_motion)
        return Trace, (*first, dict(self.shifted), self.occupancy, self.outside)


class Tracer:
    """Collects the trace of one scenario, frame pair by frame pair.

    Args:
        scenario: the scenario; its given frames count as true history.
    """

    def __init__(self, scenario: Scenario) -> None:
        frames = scenario.setting.horizon
        self._first = scenario.setting.input_frames
        self._true = deque(np.asarray(scenario.given[-2:], np.float64), maxlen=max(SHIFTS))
        self._predicted: deque[Floats] = deque(maxlen=max(SHIFTS))
        self._error: Floats | None = None
        names = ("error", "overlap", "motion", "predicted_motion", "occupancy", "outside")
        self._series = {name: np.full(frames, np.nan) for name in names}
        self._shifted = {shift: np.full(frames, np.nan) for shift in SHIFTS}

    def add(self, pair: FramePair) -> None:
        """Take in the next frame."""
        i = pair.frame - self._first
        true, predicted, error = pair.truth.position, pair.prediction.position, pair.position_error
        series = self._series
        series["error"][i] = np.mean(error**2)
        if self._error is not None:
            series["overlap"][i] = np.mean(error * self._error)
        series["motion"][i] = np.mean(pair.truth.velocity**2)
        series["predicted_motion"][i] = np.mean(pair.prediction.velocity**2)
        series["occupancy"][i] = _occupancy(pair)
        series["outside"][i] = np.mean(((predicted < 0.0) | (predicted > 1.0)).any(axis=1))
        for back, earlier in enumerate(reversed(self._true), start=1):
            self._shifted[-back][i] = np.mean((predicted - earlier) ** 2)
        for back, earlier in enumerate(reversed(self._predicted), start=1):
            self._shifted[back][i - back] = np.mean((earlier - true) ** 2)
        self._true.append(true)
        self._predicted.append(predicted)
        self._error = error

    def result(self) -> Trace:
        """Return what was collected."""
        return Trace(**self._series, shifted=MappingProxyType(self._shifted))


def _occupancy(pair: FramePair) -> float:
    filled = counted_nodes(pair.prediction.fields.weight, pair.scenario.full)
    true = int(np.count_nonzero(pair.truth.fields.counted))
    return int(np.count_nonzero(filled)) / max(1, true)
