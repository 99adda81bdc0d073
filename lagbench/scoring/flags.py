"""Flags: what a reader of a score should know. They reject nothing.

``copy_suspect``: the error moves from frame to frame as that of no rollout does.
``below_twin_floor``: closer to the truth than the solver itself after a nudge of 2^-20.
``physics``: kinetic energy or filled area far from the truth's.

The thresholds lie between what honest predictions of our own splits show and what those
made from the truth do: ``python benchmarks/flag_calibration.py`` prints both,
docs/scoring.md has its table.

How a prediction's error moves from frame to frame: evidence for the flags.

An honest rollout builds on its own last frame, so its error e(f) = x_pred(f) -
x_true(f) carries over; a prediction that was put together from the truth leaves other
traces.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.data.grid import counted_nodes
from lagbench.metrics.frame import FramePair, Scenario, average, dot, mean_square
from lagbench.metrics.metric import mean, quotient

Floats = NDArray[np.float64]

SHIFTS = (-2, -1, 1, 2)
"""Frames by which the truth is shifted against the prediction."""


@dataclass(frozen=True, eq=False)
class Trace:
    """Means over particles and components, at each predicted frame of one scenario."""

    error: Floats  # e(f)^2 [length^2], shape [frame]
    overlap: Floats  # e(f) e(f-1) [length^2], NaN at the first frame, shape [frame]
    motion: Floats  # u_true(f)^2 [length^2/frame^2], shape [frame]
    predicted_motion: Floats  # u_pred(f)^2 [length^2/frame^2], shape [frame]
    # (x_pred(f) - x_true(f+s))^2 by shift s [length^2], NaN where frame f+s is not
    # predicted yet nor given, shape [frame]
    shifted: Mapping[int, Floats]
    # nodes that the prediction fills over those that the truth fills [1], shape [frame]
    occupancy: Floats
    outside: Floats  # share of particles past a wall [1], shape [frame]


class Tracer:
    """Collects the trace of one scenario, frame pair by frame pair."""

    def __init__(self, scenario: Scenario) -> None:
        frames = scenario.setting.horizon
        self._first = scenario.setting.input_frames
        self._true = deque(
            np.asarray(scenario.given[-2:], np.float64), maxlen=max(SHIFTS)
        )
        self._predicted: deque[Floats] = deque(maxlen=max(SHIFTS))
        self._error: Floats | None = None
        names = (
            "error",
            "overlap",
            "motion",
            "predicted_motion",
            "occupancy",
            "outside",
        )
        self._series = {name: np.full(frames, np.nan) for name in names}
        self._shifted = {shift: np.full(frames, np.nan) for shift in SHIFTS}

    def add(self, pair: FramePair) -> None:
        """Take in the next frame."""
        i = pair.frame - self._first
        true = pair.truth.position
        predicted = pair.prediction.position
        error = pair.position_error
        series = self._series
        series["error"][i] = average(pair.position_square)
        if self._error is not None:
            series["overlap"][i] = sum(map(dot, error.T, self._error.T)) / error.size
        series["motion"][i] = pair.truth.speed_square / error.size
        series["predicted_motion"][i] = pair.prediction.speed_square / error.size
        filled = counted_nodes(pair.prediction.fields.weight, pair.scenario.full)
        full = max(1, int(np.count_nonzero(pair.truth.fields.counted)))
        series["occupancy"][i] = int(np.count_nonzero(filled)) / full
        series["outside"][i] = pair.outside
        for back, earlier in enumerate(reversed(self._true), start=1):
            self._shifted[-back][i] = average(mean_square(predicted - earlier))
        for back, earlier in enumerate(reversed(self._predicted), start=1):
            self._shifted[back][i - back] = average(mean_square(earlier - true))
        self._true.append(true)
        self._predicted.append(predicted)
        self._error = error

    def result(self) -> Trace:
        """Return what was collected."""
        return Trace(**self._series, shifted=self._shifted)


AUTOCORRELATION = 0.5
"""Below this the error of a frame has too little to do with that of the frame before.
"""

DROP = 0.5
"""An error that falls to less than this share within one frame was reset to the truth.
"""

SHIFT_GAIN = 0.25
"""When a shift in time leaves less than this share of the error, the truth was shifted.
"""

GROWTH = 2.0
"""An error within one frame's motion that grows by less than this does not accumulate.
"""

ENERGY = (0.1, 10.0)
"""Kinetic energy relative to the truth's outside of which ``physics`` is raised."""

OCCUPANCY = (0.5, 1.5)
"""Filled area relative to the truth's outside of which ``physics`` is raised."""

TWIN_REGULAR = 0.1
"""The twin floor counts while it is below this share of the RMSE of persistence."""

ROUNDING = 2.0**-20
"""Errors below this are those of numbers, not of models [length]."""


