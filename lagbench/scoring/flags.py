"""Flags: hints for the reader of a score. They reject nothing.

``copy_suspect``: the error moves from frame to frame as that of no rollout does.
``below_twin_floor``: closer to the truth than the solver itself after a perturbation of
2^-20.
``physics``: kinetic energy, or filled area (in space, volume), far from the truth's.

The thresholds lie between honest predictions of our own splits and predictions made
from the truth: docs/scoring.md has the table.

An honest rollout builds on its own last frame, so its error e(f) = x_pred(f) -
x_true(f) carries over from frame to frame; a prediction that was put together from the
truth has an error that moves in other ways.
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

AUTOCORRELATION = 0.5
"""Least correlation of the errors of two consecutive frames of a rollout."""

DROP = 0.5
"""An error that falls below this share within one frame was reset to the truth."""

SHIFT_GAIN = 0.25
"""The truth was shifted if a shift in time leaves less than this share of the error."""

GROWTH = 2.0
"""An error within one frame's motion accumulates if it grows by at least this."""

ENERGY = (0.1, 10.0)
"""Range of kinetic energy over the truth's outside of which ``physics`` is raised."""

OCCUPANCY = (0.5, 1.5)
"""Range of filled area or volume over the truth's outside of which ``physics`` is
raised.
"""

REGULAR_SHARE = 0.1
"""The predictability limit counts below this share of the RMSE of persistence."""

ROUNDING = 2.0**-20
"""Errors below this are those of numbers, not of models [length]."""


@dataclass(frozen=True, eq=False)
class Trace:
    """Means over particles and components, at each predicted frame of one scenario."""

    error: Floats  # e(f)^2 [length^2], shape [frame]
    overlap: Floats  # e(f) e(f-1) [length^2], NaN at the first frame, shape [frame]
    motion: Floats  # u_true(f)^2 [length^2/frame^2], shape [frame]
    predicted_motion: Floats  # u_pred(f)^2 [length^2/frame^2], shape [frame]
    # (x_pred(f) - x_true(f+s))^2 by shift s [length^2], NaN where frame f+s is neither
    # an input frame nor predicted yet, shape [frame]
    shifted: Mapping[int, Floats]
    # nodes that the prediction fills over those that the truth fills [1], shape [frame]
    occupancy: Floats
    outside: Floats  # share of particles past a wall [1], shape [frame]


class Tracer:
    """Collects the trace of one scenario, frame pair by frame pair."""

    def __init__(self, scenario: Scenario) -> None:
        longest = max(SHIFTS)
        last_inputs = np.asarray(scenario.input_positions[-2:], np.float64)
        self._first = scenario.config.input_frames
        self._true = deque(last_inputs, maxlen=longest)
        self._predicted: deque[Floats] = deque(maxlen=longest)
        self._error: Floats | None = None

        def unknown() -> Floats:
            return np.full(scenario.config.horizon, np.nan)

        self.trace = Trace(
            error=unknown(),
            overlap=unknown(),
            motion=unknown(),
            predicted_motion=unknown(),
            shifted={shift: unknown() for shift in SHIFTS},
            occupancy=unknown(),
            outside=unknown(),
        )

    def add(self, pair: FramePair) -> None:
        """Add the next frame."""
        i = pair.frame - self._first
        trace = self.trace
        error = pair.position_error
        trace.error[i] = average(pair.position_square)
        if self._error is not None:
            trace.overlap[i] = sum(map(dot, error.T, self._error.T)) / error.size
        self._error = error
        trace.motion[i] = pair.truth.speed_square / error.size
        trace.predicted_motion[i] = pair.prediction.speed_square / error.size
        weight = pair.prediction.fields.weight
        is_filled = counted_nodes(weight, pair.scenario.full_weight)
        true_count = int(np.count_nonzero(pair.truth.fields.counted))
        trace.occupancy[i] = int(np.count_nonzero(is_filled)) / max(1, true_count)
        trace.outside[i] = pair.outside_share

        # the frame beside earlier ones, of truth and of prediction
        box = pair.scenario.config.box
        true = pair.truth.position
        predicted = pair.prediction.position
        for back, earlier in enumerate(reversed(self._true), start=1):
            way = box.displacement(earlier, predicted)
            trace.shifted[-back][i] = average(mean_square(way))
        for back, earlier in enumerate(reversed(self._predicted), start=1):
            way = box.displacement(true, earlier)
            trace.shifted[back][i - back] = average(mean_square(way))
        self._true.append(true)
        self._predicted.append(predicted)


@dataclass(frozen=True, kw_only=True)
class Flag:
    """One flag of a submission."""

    name: str
    raised: bool | None  # whether it is raised; None where that is unknown
    reasons: tuple[str, ...]  # why, one clause each
    evidence: Mapping[str, float]  # the numbers behind it


@dataclass(frozen=True, kw_only=True)
class ErrorDynamics:
    """Behaviour of the error of one scenario over the frames; NaN where it is 0."""

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


