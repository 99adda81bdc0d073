"""Errors as LagrangeBench defines them (Toshev et al. 2023, arXiv 2309.16342).

They serve to compare scores with its published tables. Its third error, the Sinkhorn
divergence, is ``sinkhorn_pot`` in :mod:`~lagbench.metrics.transport`. Distances across
periodic axes are the shortest ones, as everywhere in lagbench.
"""

from __future__ import annotations

from functools import partial

from .frame import Floats
from .metric import Direction, FirstFrames, Metric, mean

STRIDE = 10
"""LagrangeBench measures the kinetic energy at every tenth frame [frame]."""

_error = partial(
    Metric,
    family="lagrangebench",
    direction=Direction.LOWER,
    perfect=0.0,
    source="LagrangeBench (Toshev et al. 2023)",
    extra="lagrangebench",
)


def squared_energy_errors(predicted: Floats, true: Floats) -> Floats:
    """Return the squared error of ``sum(m |u|^2)`` in each frame, shape [frame].

    LagrangeBench's kinetic energy has no factor 1/2, so it is twice ours.
    """
    error = 2.0 * (predicted - true)
    return error**2


def mean_of_every_tenth(errors: Floats) -> float:
    """Return the mean over the second predicted frame and every tenth after it.

    LagrangeBench takes velocities from the way between two predicted frames, so the
    second predicted frame is the first with a velocity.
    """
    return mean(errors[1::STRIDE])


METRICS = (
    _error(
        name="position_mse_20",
        unit="length^2",
        summary="MSE_20: mean squared position error of the first 20 frames",
        of=("position_mse",),
        over_frames=FirstFrames(20),
        per_frame=False,
        horizon=20,
    ),
    _error(
        name="e_kin_mse",
        unit="mass^2 length^4/frame^4",
        summary="MSE of E_kin: squared error of the sum of m u^2, at predicted frames "
        "2, 12, 22 and so on",
        of=("energy_predicted", "energy_true"),
        series=squared_energy_errors,
        over_frames=mean_of_every_tenth,
        horizon=2,
    ),
)
"""Metrics of this family, in the order in which they are shown."""
