"""Errors of total momentum and angular momentum, scaled by the truth's motion.

The scale adds magnitudes, so it does not vanish where the momenta of a closed flow cancel.
All particles of a scenario have one mass; it cancels.
"""

from __future__ import annotations

import math

import numpy as np

from .frame import Floats, FramePair, Snapshot
from .metric import Direction, Metric

__all__ = ["METRICS", "angular_momentum", "momentum"]


def momentum(snapshot: Snapshot) -> Floats:
    """Return ``sum(u)``: momentum over the particle mass [length/frame], shape [2]."""
    return np.asarray(np.sum(snapshot.velocity, axis=0))


def angular_momentum(snapshot: Snapshot, centre: tuple[float, float]) -> float:
    """Return ``sum(r x u)`` about the centre (Eq. 5.1), over the particle mass [length^2/frame]."""
    r, u = snapshot.position - centre, snapshot.velocity
    return float(np.sum(r[:, 0] * u[:, 1] - r[:, 1] * u[:, 0]))


def _length(vectors: Floats) -> Floats:
    """Return the Euclidean length of vectors, shape [particle]."""
    return np.sqrt(vectors[:, 0] ** 2 + vectors[:, 1] ** 2)


def momentum_error(pair: FramePair) -> float:
    """Return ``|P_pred - P_true| / sum(m |u_true|)`` [1], NaN where the truth rests."""
    dx, dy = momentum(pair.prediction) - momentum(pair.truth)
    scale = float(np.sum(_length(pair.truth.velocity)))
    return math.hypot(dx, dy) / scale if scale > 0.0 else math.nan


def angular_momentum_error(pair: FramePair) -> float:
    """Return ``|L_pred - L_true| / sum(m |r| |u|)`` of the truth [1], NaN where it rests."""
    centre = pair.scenario.setting.centre
    error = abs(angular_momentum(pair.prediction, centre) - angular_momentum(pair.truth, centre))
    scale = float(np.sum(_length(pair.truth.position - centre) * _length(pair.truth.velocity)))
    return error / scale if scale > 0.0 else math.nan


METRICS = (
    Metric(
        name="momentum_error",
        family="momentum",
        unit="1",
        direction=Direction.LOWER,
        perfect=0.0,
        source="section 5.2",
        summary="error of total momentum over the truth's sum of magnitudes",
        statistic=momentum_error,
    ),
    Metric(
        name="angular_momentum_error",
        family="momentum",
        unit="1",
        direction=Direction.LOWER,
        perfect=0.0,
        source="section 5.2, Eq. 5.1",
        summary="error of angular momentum about the box centre over the truth's sum of magnitudes",
        statistic=angular_momentum_error,
    ),
)
"""Metrics of this family."""
