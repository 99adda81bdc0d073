"""Quantities that a flow conserves: energy, momentum, density, and what is in the box.

A surrogate that damps loses energy, one that blows up gains it; more energy than the
truth is no merit, so the ratio aims at 1 and the error counts both ways. Errors of
momentum are scaled by the truth's sum of magnitudes, which does not vanish where the
momenta of a closed flow cancel; where the truth comes to rest there is a least scale.
All particles of a scenario have one mass; it cancels, and momenta are given over it.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from lagbench.data.grid import divergence

from .frame import Floats, FramePair, Snapshot, dot, lengths, mean_squared_error
from .metric import (
    Direction,
    enough_nodes,
    metric,
    metrics_of,
    quotient,
    scaled_error,
    total,
)
from .metric import root_mean_square as over_frames_rms

MOVING = 0.01
"""Share of the truth's greatest kinetic energy from which a frame counts as moving."""

ENERGIES = ("energy_predicted", "energy_true")

_error = partial(metric, unit="1", direction=Direction.LOWER)


def kinetic_energy(snapshot: Snapshot, particle_mass: float) -> float:
    """Return ``E = sum(m |u|^2) / 2`` (Eq. 5.11) [mass length^2/frame^2]."""
    return 0.5 * particle_mass * snapshot.speed_square


@metric(unit="mass length^2/frame^2", source="Eq. 5.11", least=0.0)
def energy_true(pair: FramePair) -> float:
    """Kinetic energy of the truth."""
    return kinetic_energy(pair.truth, pair.scenario.particle_mass)


@metric(unit="mass length^2/frame^2", source="Eq. 5.11, Fig. 5.28", least=0.0)
def energy_predicted(pair: FramePair) -> float:
    """Kinetic energy of the prediction."""
    return kinetic_energy(pair.prediction, pair.scenario.particle_mass)


@metric(
    unit="1",
    direction=Direction.TARGET,
    perfect=1.0,
    least=0.0,
    source="Eq. 5.11",
    of=ENERGIES,
)
def energy_ratio(predicted: Floats, true: Floats) -> Floats:
    """Predicted / true kinetic energy, in frames with at least 1 % of the true peak.

    Undefined in other frames: beside a truth at rest any motion is a ratio without
    bounds, and one such frame, before a dam breaks or after all has settled, would
    determine the mean.
    """
    peak = np.max(true, initial=0.0, where=~np.isnan(true))
    moving = np.where(true >= MOVING * peak, true, 0.0)
    return quotient(predicted, moving)


@metric(unit="1", source="Fig. 5.19", least=0.0)
def energy_retention(pair: FramePair) -> float:
    """Kinetic energy of the prediction / kinetic energy in the last given frame."""
    return _retained_share(pair.prediction)


@metric(unit="1", source="Fig. 5.19", least=0.0)
def energy_retention_true(pair: FramePair) -> float:
    """Kinetic energy of the truth / kinetic energy in the last given frame."""
    return _retained_share(pair.truth)


def _retained_share(snapshot: Snapshot) -> float:
    mass = snapshot.scenario.particle_mass
    initial = kinetic_energy(snapshot.scenario.initial_snapshot, mass)
    if initial > 0.0:
        return kinetic_energy(snapshot, mass) / initial
    return math.nan


@_error(source="Eq. 5.11", of=ENERGIES)
def energy_error(predicted: Floats, true: Floats) -> Floats:
    """Absolute error of kinetic energy, divided by the larger of true energy and 1e-3
    of its peak.

    NaN where the truth rests in all frames. It forgives a flow that is wrong but as
    fast.
    """
    return scaled_error(np.abs(predicted - true), true)


@metric(unit="frame", source="Eq. 5.11", least=0.0, over_frames=total, per_frame=False)
def active_frames(pair: FramePair) -> float:
    """Predicted frames until the truth's kinetic energy stays below 1 % of its peak."""
    return float(pair.frame in pair.scenario.moving_frames)


def momentum(snapshot: Snapshot) -> Floats:
    """Return ``sum(u)``: momentum over the particle mass [length/frame], [axis]."""
    return np.asarray(snapshot.velocity.sum(axis=0))


