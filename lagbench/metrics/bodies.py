"""Does an elastic body keep its shape and hold together?

A body is all jelly, or all rope, of a scenario: no split has two of one kind. Only
scenarios with such a body have these metrics; elsewhere they are expected gaps.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .frame import ELASTIC, Floats, FramePair, Snapshot
from .metric import Direction, Metric


def rigid_residual(truth: Floats, prediction: Floats) -> float:
    """Return the RMS distance after the best rigid fit of prediction to truth [length].

    With both centred, the best rotation (Kabsch, in two dimensions) is by
    ``atan2(X, D)`` with ``D = sum(p . t)`` and ``X = sum(p x t)`` over positions of
    shape [particle, 2]. A mirrored body does not fit.
    """
    t = truth - np.mean(truth, axis=0)
    p = prediction - np.mean(prediction, axis=0)
    dot = float(np.sum(p * t))
    cross = float(np.sum(p[:, 0] * t[:, 1] - p[:, 1] * t[:, 0]))
    size = math.hypot(dot, cross)
    cos, sin = (dot / size, cross / size) if size > 0.0 else (1.0, 0.0)
    turned = np.stack(
        [cos * p[:, 0] - sin * p[:, 1], sin * p[:, 0] + cos * p[:, 1]], axis=1
    )
    return math.sqrt(float(np.mean(np.sum((turned - t) ** 2, axis=1))))


def shape_error(pair: FramePair, material: str) -> float:
    """Return the RMS distance of a body from its true shape [length].

    Where the body is and how it is turned does not count. Good: a small part of the
    particle spacing; a body that melts reaches its own radius.
    """
    members = pair.scenario.members[material]
    return rigid_residual(
        pair.truth.position[members], pair.prediction.position[members]
    )


def connectivity(pair: FramePair, material: str) -> float:
    """Return the share of a predicted body's first-frame neighbours that are still
    together [1].
    """
    return _held(pair, pair.prediction, material)


def connectivity_true(pair: FramePair, material: str) -> float:
    """Return the same share in the truth [1]: 1 unless the simulated body itself
    tears.
    """
    return _held(pair, pair.truth, material)


def _held(pair: FramePair, snapshot: Snapshot, material: str) -> float:
    scenario = pair.scenario
    return scenario.bonds[material].share_held(
        snapshot.position[scenario.members[material]]
    )


@dataclass(frozen=True)
class OverBodies:
    """Mean of a statistic over the elastic bodies of a scenario, or over those of one
    material.
    """

    # value of one body, given its material
    statistic: Callable[[FramePair, str], float]
    materials: tuple[str, ...]  # whose bodies are taken

    def _present(self, pair: FramePair) -> list[str]:
        return [name for name in self.materials if name in pair.scenario.members]

    def __call__(self, pair: FramePair) -> float:
        """Return the mean over the bodies of one frame pair."""
        return float(
            np.mean([self.statistic(pair, name) for name in self._present(pair)])
        )

    def applies(self, pair: FramePair) -> bool:
        """Tell whether the scenario has such a body."""
        return bool(self._present(pair))


METRICS = tuple(
    Metric(
        name=f"{statistic.__name__}{suffix}",
        family="bodies",
        unit=unit,
        direction=direction,
        perfect=perfect,
        source="section 4.8.2",
        summary=f"{summary}, {whose}",
        statistic=OverBodies(statistic, materials),
        applies=OverBodies(statistic, materials).applies,
    )
    for statistic, unit, direction, perfect, summary in (
        (
            shape_error,
            "length",
            Direction.LOWER,
            0.0,
            "Distance from the true shape after a rigid fit",
        ),
        (
            connectivity,
            "1",
            Direction.HIGHER,
            1.0,
            "Share of first neighbours within twice their distance",
        ),
        (connectivity_true, "1", Direction.NONE, None, "Connectivity of the truth"),
    )
    for suffix, materials, whose in (
        ("", ELASTIC, "mean over elastic bodies"),
        *((f"_{name}", (name,), name) for name in ELASTIC),
    )
)
"""Metrics of this family."""
