"""Flags: what a reader of a score should know. They reject nothing.

``copy_suspect``: the error moves in a way that no rollout of a model of ours does.
``below_twin_floor``: closer to the truth than the solver itself after a nudge of 2^-20.
``physics``: kinetic energy or filled area far from the truth's.

The thresholds lie between what honest and dishonest predictions of our own splits show;
``python benchmarks/flag_calibration.py`` prints both and docs/scoring.md has its table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .metrics import Tally
from .trace import SHIFTS, Trace

__all__ = ["Evidence", "Flag", "copy_suspect", "evidence", "below_twin_floor", "physics"]

Floats = NDArray[np.float64]

AUTOCORRELATION = 0.5
"""Below this the error of a frame has too little to do with that of the frame before."""

DROP = 0.5
"""An error that falls to less than this share within one frame was reset."""

SHIFT_GAIN = 0.5
"""Below this the prediction is a shifted truth: that share of the error is left by a shift."""

GROWTH = 1.5
"""An error that grows by less than this factor over the rollout does not accumulate."""

ENERGY = (0.1, 10.0)
"""Mean kinetic energy relative to the truth's outside of which ``physics`` is raised."""

OCCUPANCY = (0.7, 1.4)
"""Mean filled area relative to the truth's outside of which ``physics`` is raised."""

TWIN_REGULAR = 0.1
"""The twin floor counts while it is below this share of the error of persistence."""


@dataclass(frozen=True, kw_only=True)
class Flag:
    """One flag of a submission.

    Attributes:
        name: its name.
        raised: whether it is raised; None where it could not be told.
        reason: why, in one line.
        evidence: the numbers behind it.
    """

    name: str
    raised: bool | None
    reason: str
    evidence: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the error of one scenario does from frame to frame.

    Attributes:
        autocorrelation: mean over frames of the cosine between e(f) and e(f-1) [1].
        drop: least ratio of the RMS errors of two consecutive frames [1].
        shift: shift of the truth in frames that fits the prediction best.
        shift_gain: RMS error at that shift over the RMS error without, at the same frames [1].
        growth: RMS error of the last quarter of the frames over that of the first frame [1].
        steps: largest RMS error over the RMS of the truth's per-frame displacement [1].
    """

    autocorrelation: float
    drop: float
    shift: int
    shift_gain: float
    growth: float
    steps: float


def evidence(trace: Trace) -> Evidence:
    """Return the evidence of one scenario, NaN where the error is 0."""
    error, before = trace.error[1:], trace.error[:-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = trace.overlap[1:] / np.sqrt(error * before)
        ratio = np.sqrt(error / before)
        growth = np.sqrt(np.mean(trace.error[-max(1, len(trace.error) // 4) :]) / trace.error[0])
        steps = np.sqrt(np.max(trace.error) / np.mean(trace.motion))
    gains = {shift: _gain(trace, shift) for shift in SHIFTS}
    best = min(gains, key=lambda shift: (not gains[shift] < 1.0, gains[shift]))
    moved = gains[best] < 1.0
    return Evidence(
        autocorrelation=_finite(cosine, np.mean),
        drop=_finite(ratio, np.min),
        shift=best if moved else 0,
        shift_gain=gains[best] if moved else 1.0,
        growth=float(growth),
        steps=float(steps),
    )


def _gain(trace: Trace, shift: int) -> float:
    shifted = trace.shifted[shift]
    known = ~np.isnan(shifted)
    plain = float(np.sum(trace.error[known]))
    return math.sqrt(float(np.sum(shifted[known])) / plain) if plain > 0.0 else math.nan


def _finite(values: Floats, reduce: object) -> float:
    defined = values[np.isfinite(values)]
    return float(reduce(defined)) if defined.size else math.nan  # type: ignore[operator]