def angular_momentum(snapshot: Snapshot) -> Floats:
    """Return ``sum(r x u)`` about the box centre (Eq. 5.1) [length^2/frame].

    The angular momentum is given over the particle mass. It is a scalar in two
    dimensions, a vector of shape [axis] in three.
    """
    r = snapshot.lever_arms
    u = snapshot.velocity

    def component(j: int, k: int) -> float:
        return dot(r[:, j], u[:, k]) - dot(r[:, k], u[:, j])

    if u.shape[1] == 2:
        return np.array(component(0, 1))
    return np.array([component(1, 2), component(2, 0), component(0, 1)])


@metric(unit="length/frame", source="section 5.2", least=0.0)
def momentum_gap(pair: FramePair) -> float:
    """Error of total momentum, unscaled."""
    difference = momentum(pair.prediction) - momentum(pair.truth)
    return math.hypot(*difference)


@metric(unit="length/frame", source="section 5.2", least=0.0)
def momentum_scale(pair: FramePair) -> float:
    """Sum of the true speeds: the denominator of momentum_error."""
    return float(pair.truth.speeds.sum())


@_error(source="section 5.2", of=("momentum_gap", "momentum_scale"))
def momentum_error(gap: Floats, scale: Floats) -> Floats:
    """Error of total momentum, divided by the larger of momentum_scale and 1e-3 of its
    peak.
    """
    return scaled_error(gap, scale)


@metric(unit="length^2/frame", source="section 5.2, Eq. 5.1", least=0.0)
def angular_momentum_gap(pair: FramePair) -> float:
    """Error of angular momentum about the box centre, unscaled."""
    difference = angular_momentum(pair.prediction) - angular_momentum(pair.truth)
    return math.hypot(*np.atleast_1d(difference))


@metric(unit="length^2/frame", source="section 5.2, Eq. 5.1", least=0.0)
def angular_momentum_scale(pair: FramePair) -> float:
    """Sum of true speed times distance from the box centre: the denominator of
    angular_momentum_error.
    """
    return dot(lengths(pair.truth.lever_arms), pair.truth.speeds)


@_error(
    source="section 5.2, Eq. 5.1",
    of=("angular_momentum_gap", "angular_momentum_scale"),
)
def angular_momentum_error(gap: Floats, scale: Floats) -> Floats:
    """Error of angular momentum, divided by the larger of angular_momentum_scale and
    1e-3 of its peak.
    """
    return scaled_error(gap, scale)


@_error(source="Eq. 3.3", over_frames=over_frames_rms)
def density_rmse(pair: FramePair) -> float:
    """Root mean squared error of density over all nodes, in units of the rest density.

    All nodes of the grid, so that material in the wrong place shows both where it is
    missing and where it should not be. 0 is perfect; values of a box that is filled in
    part are small.
    """
    error = pair.prediction.fields.density - pair.truth.fields.density
    return math.sqrt(mean_squared_error(error))


@metric(unit="1/frame", source="section 5.9.1", least=0.0, defined=enough_nodes)
def divergence_rms(pair: FramePair) -> float:
    """Root mean squared divergence of the prediction."""
    return _divergence_rms(pair, pair.prediction)


@metric(unit="1/frame", source="section 5.9.1", least=0.0, defined=enough_nodes)
def divergence_rms_true(pair: FramePair) -> float:
    """Root mean squared divergence of the truth."""
    return _divergence_rms(pair, pair.truth)


def _divergence_rms(pair: FramePair, snapshot: Snapshot) -> float:
    grid = pair.scenario.config.grid
    rate = divergence(snapshot.fields.velocity, grid.spacing, grid.box.periodic)
    return math.sqrt(mean_squared_error(rate[pair.nodes]))  # [1/frame]


@_error(unit="%", source="docs/scoring.md", greatest=100.0)
def outside_share(pair: FramePair) -> float:
    """Share of predicted particles that are past a wall."""
    return 100.0 * pair.outside_share


METRICS = metrics_of(globals())
"""Metrics of this family, in the order of their definition."""
