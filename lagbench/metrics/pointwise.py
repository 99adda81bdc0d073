"""Errors of particles: position, velocity, and all attributes standardised.

Each particle of the prediction is compared with the same particle of the truth: order
matters, and a swapped pair is an error even where the picture is the same. On chaotic
flows these errors saturate at the size of the flow; then vorticity and transport say
more, and ``position_rmse_20`` stops while most flows can still be followed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from operator import attrgetter

import numpy as np

from lagbench.data import MATERIALS

from .frame import Floats, FramePair, average, mean_absolute_error, mean_squared_error
from .metric import Direction, FirstFrames, Metric, last, mean, metric, root_mean_square

HORIZONS = (1, 5, 10, 20, 50)
"""Horizons of ``mse_avg`` and ``mse_end`` besides the whole rollout [frame]."""

SQUARED = {"length": "length^2", "length/frame": "length^2/frame^2"}


_error = partial(Metric, family="pointwise", direction=Direction.LOWER, perfect=0.0)


@metric(unit="1", direction=Direction.LOWER, source="Eqs. 4.15, 4.16")
def attribute_mse(pair: FramePair) -> float:
    """Mean squared error of standardised position and velocity.

    ``L = sum((y - yhat)^2) / (N k)`` over z-scores of (x, y, u, v); the means of Eq.
    4.15 cancel in the difference. 0 is perfect; 1 is the error of always predicting the
    mean of train. Undefined where an attribute has one value in all of train: it has no
    z-score.
    """
    std = np.array(pair.scenario.config.attribute_std)
    if not std.all():
        return float("nan")
    squares = np.concatenate([pair.position_square, pair.velocity_square])
    return average(squares / std**2)


@dataclass(frozen=True)
class ErrorMean:
    """Mean of a particle error over all particles, or over those of one material."""

    error: Callable[[FramePair], Floats]  # of all particles, shape [particle, axis]
    norm: Callable[[Floats], float]  # mean squared or mean absolute error
    material: str | None = None  # name of a material, None for all

    def __call__(self, pair: FramePair) -> float:
        """Return the mean for one frame pair."""
        error = self.error(pair)
        if self.material is None:
            return self.norm(error)
        return self.norm(error[pair.scenario.members[self.material]])

    def applies(self, pair: FramePair) -> bool:
        """Return whether the split has several materials and the scenario this one."""
        if self.material is None:
            return True
        is_mixed = len(pair.scenario.config.materials) > 1
        return is_mixed and self.material in pair.scenario.members


def _errors(quantity: str, unit: str) -> Iterator[Metric]:
    """Yield the errors of a quantity over all particles, then by material."""
    for material in (None, *MATERIALS):
        yield from _errors_of_material(quantity, unit, material)


def _errors_of_material(
    quantity: str, unit: str, material: str | None
) -> Iterator[Metric]:
    """Yield MSE, MAE and RMSE of a quantity."""
    if material is None:
        suffix = ""
        particles = "all particles"
    else:
        suffix = f"_{material}"
        particles = f"{material} particles"

    error = attrgetter(f"{quantity}_error")
    squared = ErrorMean(error, mean_squared_error, material)
    yield _error(
        name=f"{quantity}_mse{suffix}",
        unit=SQUARED[unit],
        source="Eq. 3.3",
        summary=f"Mean squared {quantity} error of {particles}",
        statistic=squared,
        applies=squared.applies,
    )
    absolute = ErrorMean(error, mean_absolute_error, material)
    yield _error(
        name=f"{quantity}_mae{suffix}",
        unit=unit,
        source="Eq. 3.4",
        summary=f"Mean absolute {quantity} error of {particles}",
        statistic=absolute,
        applies=absolute.applies,
    )
    yield _error(
        name=f"{quantity}_rmse{suffix}",
        unit=unit,
        source="Eq. 3.3",
        summary=f"Root mean squared {quantity} error of {particles}",
        of=(f"{quantity}_mse{suffix}",),
        series=np.sqrt,
        over_frames=root_mean_square,
    )


def _over_rollouts(
    name: str,
    reduction: Callable[[Floats], float],
    source: str,
    *,
    summary: str,
    summary_to_frame: str,
) -> Iterator[Metric]:
    """Yield the metrics that reduce ``attribute_mse`` over the rollout, and over each
    horizon.

    Args:
        name: name of the metric of the whole rollout.
        reduction: returns the value of a series of frames.
        source: where the metric is defined.
        summary: of the metric of the whole rollout.
        summary_to_frame: of the others; the number of the last frame follows.
    """
    rollout = partial(
        _error, unit="1", source=source, of=("attribute_mse",), per_frame=False
    )
    yield rollout(
        name=name,
        summary=summary,
        over_frames=reduction,
    )
    for horizon in HORIZONS:
        yield rollout(
            name=f"{name}_{horizon}",
            summary=f"{summary_to_frame} {horizon}",
            over_frames=FirstFrames(horizon, reduction),
            horizon=horizon,
        )


def _rmse_of_first_20(mse: Floats) -> float:
    """Return the root mean squared error of the first 20 frames."""
    return math.sqrt(FirstFrames(20)(mse))


METRICS = (
    *_errors("position", "length"),
    _error(
        name="position_rmse_20",
        unit="length",
        source="LagrangeBench (Toshev et al. 2023)",
        summary="Root mean squared position error of the first 20 frames, as "
        "LagrangeBench's MSE_20",
        of=("position_mse",),
        over_frames=_rmse_of_first_20,
        per_frame=False,
        horizon=20,
    ),
    *_errors("velocity", "length/frame"),
    attribute_mse,
    *_over_rollouts(
        "mse_avg",
        mean,
        "Eq. 4.17",
        summary="Mean attribute_mse of the rollout",
        summary_to_frame="Mean attribute_mse up to predicted frame",
    ),
    *_over_rollouts(
        "mse_end",
        last,
        "Eq. 4.18",
        summary="The attribute_mse in the last predicted frame",
        summary_to_frame="The attribute_mse in predicted frame",
    ),
)
"""Metrics of this family."""
