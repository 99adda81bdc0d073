"""Distances between clouds of particles that do not ask which particle is which.

Slow, so measured at the frames of interest and the last one only.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import require

from .frame import Floats, FramePair
from .metric import Direction, Metric, at_slow_frames
from .projections import DIRECTIONS, sorted_projections

__all__ = ["DIRECTIONS", "METRICS", "sinkhorn_divergence", "sliced_wasserstein2"]

BLUR = 0.1
"""Entropic regularisation of LagrangeBench's Sinkhorn divergence [length^2]."""

ROUNDS = 500
"""Most Sinkhorn iterations, as in LagrangeBench."""

TOLERANCE = 1e-5
"""Marginal error at which the iterations stop, as in LagrangeBench."""


def sliced_wasserstein2(x: Floats, y: Floats) -> float:
    """Return ``sqrt(mean_ki(((x.d_k)_(i) - (y.d_k)_(i))^2))``, sorted along each direction.

    The directions are fixed: nothing is drawn. A shift by s gives ``|s| / sqrt(2)``.

    Args:
        x: one cloud [length], shape [particle, 2].
        y: another of as many particles [length], shape [particle, 2].
    """
    return _distance(sorted_projections(x), sorted_projections(y))


def _distance(x: Floats, y: Floats) -> float:
    """Return the root mean square of the differences of sorted projections [length]."""
    return math.sqrt(float(np.mean((x - y) ** 2)))


def sinkhorn_divergence(x: Floats, y: Floats) -> float:
    """Return ``S(x, y) - (S(x, x) + S(y, y)) / 2``, clipped at 0 [length^2].

    LagrangeBench's metric, with its constants, by POT. Its blur of 0.1 is a third of the box
    in length, so it sees little but shifts of the whole; three n x n matrices make it slow and
    large (8192 particles: minutes and gigabytes). Prefer :func:`sliced_wasserstein2`.

    Raises:
        UsageError: POT is not installed.
    """
    ot = require("ot", extra="transport")

    def cost(a: Floats, b: Floats) -> float:
        weights: list[NDArray[np.float64]] = [np.full(len(side), 1.0 / len(side)) for side in (a, b)]
        distances = ot.dist(a, b, metric="sqeuclidean")
        found = ot.sinkhorn2(*weights, distances, reg=BLUR, numItermax=ROUNDS, stopThr=TOLERANCE, warn=False)
        return float(found)

    return max(0.0, cost(x, y) - (cost(x, x) + cost(y, y)) / 2.0)


def sliced_w2(pair: FramePair) -> float:
    """Return the sliced Wasserstein-2 distance of predicted from true positions [length]."""
    return _distance(pair.truth.projections, pair.prediction.projections)


def sinkhorn(pair: FramePair) -> float:
    """Return LagrangeBench's Sinkhorn divergence of the positions [length^2]."""
    return sinkhorn_divergence(pair.truth.position, pair.prediction.position)


METRICS = (
    Metric(
        name="sliced_w2",
        family="transport",
        unit="length",
        direction=Direction.LOWER,
        perfect=0.0,
        source="design section 8",
        summary="sliced Wasserstein-2 distance of the particle clouds, 64 directions",
        statistic=sliced_w2,
        applies=at_slow_frames,
    ),
    Metric(
        name="sinkhorn",
        family="transport",
        unit="length^2",
        direction=Direction.LOWER,
        perfect=0.0,
        source="LagrangeBench (Toshev et al. 2023)",
        summary="LagrangeBench's Sinkhorn divergence: blurred and slow, optional",
        statistic=sinkhorn,
        applies=at_slow_frames,
        extra="transport",
    ),
)
"""Metrics of this family."""
