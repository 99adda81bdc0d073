"""Errors of the vorticity field at the nodes that the truth's material fills.

``omega = dv/dx - du/dy`` (Eq. 5.19) by :mod:`lagbench.data.grid`, per frame. Undefined where
fewer than 16 nodes can be compared. Pearson and slope are also undefined where a field is
constant: a prediction at rest has no correlation, neither good nor bad.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from .frame import PERCENTILES, Floats, FramePair
from .metric import Direction, Metric, enough_nodes
from .pointwise import mean_absolute_error, mean_squared_error
from .reductions import frames_before_fall, root_mean_square

__all__ = ["METRICS", "pearson", "slope"]

CONSTANT = 1e-12
"""A field is constant when its deviation from the mean is below this share of its size."""


def _deviation(values: Floats) -> Floats | None:
    """Return values minus their mean, None where the field is constant to rounding."""
    deviation = values - np.mean(values)
    spread, size = np.sqrt(np.sum(deviation**2)), np.sqrt(np.sum(values**2))
    return deviation if spread > CONSTANT * size else None


def pearson(x: Floats, y: Floats) -> float:
    """Return ``r = sum(dx dy) / sqrt(sum(dx^2) sum(dy^2))`` (Eq. 5.21), NaN if one is constant.

    1 is perfect, 0 unrelated, -1 reversed; scale and offset do not show. The thesis's best
    model has 0.957 at frame 54 of the cavity, its worst 0.812.
    """
    dx, dy = _deviation(x), _deviation(y)
    if dx is None or dy is None:
        return math.nan
    r = np.sum(dx * dy) / np.sqrt(np.sum(dx**2) * np.sum(dy**2))
    return float(np.clip(r, -1.0, 1.0))


def slope(x: Floats, y: Floats) -> float:
    """Return the least-squares slope ``sum(dx dy) / sum(dx^2)`` of y on x, NaN if x is constant."""
    dx = _deviation(x)
    return math.nan if dx is None else float(np.sum(dx * (y - np.mean(y))) / np.sum(dx**2))


def vorticity_mse(pair: FramePair) -> float:
    """Return ``mean(r^2)`` over the compared nodes [1/frame^2]."""
    return mean_squared_error(pair.vorticity_residual)


def vorticity_mae(pair: FramePair) -> float:
    """Return ``mean(|r|)`` over the compared nodes [1/frame]."""
    return mean_absolute_error(pair.vorticity_residual)


def vorticity_pearson(pair: FramePair) -> float:
    """Return the correlation of predicted with true vorticity (Eq. 5.21) [1]."""
    return pearson(pair.true_vorticity, pair.predicted_vorticity)


def vorticity_residual_mean(pair: FramePair) -> float:
    """Return ``mean(r)``: a bias of the rotation [1/frame]."""
    return float(np.mean(pair.vorticity_residual))


def vorticity_residual_std(pair: FramePair) -> float:
    """Return the standard deviation of r over the nodes [1/frame]."""
    return float(np.std(pair.vorticity_residual))


def vorticity_residual_max(pair: FramePair) -> float:
    """Return ``max(|r|)`` over the nodes [1/frame]."""
    return float(np.max(np.abs(pair.vorticity_residual)))


def vorticity_residual_percentile(pair: FramePair, *, percent: int) -> float:
    """Return a percentile of r, linear between order statistics [1/frame]."""
    return pair.residual_percentiles[percent]


def vorticity_residual_slope(pair: FramePair) -> float:
    """Return the slope of r on the truth: -1 for a prediction at rest, 0 is perfect [1]."""
    return slope(pair.true_vorticity, pair.vorticity_residual)


def _residuals() -> Iterator[Metric]:
    """Yield what is told of the residual (Eq. 5.22): moments, extremes, percentiles, slope."""
    told: dict[str, tuple[Callable[[FramePair], float], Direction, str, str]] = {
        "mean": (vorticity_residual_mean, Direction.TARGET, "1/frame", "mean of the vorticity residual"),
        "std": (vorticity_residual_std, Direction.LOWER, "1/frame", "standard deviation of the residual"),
        "max": (vorticity_residual_max, Direction.LOWER, "1/frame", "greatest absolute residual"),
        "slope": (vorticity_residual_slope, Direction.TARGET, "1", "slope of the residual on the truth"),
    }
    for percent in PERCENTILES:
        statistic = partial(vorticity_residual_percentile, percent=percent)
        summary = f"{percent} % quantile of the residual"
        told[f"p{percent:02d}"] = (statistic, Direction.TARGET, "1/frame", summary)
    for name, (told_by, direction, unit, text) in told.items():
        yield Metric(
            name=f"vorticity_residual_{name}",
            family="vorticity",
            unit=unit,
            direction=direction,
            perfect=0.0,
            source="Eq. 5.22",
            summary=text,
            statistic=told_by,
            defined=enough_nodes,
        )


METRICS = (
    Metric(
        name="vorticity_mse",
        family="vorticity",
        unit="1/frame^2",
        direction=Direction.LOWER,
        perfect=0.0,
        source="Eq. 3.3, Table 5.4",
        summary="mean squared vorticity error over the counted nodes",
        statistic=vorticity_mse,
        defined=enough_nodes,
    ),
    Metric(
        name="vorticity_mae",
        family="vorticity",
        unit="1/frame",
        direction=Direction.LOWER,
        perfect=0.0,
        source="Eq. 3.4, Table 5.4",
        summary="mean absolute vorticity error over the counted nodes",
        statistic=vorticity_mae,
        defined=enough_nodes,
    ),
    Metric(
        name="vorticity_rmse",
        family="vorticity",
        unit="1/frame",
        direction=Direction.LOWER,
        perfect=0.0,
        source="Eq. 3.3, Table 5.4",
        summary="root mean squared vorticity error over the counted nodes",
        of=("vorticity_mse",),
        series=np.sqrt,
        over_frames=root_mean_square,
    ),
    Metric(
        name="vorticity_pearson",
        family="vorticity",
        unit="1",
        direction=Direction.HIGHER,
        perfect=1.0,
        source="Eq. 5.21",
        summary="correlation of predicted and true vorticity",
        statistic=vorticity_pearson,
        defined=enough_nodes,
    ),
    Metric(
        name="stable_frames",
        family="vorticity",
        unit="frame",
        direction=Direction.HIGHER,
        source="design section 8",
        summary="defined frames before vorticity_pearson first falls below 0.8",
        of=("vorticity_pearson",),
        over_frames=frames_before_fall,
        per_frame=False,
    ),
    *_residuals(),
)
"""Metrics of this family."""