def analyse_error(trace: Trace) -> ErrorDynamics:
    """Return the behaviour of the error of one scenario over the frames."""
    before = trace.error[:-1]
    error = trace.error[1:]
    is_above_rounding = before > ROUNDING**2
    cosine = quotient(trace.overlap[1:], np.sqrt(error * before))[is_above_rounding]
    fall = np.sqrt(quotient(error, before))[is_above_rounding]
    best_shift = 0
    shift_gain = 1.0
    for shift, shifted in trace.shifted.items():
        is_known = ~np.isnan(shifted)
        shifted_error = float(np.sum(shifted[is_known]))
        gain = _root_ratio(shifted_error, float(np.sum(trace.error[is_known])))
        if gain < shift_gain:
            best_shift = shift
            shift_gain = gain
    quarter = max(1, len(trace.error) // 4)
    late_error = float(np.mean(trace.error[-quarter:]))
    is_exact = (trace.error == 0.0) & (trace.motion > 0.0)
    return ErrorDynamics(
        autocorrelation=mean(cosine),
        drop=float(np.min(fall)) if fall.size else math.nan,
        shift=best_shift,
        shift_gain=shift_gain,
        growth=_root_ratio(late_error, float(trace.error[0])),
        steps=_root_ratio(float(np.max(trace.error)), float(np.mean(trace.motion))),
        exact=int(np.count_nonzero(is_exact)),
    )


def judge_copying(traces: Sequence[Trace]) -> Flag:
    """Judge whether a prediction was put together from the truth.

    One such scenario is enough. A constant offset beyond a frame's motion, or a share
    of the truth mixed into a rollout, is not seen.
    """
    scenarios = [analyse_error(trace) for trace in traces]
    exact = sum(scenario.exact for scenario in scenarios)
    best = min(scenarios, key=lambda scenario: scenario.shift_gain)
    reasons = {
        f"predicted frames that are the truth, bit for bit: {exact}": exact > 0,
        "the error of a frame does not follow from that of the frame before": any(
            one.autocorrelation < AUTOCORRELATION for one in scenarios
        ),
        "the error drops within one frame": any(one.drop < DROP for one in scenarios),
        "a shift in time removes most of the error": best.shift_gain < SHIFT_GAIN,
        "the error stays within one frame's motion and does not accumulate": any(
            one.growth < GROWTH and one.steps < 1.0 for one in scenarios
        ),
    }
    evidence = {
        "exact_frames": float(exact),
        "error_autocorrelation": _least(one.autocorrelation for one in scenarios),
        "error_drop": _least(one.drop for one in scenarios),
        "best_shift": float(best.shift),
        "shift_gain": best.shift_gain,
        "error_growth": _least(one.growth for one in scenarios),
        "error_in_steps": max(one.steps for one in scenarios),
    }
    return _make_flag("copy_suspect", reasons, evidence)


def _make_flag(
    name: str, reasons: Mapping[str, bool], evidence: Mapping[str, float]
) -> Flag:
    """Return a flag that is raised if any of the reasons holds."""
    holding = tuple(reason for reason, holds in reasons.items() if holds)
    return Flag(name=name, raised=bool(holding), reasons=holding, evidence=evidence)


def judge_predictability(
    error: Floats, persistence: Floats, limit: Sequence[float]
) -> Flag:
    """Judge whether a prediction is closer to the truth than a perturbed solver run.

    Where the perturbed run itself has lost the truth (its RMSE has come near that of
    persistence), a cautious prediction may be closer; such frames do not count.

    Args:
        error: position RMSE of the prediction, mean over scenarios [length], [frame].
        persistence: position RMSE of persistence, likewise.
        limit: position RMSE of the perturbed run, likewise; empty where not recorded.
    """
    name = "below_twin_floor"
    if len(limit) != len(error):
        reason = "no predictability limit of these frames is recorded"
        return Flag(name=name, raised=None, reasons=(reason,), evidence={})

    perturbed = np.asarray(limit, np.float64)
    is_compared = perturbed < REGULAR_SHARE * persistence
    is_below = is_compared & (error < perturbed)
    count = int(np.count_nonzero(is_below))
    evidence = {
        "frames_below": float(count),
        "frames_compared": float(np.count_nonzero(is_compared)),
    }
    if not is_compared.any():
        reason = "the perturbed run has lost the truth in all frames"
        return Flag(name=name, raised=None, reasons=(reason,), evidence=evidence)
    reason = f"frames closer to the truth than the perturbed run: {count}"
    return _make_flag(name, {reason: count > 0}, evidence)


def judge_physics(traces: Sequence[Trace], *, dimension: int = 2) -> Flag:
    """Judge whether energy and filled area, or volume, stay near the truth's.

    Args:
        traces: those of all scenarios.
        dimension: number of axes of the box, 2 or 3.
    """
    predicted_motion = sum(np.sum(trace.predicted_motion) for trace in traces)
    motion = sum(np.sum(trace.motion) for trace in traces)
    energy = _ratio(predicted_motion, motion)
    occupancy = float(np.mean([np.mean(trace.occupancy) for trace in traces]))
    outside = float(np.mean([np.mean(trace.outside) for trace in traces]))

    extent = "area" if dimension == 2 else "volume"
    reasons = {
        f"{energy:.2g} times the truth's kinetic energy": (
            energy < ENERGY[0] or energy > ENERGY[1]
        ),
        f"the particles fill {occupancy:.2g} times the truth's {extent}": (
            occupancy < OCCUPANCY[0] or occupancy > OCCUPANCY[1]
        ),
    }
    evidence = {"energy": energy, "occupancy": occupancy, "outside": outside}
    return _make_flag("physics", reasons, evidence)


def _least(values: Iterable[float]) -> float:
    """Return the least value that is not NaN, NaN without one."""
    return min((v for v in values if not math.isnan(v)), default=math.nan)


def _ratio(numerator: float, denominator: float) -> float:
    """Return the quotient of two numbers >= 0, NaN where the second is 0."""
    if denominator > 0.0:
        return float(numerator) / float(denominator)
    return math.nan


def _root_ratio(numerator: float, denominator: float) -> float:
    return math.sqrt(_ratio(numerator, denominator))
