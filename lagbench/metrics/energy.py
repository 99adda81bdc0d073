"""Kinetic energy of predicted and true motion.

A surrogate that damps loses energy, one that blows up gains it; more energy than the truth
is no merit, so the ratio aims at 1 and the error counts both ways.
"""

from __future__ import annotations

import math

import numpy as np

from .frame import Floats, FramePair, Snapshot
from .metric import Direction, Metric
from .reductions import floored_quotient, quotient

__all__ = ["METRICS", "energy_error", "kinetic_energy"]


def kinetic_energy(snapshot: Snapshot, particle_mass: float) -> float:
    """Return ``E = sum(m |u|^2) / 2`` (Eq. 5.11) [mass length^2/frame^2]."""
    return float(0.5 * particle_mass * np.sum(snapshot.velocity**2))


def energy_true(pair: FramePair) -> float:
    """Return the kinetic energy of the truth [mass length^2/frame^2]."""
    return kinetic_energy(pair.truth, pair.scenario.particle_mass)


def energy_predicted(pair: FramePair) -> float:
    """Return the kinetic energy of the prediction [mass length^2/frame^2]."""
    return kinetic_energy(pair.prediction, pair.scenario.particle_mass)


def energy_retention(pair: FramePair) -> float:
    """Return ``E_pred(f) / E(last given frame)`` (Fig. 5.19) [1]; NaN if that was at rest."""
    return _retained(pair, pair.prediction)


def energy_retention_true(pair: FramePair) -> float:
    """Return ``E_true(f) / E(last given frame)`` [1]; NaN if that was at rest."""
    return _retained(pair, pair.truth)


def _retained(pair: FramePair, snapshot: Snapshot) -> float:
    mass = pair.scenario.particle_mass
    given = kinetic_energy(pair.scenario.last_given, mass)
    return kinetic_energy(snapshot, mass) / given if given > 0.0 else math.nan


def energy_error(predicted: Floats, true: Floats) -> Floats:
    """Return ``|E_pred - E_true| / max(E_true, 1e-3 max(E_true))`` per frame [1].

    The floor keeps frames in which the truth rests from ruling the mean. NaN where the truth
    rests in all frames.
    """
    return floored_quotient(np.abs(predicted - true), true)


METRICS = (
    Metric(
        name="energy_true",
        family="energy",
        unit="mass length^2/frame^2",
        direction=Direction.NONE,
        source="Eq. 5.11",
        summary="kinetic energy of the truth",
        statistic=energy_true,
    ),
    Metric(
        name="energy_predicted",
        family="energy",
        unit="mass length^2/frame^2",
        direction=Direction.NONE,
        source="Eq. 5.11, Fig. 5.28",
        summary="kinetic energy of the prediction",
        statistic=energy_predicted,
    ),
    Metric(
        name="energy_ratio",
        family="energy",
        unit="1",
        direction=Direction.TARGET,
        perfect=1.0,
        source="Eq. 5.11",
        summary="predicted over true kinetic energy",
        of=("energy_predicted", "energy_true"),
        series=quotient,
    ),
    Metric(
        name="energy_retention",
        family="energy",
        unit="1",
        direction=Direction.NONE,
        source="Fig. 5.19",
        summary="kinetic energy of the prediction over that of the last given frame",
        statistic=energy_retention,
    ),
    Metric(
        name="energy_retention_true",
        family="energy",
        unit="1",
        direction=Direction.NONE,
        source="Fig. 5.19",
        summary="kinetic energy of the truth over that of the last given frame",
        statistic=energy_retention_true,
    ),
    Metric(
        name="energy_error",
        family="energy",
        unit="1",
        direction=Direction.LOWER,
        perfect=0.0,
        source="design section 8",
        summary="absolute error of kinetic energy over the truth's",
        of=("energy_predicted", "energy_true"),
        series=energy_error,
    ),
)
"""Metrics of this family."""
