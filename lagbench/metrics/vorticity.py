"""Errors of the vorticity field at the nodes that the truth's material fills.

``omega = dv/dx - du/dy`` (Eq. 5.19) by :mod:`lagbench.data.grid`, per frame. Undefined
where fewer than 16 nodes can be compared. Pearson and slope are also undefined where a
field is constant: a prediction at rest has no correlation, neither good nor bad. The
same holds for a field of rounding, whose pattern is that of the order of sums: bodies
that only fly have no vorticity.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from .frame import (
    PERCENTILES,
    Floats,
    FramePair,
    average,
    mean_absolute_error,
    mean_squared_error,
)
from .metric import (
    Direction,
    Metric,
    enough_nodes,
    has_rotation,
    mean,
    metric,
    metrics_of,
    quotient,
    root_mean_square,
)

STABLE_PEARSON = 0.95
"""Vorticity correlation of a stable rollout; at 0.8 good models saturate."""

CONSTANT = 1e-12
"""Largest deviation from the mean of a constant field, as a share of its size."""


def _deviation(values: Floats) -> tuple[Floats, float] | None:
    """Return values minus their mean, and the sum of squares of these deviations.

    None where the values are constant to rounding.
    """
    deviation = values - average(values)
    squares = float((deviation**2).sum())
    size = math.sqrt((values**2).sum())
    if math.sqrt(squares) > CONSTANT * size:
        return (deviation, squares)
    return None


def pearson(x: Floats, y: Floats) -> float:
    """Return ``r = sum(dx dy) / sqrt(sum(dx^2) sum(dy^2))`` (Eq. 5.21).

    NaN if a field is constant. 1 is perfect, 0 unrelated, -1 reversed; scale and offset
    do not show. The thesis's best model has 0.957 at frame 54 of the cavity, its worst
    0.812.
    """
    x_deviation = _deviation(x)
    y_deviation = _deviation(y)
    if x_deviation is None or y_deviation is None:
        return math.nan
    dx, xx = x_deviation
    dy, yy = y_deviation
    r = float((dx * dy).sum() / np.sqrt(xx * yy))
    return min(max(r, -1.0), 1.0)  # in this order NaN stays NaN


def slope(x: Floats, y: Floats) -> float:
    """Return the least-squares slope ``sum(dx dy) / sum(dx^2)`` of y on x.

    NaN if x is constant.
    """
    deviation = _deviation(x)
    if deviation is None:
        return math.nan
    dx, squares = deviation
    dy = y - average(y)
    return float((dx * dy).sum() / squares)


def frames_before_fall(values: Floats) -> float:
    """Return the number of defined frames before the first below `STABLE_PEARSON`.

    Undefined frames neither end the count nor count: standing still is no merit. NaN
    with no defined frame. A rollout that is always defined and never falls gets the
    whole horizon.
    """
    defined = values[~np.isnan(values)]
    if not defined.size:
        return math.nan
    unstable = np.flatnonzero(defined < STABLE_PEARSON)
    if unstable.size:
        return float(unstable[0])
    return float(defined.size)


_vorticity = partial(metric, source="Eq. 3.3, Table 5.4", direction=Direction.LOWER)


@_vorticity(unit="1/frame^2", defined=enough_nodes)
def vorticity_mse(pair: FramePair) -> float:
    """Mean squared vorticity error over the counted nodes."""
    return mean_squared_error(pair.vorticity_residual)


@_vorticity(unit="1/frame", source="Eq. 3.4, Table 5.4", defined=enough_nodes)
def vorticity_mae(pair: FramePair) -> float:
    """Mean absolute vorticity error over the counted nodes."""
    return mean_absolute_error(pair.vorticity_residual)


@_vorticity(unit="1/frame", of=("vorticity_mse",), over_frames=root_mean_square)
def vorticity_rmse(mse: Floats) -> Floats:
    """Root mean squared vorticity error over the counted nodes."""
    return np.sqrt(mse)


@metric(unit="1/frame^2", source="Eq. 5.19", least=0.0, defined=enough_nodes)
def vorticity_square_true(pair: FramePair) -> float:
    """Mean squared vorticity of the truth over the counted nodes."""
    return mean_squared_error(pair.true_vorticity)


@_vorticity(
    unit="1",
    source="nRMSE of PDEBench (Takamoto et al. 2022)",
    of=("vorticity_mse", "vorticity_square_true"),
    over_frames=root_mean_square,
)
def vorticity_nrmse(mse: Floats, square: Floats) -> Floats:
    """Vorticity RMSE divided by the RMS vorticity of the scenario; so fast scenarios
    do not count more.

    Per scenario ``sqrt(sum_f MSE(omega) / sum_f mean(omega_true^2))``. 0 is perfect, 1
    the error of a prediction at rest, sqrt(2) that of an unrelated flow of the same
    strength.
    """
    scenario_square = np.full(len(mse), mean(square))
    return np.sqrt(quotient(mse, scenario_square))


@metric(
    unit="1",
    direction=Direction.HIGHER,
    perfect=1.0,
    least=-1.0,
    source="Eq. 5.21",
    defined=has_rotation,
)
def vorticity_pearson(pair: FramePair) -> float:
    """Correlation of predicted and true vorticity."""
    if not pair.prediction_rotates:
        return math.nan
    return pearson(pair.true_vorticity, pair.predicted_vorticity)


stable_frames = Metric(
    name="stable_frames",
    family="vorticity",
    unit="frame",
    direction=Direction.HIGHER,
    least=0.0,
    source="Kochkov et al. 2021, PNAS 118(21)",
    summary=f"Frames before vorticity_pearson first falls below {STABLE_PEARSON:g}; "
    "frames in which it is undefined are left out",
    of=("vorticity_pearson",),
    over_frames=frames_before_fall,
    per_frame=False,
)

_residual = partial(metric, unit="1/frame", source="Eq. 5.22", defined=enough_nodes)
_towards_zero = partial(_residual, direction=Direction.TARGET, perfect=0.0)


@_towards_zero()
def vorticity_residual_mean(pair: FramePair) -> float:
    """Mean of the vorticity residual r: a bias of the rotation."""
    return average(pair.vorticity_residual)


@_residual(direction=Direction.LOWER)
def vorticity_residual_std(pair: FramePair) -> float:
    """Standard deviation of the residual."""
    residual = pair.vorticity_residual
    return math.sqrt(average((residual - average(residual)) ** 2))


@_residual(direction=Direction.LOWER)
def vorticity_residual_max(pair: FramePair) -> float:
    """Greatest absolute residual."""
    return float(np.abs(pair.vorticity_residual).max())


@_towards_zero(unit="1", defined=has_rotation)
def vorticity_residual_slope(pair: FramePair) -> float:
    """Slope of the residual on the truth: -1 for a prediction at rest."""
    return slope(pair.true_vorticity, pair.vorticity_residual)


def _percentile(percent: int) -> Metric:
    """Return the metric of a percentile, linear between order statistics."""
    return Metric(
        name=f"vorticity_residual_p{percent:02d}",
        family="vorticity",
        unit="1/frame",
        direction=Direction.TARGET,
        perfect=0.0,
        source="Eq. 5.22",
        summary=f"{percent} % quantile of the residual",
        statistic=lambda pair: pair.residual_percentiles[percent],
        defined=enough_nodes,
    )


METRICS = (
    *metrics_of(globals()),
    *(_percentile(percent) for percent in PERCENTILES),
)
"""Metrics of this family, in the order of their definition."""
