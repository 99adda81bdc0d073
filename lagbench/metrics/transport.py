"""Distances between clouds of particles, whichever particle is which.

They are slow, so they are measured at a few frames only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from lagbench.data.box import UNIT_SQUARE, Box
from lagbench.errors import require

from .frame import FramePair, projection_distance
from .metric import Direction, at_slow_frames, metric, metrics_of

CLOUD_FRAMES = 10
"""Period of ``cloud_distance`` in frames of a moving truth."""

MOTION_WEIGHT = 1.5
"""Weight of the velocities in ``motion_distance``: the least of 1, 1.25, 1.5 and 2 at
which a mean over analogs gains less than 3 % (``benchmarks/truth_edits.py``)."""

BLUR = 0.1
"""Entropic regularisation of the Sinkhorn divergence [length^2]."""

ROUNDS = 500
"""Most Sinkhorn iterations, as in LagrangeBench."""

TOLERANCE = 1e-5
"""Marginal error at which the iterations stop, as in LagrangeBench."""

MOST_EXPONENT = 700.0
"""Largest x for which exp(-x) is a normal number in float64."""

_error = partial(metric, unit="length", direction=Direction.LOWER)


def sinkhorn_divergence(
    x: NDArray[np.float64], y: NDArray[np.float64], box: Box = UNIT_SQUARE
) -> float:
    """Return ``S(x, y) - (S(x, x) + S(y, y)) / 2``, clipped at 0 [length^2].

    S is the entropic transport cost by POT, with the regularisation 0.1 [length^2];
    LagrangeBench's default, the library OTT, gives values that differ by 11 to 15 %.
    The regularisation blurs over sqrt(0.1), a third of the box, so the result shows
    little but shifts of the whole cloud. Three n x n matrices make it slow and large
    (8192 particles: minutes and gigabytes); ``sliced_wasserstein2`` is neither. Along
    periodic axes of the box distances are those to the nearest image. NaN where a
    position is not finite.
    """
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return math.nan
    self_cost = (_sinkhorn_cost(x, x, box) + _sinkhorn_cost(y, y, box)) / 2.0
    return max(0.0, _sinkhorn_cost(x, y, box) - self_cost)


def _sinkhorn_cost(a: NDArray[np.float64], b: NDArray[np.float64], box: Box) -> float:
    """Return the entropic transport cost between two clouds [length^2]."""
    ot = require("ot", extra="transport")
    a_weights = np.full(len(a), 1.0 / len(a))
    b_weights = np.full(len(b), 1.0 / len(b))
    if box.is_periodic:
        ways = box.displacement(a[:, None], b[None])
        distances = np.sum(ways**2, axis=-1)
    else:
        distances = ot.dist(a, b, metric="sqeuclidean")
    # The plain method is faster, but its weights exp(-distance^2 / reg) underflow.
    method = "sinkhorn"
    if distances.max() > MOST_EXPONENT * BLUR:
        method = "sinkhorn_log"
    cost = ot.sinkhorn2(
        a_weights,
        b_weights,
        distances,
        reg=BLUR,
        method=method,
        numItermax=ROUNDS,
        stopThr=TOLERANCE,
        warn=False,
    )
    return float(cost)


def at_cloud_frames(pair: FramePair) -> bool:
    """Return whether clouds are compared at this frame.

    That is each tenth frame in which a truth with a surface moves. With fewer than ten
    such frames it is the last one.
    """
    if pair.scenario.config.is_full_box:
        return False
    moving = pair.scenario.moving_frames
    every_tenth = moving[CLOUD_FRAMES - 1 :: CLOUD_FRAMES]
    return pair.frame in (every_tenth or moving[-1:])


@_error(source="Bonneel et al. 2015, J. Math. Imaging Vis. 51", applies=at_cloud_frames)
def cloud_distance(pair: FramePair) -> float:
    """Sliced W2 of each material's cloud, weighted by particles, at every tenth active
    frame.

    The identity of a particle does not count, its material does. A cloud that is
    shifted by s is |s| / sqrt(2) off, in three dimensions |s| / sqrt(3) within 1 %;
    where the truth has come to rest nothing is measured.
    """
    return _distance_of_clouds(pair)


def _distance_of_clouds(pair: FramePair) -> float:
    return _mean_over_materials(
        pair.truth.material_projections, pair.prediction.material_projections, pair
    )


def _mean_over_materials(
    true: Mapping[str, NDArray[np.float32]],
    predicted: Mapping[str, NDArray[np.float32]],
    pair: FramePair,
) -> float:
    """Return the distance of sorted projections, materials weighted by particles."""
    weighted = []
    for name, particles in pair.scenario.members.items():
        distance = projection_distance(true[name], predicted[name])
        weighted.append(len(particles) * distance)
    return math.fsum(weighted) / len(pair.scenario.material)


def motion_time(attribute_std: Sequence[float]) -> float:
    """Return ``1.5 std(x) / std(u)`` [frame].

    Args:
        attribute_std: deviations over train of the position's components [length], then
            of the velocity's [length/frame].
    """
    dimension = len(attribute_std) // 2
    squares = [std**2 for std in attribute_std]
    position_square = math.fsum(squares[:dimension])
    velocity_square = math.fsum(squares[dimension:])
    if velocity_square == 0.0:
        return 0.0
    return MOTION_WEIGHT * math.sqrt(position_square / velocity_square)


@_error(source="Bonneel et al. 2015, J. Math. Imaging Vis. 51", applies=at_cloud_frames)
def motion_distance(pair: FramePair) -> float:
    """The greater of cloud_distance and, times 1.5 std(x) / std(u), that of velocities.

    The deviations of positions x and velocities u are those of train. The clouds alone
    do not show how particles move: identities that are shuffled in every frame, white
    noise and a film that is smoothed in time are near in position and far in velocity.
    Of a mean over several futures only the positions are nearer than those of one
    future, and not its velocities.
    """
    velocity_distance = _mean_over_materials(
        pair.truth.velocity_projections, pair.prediction.velocity_projections, pair
    )
    time = motion_time(pair.scenario.config.attribute_std)
    return max(_distance_of_clouds(pair), time * velocity_distance)


def at_slow_frames_of_clouds(pair: FramePair) -> bool:
    """Return whether this is a frame of interest or the last one.

    Of a full box it is the last one only: there the cloud is the box, whatever flows in
    it, and 64 sorts would measure what hardly changes.
    """
    config = pair.scenario.config
    if config.is_full_box:
        return pair.frame == config.predicted_frames[-1]
    return at_slow_frames(pair)


@_error(
    source="Bonneel et al. 2015, J. Math. Imaging Vis. 51",
    applies=at_slow_frames_of_clouds,
)
def sliced_w2(pair: FramePair) -> float:
    """Sliced Wasserstein-2 distance of the particle clouds, 64 directions."""
    return projection_distance(pair.truth.projections, pair.prediction.projections)


@_error(
    unit="length^2",
    source="LagrangeBench (Toshev et al. 2023)",
    applies=at_slow_frames,
    extra="transport",
    module="ot",
)
def sinkhorn_pot(pair: FramePair) -> float:
    """Sinkhorn divergence by the library POT, regularisation 0.1; optional."""
    box = pair.scenario.config.box
    return sinkhorn_divergence(pair.truth.position, pair.prediction.position, box)


METRICS = metrics_of(globals())
"""Metrics of this family, in the order of their definition."""
