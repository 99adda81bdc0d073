"""Distances between clouds of particles that do not ask which particle is which.

Slow, so measured at a few frames only.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.errors import require

from .frame import FramePair, sorted_projections
from .metric import Direction, at_slow_frames, metric, metrics_of

CLOUD_FRAMES = 10
"""``cloud_distance`` is taken at every one of so many active frames."""

BLUR = 0.1
"""Entropic regularisation of the Sinkhorn divergence [length^2]."""

ROUNDS = 500
"""Most Sinkhorn iterations, as in LagrangeBench."""

TOLERANCE = 1e-5
"""Marginal error at which the iterations stop, as in LagrangeBench."""

_error = partial(metric, unit="length", direction=Direction.LOWER)


def sliced_wasserstein2(x: ArrayLike, y: ArrayLike) -> float:
    """Return ``sqrt(mean_ki(((x.d_k)_(i) - (y.d_k)_(i))^2))``, sorted along each
    direction.

    Of two clouds of as many particles [length], shape [particle, 2]. The directions are
    fixed: nothing is drawn. A shift by s gives ``|s| / sqrt(2)``.
    """
    return _distance(sorted_projections(x), sorted_projections(y))


def _distance(x: NDArray[np.float32], y: NDArray[np.float32]) -> float:
    """Return the root mean square of the differences of sorted projections [length]."""
    squares = [
        float(np.mean(np.subtract(a, b, dtype=np.float64) ** 2))
        for a, b in zip(x, y, strict=True)
    ]
    return math.sqrt(math.fsum(squares) / len(squares))


def sinkhorn_divergence(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Return ``S(x, y) - (S(x, x) + S(y, y)) / 2``, clipped at 0 [length^2].

    By POT, with the regularisation 0.1: LagrangeBench's own default differs from it by
    11 to 15 %. A blur of 0.1 is a third of the box in length, so it sees little but
    shifts of the whole; three n x n matrices make it slow and large (8192 particles:
    minutes and gigabytes). Prefer :func:`sliced_wasserstein2`.
    """
    ot = require("ot", extra="transport")

    def cost(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
        weights: list[NDArray[np.float64]] = [
            np.full(len(side), 1.0 / len(side)) for side in (a, b)
        ]
        distances = ot.dist(a, b, metric="sqeuclidean")
        options = {
            "reg": BLUR,
            "numItermax": ROUNDS,
            "stopThr": TOLERANCE,
            "warn": False,
        }
        return float(ot.sinkhorn2(*weights, distances, **options))

    return max(0.0, cost(x, y) - (cost(x, x) + cost(y, y)) / 2.0)


def at_cloud_frames(pair: FramePair) -> bool:
    """Tell whether this is every tenth frame in which a truth with a surface is active;
    of fewer the last.
    """
    if pair.scenario.setting.full_box:
        return False
    active = pair.scenario.active
    return pair.frame in (active[CLOUD_FRAMES - 1 :: CLOUD_FRAMES] or active[-1:])


@_error(source="design 2, section 4", applies=at_cloud_frames)
def cloud_distance(pair: FramePair) -> float:
    """Sliced W2 of each material's cloud, by its share of particles, at every tenth
    active frame.

    Which particle is which does not count, of which material it is does. A cloud that
    is shifted by s is |s| / sqrt(2) off; where the truth has come to rest nothing is
    measured.
    """
    true = pair.truth.material_projections
    predicted = pair.prediction.material_projections
    members = pair.scenario.members
    weighted = [
        len(members[name]) * _distance(true[name], predicted[name]) for name in members
    ]
    return math.fsum(weighted) / len(pair.scenario.material)


def at_slow_frames_of_clouds(pair: FramePair) -> bool:
    """Tell whether this is a frame of interest or the last one; in a full box only the
    last one.

    There the cloud is the box, whatever flows in it: 64 sorts for what hardly changes.
    """
    setting = pair.scenario.setting
    if setting.full_box:
        return pair.frame == setting.predicted_frames[-1]
    return at_slow_frames(pair)


@_error(source="design section 8", applies=at_slow_frames_of_clouds)
def sliced_w2(pair: FramePair) -> float:
    """Sliced Wasserstein-2 distance of the particle clouds, 64 directions."""
    return _distance(pair.truth.projections, pair.prediction.projections)


@_error(
    unit="length^2",
    source="LagrangeBench (Toshev et al. 2023)",
    applies=at_slow_frames,
    extra="transport",
)
def sinkhorn_pot(pair: FramePair) -> float:
    """Sinkhorn divergence by POT, regularisation 0.1: blurred and slow, optional."""
    return sinkhorn_divergence(pair.truth.position, pair.prediction.position)


METRICS = metrics_of(globals())
"""Metrics of this family, in the order of their definition."""