@dataclass(frozen=True, kw_only=True)
class Flag:
    """One flag of a submission."""

    name: str
    raised: bool | None  # whether it is raised; None where that cannot be told
    reasons: tuple[str, ...]  # why, one clause each
    evidence: Mapping[str, float]  # the numbers behind it


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the error of one scenario does from frame to frame; NaN where it is 0."""

    autocorrelation: float  # mean over frames of the cosine between e(f) and e(f-1) [1]
    drop: float  # least ratio of the RMS errors of two consecutive frames [1]
    shift: int  # shift of the truth that fits the prediction best [frame]
    # RMS error at that shift over the RMS error without it, same frames [1]
    shift_gain: float
    # RMS error of the last quarter of the frames over that of the first frame [1]
    growth: float
    # largest RMS error over the RMS of the truth's per-frame displacement [1]
    steps: float
    exact: int  # frames in which the truth moves and the error is 0


def evidence(trace: Trace) -> Evidence:
    """Return what the error of one scenario does from frame to frame."""
    before = trace.error[:-1]
    error = trace.error[1:]
    told = before > ROUNDING**2
    cosine = quotient(trace.overlap[1:], np.sqrt(error * before))[told]
    fall = np.sqrt(quotient(error, before))[told]
    quarter = max(1, len(trace.error) // 4)
    gains = {0: 1.0}
    for shift, shifted in trace.shifted.items():
        known = ~np.isnan(shifted)
        gains[shift] = _root_ratio(
            float(np.sum(shifted[known])), float(np.sum(trace.error[known]))
        )
    best = min(
        gains, key=lambda shift: math.inf if math.isnan(gains[shift]) else gains[shift]
    )
    return Evidence(
        autocorrelation=mean(cosine),
        drop=float(np.min(fall)) if fall.size else math.nan,
        shift=best,
        shift_gain=gains[best],
        growth=_root_ratio(
            float(np.mean(trace.error[-quarter:])), float(trace.error[0])
        ),
        steps=_root_ratio(float(np.max(trace.error)), float(np.mean(trace.motion))),
        exact=int(np.count_nonzero((trace.error == 0.0) & (trace.motion > 0.0))),
    )


def copy_suspect(traces: Sequence[Trace]) -> Flag:
    """Judge whether a prediction was put together from the truth; one such scenario is
    enough.

    A constant offset beyond a frame's motion, or a share of the truth mixed into a
    rollout, is not seen.
    """
    found = [evidence(trace) for trace in traces]
    exact = sum(e.exact for e in found)
    best = min(found, key=lambda e: e.shift_gain)
    told = {
        f"{exact} predicted frames are the truth, bit for bit": exact > 0,
        "the error of a frame does not follow from that of the frame before": any(
            e.autocorrelation < AUTOCORRELATION for e in found
        ),
        "the error drops within one frame": any(e.drop < DROP for e in found),
        "a shift in time removes most of the error": any(
            e.shift_gain < SHIFT_GAIN for e in found
        ),
        "the error stays within one frame's motion and does not accumulate": any(
            e.growth < GROWTH and e.steps < 1.0 for e in found
        ),
    }
    numbers = {
        "exact_frames": float(exact),
        "error_autocorrelation": _least(e.autocorrelation for e in found),
        "error_drop": _least(e.drop for e in found),
        "best_shift": float(best.shift),
        "shift_gain": best.shift_gain,
        "error_growth": _least(e.growth for e in found),
        "error_in_steps": max(e.steps for e in found),
    }
    return _flag("copy_suspect", told, numbers)


def _flag(name: str, told: Mapping[str, bool], numbers: Mapping[str, float]) -> Flag:
    """Return a flag that is raised for what is true of the reasons."""
    reasons = tuple(reason for reason, holds in told.items() if holds)
    return Flag(name=name, raised=bool(reasons), reasons=reasons, evidence=numbers)


def below_twin_floor(
    error: Floats, persistence: Floats, floor: Sequence[float]
) -> Flag:
    """Judge whether a prediction is closer to the truth than the nudged twin of the
    solver.

    Where the twin has lost its way itself (its RMSE has come near that of persistence),
    a cautious prediction may be closer than it; such frames do not count. All are
    position RMSE per predicted frame, mean over scenarios [length], shape [frame]; the
    floor is empty where it is not recorded.
    """
    name = "below_twin_floor"
    if len(floor) != len(error):
        return Flag(
            name=name, raised=None, reasons=("no twin floor is recorded",), evidence={}
        )
    twin = np.asarray(floor, np.float64)
    regular = twin < TWIN_REGULAR * persistence
    count = int(np.count_nonzero(regular & (error < twin)))
    numbers = {
        "frames_below": float(count),
        "frames_compared": float(np.count_nonzero(regular)),
    }
    return _flag(
        name,
        {f"{count} frames are closer to the truth than the solver's twin": count > 0},
        numbers,
    )


def physics(traces: Sequence[Trace]) -> Flag:
    """Judge whether energy and filled area stay near the truth's."""
    energy = _ratio(
        sum(np.sum(t.predicted_motion) for t in traces),
        sum(np.sum(t.motion) for t in traces),
    )
    occupancy = float(np.mean([np.mean(t.occupancy) for t in traces]))
    outside = float(np.mean([np.mean(t.outside) for t in traces]))
    told = {
        f"{energy:.2g} times the truth's kinetic energy": energy < ENERGY[0]
        or energy > ENERGY[1],
        f"the particles fill {occupancy:.2g} times the truth's area": occupancy
        < OCCUPANCY[0]
        or occupancy > OCCUPANCY[1],
    }
    return _flag(
        "physics", told, {"energy": energy, "occupancy": occupancy, "outside": outside}
    )


def _least(values: Iterable[float]) -> float:
    return min((v for v in values if not math.isnan(v)), default=math.nan)


def _ratio(numerator: float, denominator: float) -> float:
    """Return the quotient of two numbers >= 0, NaN where the second is 0."""
    if denominator > 0.0:
        return float(numerator) / float(denominator)
    return math.nan


def _root_ratio(numerator: float, denominator: float) -> float:
    return math.sqrt(_ratio(numerator, denominator))
