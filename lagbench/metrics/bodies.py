"""Does an elastic body keep its shape and stay in one piece?

All jelly of a scenario is one body, and so is all rope: no split has two bodies of one
material. Only scenarios with such a body have these metrics; elsewhere they are
expected gaps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from .frame import ELASTIC, Floats, FramePair, Snapshot
from .metric import Direction, Metric, has_material


def rigid_residual(truth: Floats, prediction: Floats) -> float:
    """Return the RMS distance after the best rigid fit of prediction to truth [length].

    A mirrored body does not fit.

    Args:
        truth: true positions of a body in one piece [length], shape [particle, axis].
        prediction: predicted positions, likewise.
    """
    t = truth - np.mean(truth, axis=0)
    p = prediction - np.mean(prediction, axis=0)
    if p.shape[1] == 2:
        rotated = rotate_in_plane(t, p)
    else:
        rotated = p @ fit_rotation(t, p).T
    squares = np.sum((rotated - t) ** 2, axis=1)  # shape [particle]
    return math.sqrt(float(np.mean(squares)))


def fit_rotation(t: Floats, p: Floats) -> Floats:
    """Return the rotation R that makes ``sum |R p - t|^2`` least, shape [axis, axis].

    ``R = V diag(1, .., det(V U^T)) U^T`` with ``sum(p t^T) = U S V^T`` (Kabsch 1976,
    doi 10.1107/S0567739476001873), in any dimension.

    Args:
        t: true positions about their mean [length], shape [particle, axis].
        p: predicted positions about their mean [length], shape [particle, axis].
    """
    covariance = np.einsum("pi,pj->ij", p, t)
    u, _, vh = np.linalg.svd(covariance)
    signs = np.ones(len(covariance))
    signs[-1] = np.sign(np.linalg.det(u) * np.linalg.det(vh))
    return np.asarray((vh.T * signs) @ u.T, np.float64)


def rotate_in_plane(t: Floats, p: Floats) -> Floats:
    """Return p rotated to fit t best in two dimensions, shape [particle, 2].

    The angle is ``atan2(X, D)`` with ``D = sum(p . t)`` and ``X = sum(p x t)``. No
    decomposition is needed.

    Args:
        t: true positions about their mean [length], shape [particle, 2].
        p: predicted positions about their mean [length], shape [particle, 2].
    """
    px = p[:, 0]
    py = p[:, 1]

    dot = float(np.sum(p * t))
    cross = float(np.sum(px * t[:, 1] - py * t[:, 0]))
    size = math.hypot(dot, cross)
    cos = 1.0
    sin = 0.0
    if size > 0.0:
        cos = dot / size
        sin = cross / size

    rotated_x = cos * px - sin * py
    rotated_y = sin * px + cos * py
    return np.stack([rotated_x, rotated_y], axis=1)


def shape_error(pair: FramePair, material: str) -> float:
    """Return the RMS distance of a body from its true shape [length].

    Position and rotation of the body do not count. Good: a small part of the particle
    spacing; a body that melts reaches its own radius.
    """
    members = pair.scenario.members[material]
    box = pair.scenario.config.box
    truth = box.unwrap(pair.truth.position[members])
    prediction = box.unwrap(pair.prediction.position[members])
    return rigid_residual(truth, prediction)


def connectivity(pair: FramePair, material: str) -> float:
    """Return the share of unbroken bonds in a predicted body [1]."""
    return _intact_share(pair.prediction, material)


def connectivity_true(pair: FramePair, material: str) -> float:
    """Return the share of unbroken bonds in the true body [1]: 1 unless it tears."""
    return _intact_share(pair.truth, material)


def _intact_share(snapshot: Snapshot, material: str) -> float:
    scenario = snapshot.scenario
    position = snapshot.position[scenario.members[material]]
    return scenario.bonds[material].intact_share(position)


def over_bodies(
    statistic: Callable[[FramePair, str], float], materials: tuple[str, ...]
) -> Callable[[FramePair], float]:
    """Return the mean of a statistic over the elastic bodies of some materials."""

    def mean_over_bodies(pair: FramePair) -> float:
        members = pair.scenario.members
        values = [statistic(pair, name) for name in materials if name in members]
        return float(np.mean(values))

    return mean_over_bodies


def _body_metrics(
    statistic: Callable[[FramePair, str], float],
    summary: str,
    **fields: Any,  # noqa: ANN401 - further fields of Metric
) -> Iterator[Metric]:
    """Yield a metric over all elastic bodies, then one for each elastic material."""
    for materials in (ELASTIC, *((material,) for material in ELASTIC)):
        is_of_all = materials == ELASTIC
        yield Metric(
            name=statistic.__name__ + ("" if is_of_all else f"_{materials[0]}"),
            family="bodies",
            least=0.0,
            source="section 4.8.2",
            summary=f"{summary}, "
            + ("mean over elastic bodies" if is_of_all else materials[0]),
            statistic=over_bodies(statistic, materials),
            applies=partial(has_material, materials=materials),
            **fields,
        )


METRICS = (
    *_body_metrics(
        shape_error,
        "Distance from the true shape after a rigid fit",
        unit="length",
        direction=Direction.LOWER,
        perfect=0.0,
    ),
    *_body_metrics(
        connectivity,
        "Share of the neighbours in frame 0 whose distance has at most doubled",
        unit="1",
        direction=Direction.HIGHER,
        perfect=1.0,
        greatest=1.0,
    ),
    *_body_metrics(
        connectivity_true,
        "Connectivity of the truth",
        unit="1",
        direction=Direction.NONE,
        greatest=1.0,
    ),
)
"""Metrics of this family."""
