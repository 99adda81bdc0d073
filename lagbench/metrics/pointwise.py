"""Errors of particles: position, velocity, and all attributes standardised.

The particle of the prediction is the particle of the truth: order matters, and a
swapped pair is an error even where the picture is the same. On chaotic flows these
errors saturate at the size of the flow; then vorticity and transport say more, and
``position_rmse_20`` stops while most flows can still be followed.
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
"""Predicted frames at which ``mse_avg`` and ``mse_end`` are taken besides the whole
rollout.
"""

SQUARED = {"length": "length^2", "length/frame": "length^2/frame^2"}


_error = partial(Metric, family="pointwise", direction=Direction.LOWER, perfect=0.0)


@metric(unit="1", direction=Direction.LOWER, source="Eqs. 4.15, 4.16")
def attribute_mse(pair: FramePair) -> float:
    """Mean squared error of standardised position and velocity.

    ``L = sum((y - yhat)^2) / (N k)`` over z-scores of (x, y, u, v); the means of Eq.
    4.15 cancel in the difference. 0 is perfect; 1 is the error of always predicting the
    mean of train.
    """
    std = np.array(pair.scenario.setting.attribute_std)
    return average(
        np.concatenate([pair.position_square, pair.velocity_square]) / std**2
    )


@dataclass(frozen=True)
class ErrorMean:
    """Mean of a particle error over all particles, or over those of one material."""

    error: Callable[[FramePair], Floats]  # of all particles, shape [particle, 2]
    law: Callable[[Floats], float]  # mean squared or mean absolute
    material: str | None = None  # name of a material, None for all

    def __call__(self, pair: FramePair) -> float:
        """Return the mean for one frame pair."""
        error = self.error(pair)
        return self.law(
            error
            if self.material is None
            else error[pair.scenario.members[self.material]]
        )

    def applies(self, pair: FramePair) -> bool:
        """Tell whether the split has several materials and the scenario has this
        one.
        """
        several = len(pair.scenario.setting.materials) > 1
        return self.material is None or (
            several and self.material in pair.scenario.members
        )


def _errors(quantity: str, unit: str, material: str | None) -> Iterator[Metric]:
    if material is None:
        whose = "all particles"
    else:
        whose = f"{material} particles"
    if material is None:
        suffix = ""
    else:
        suffix = f"_{material}"
    laws = {
        "mse": (mean_squared_error, SQUARED[unit], "3.3"),
        "mae": (mean_absolute_error, unit, "3.4"),
    }
    for name, (law, law_unit, equation) in laws.items():
        statistic = ErrorMean(attrgetter(f"{quantity}_error"), law, material)
        yield _error(
            name=f"{quantity}_{name}{suffix}",
            unit=law_unit,
            source=f"Eq. {equation}",
            summary=f"Mean {'squared' if name == 'mse' else 'absolute'} {quantity} "
            f"error of {whose}",
            statistic=statistic,
            applies=statistic.applies,
        )
    yield _error(
        name=f"{quantity}_rmse{suffix}",
        unit=unit,
        source="Eq. 3.3",
        summary=f"Root mean squared {quantity} error of {whose}",
        of=(f"{quantity}_mse{suffix}",),
        series=np.sqrt,
        over_frames=root_mean_square,
    )


def _over_rollouts() -> Iterator[Metric]:
    """Yield mean and end of ``attribute_mse`` over the rollout and at the horizons."""
    whole = {"mse_avg": (mean, "4.17", "Mean"), "mse_end": (last, "4.18", "Last")}
    for name, (reduction, equation, word) in whole.items():
        for horizon in (None, *HORIZONS):
            if horizon is None:
                frames = "the rollout"
            else:
                frames = f"the first {horizon} frames"
            yield _error(
                name=name if horizon is None else f"{name}_{horizon}",
                unit="1",
                source=f"Eq. {equation}",
                summary=f"{word} attribute_mse of {frames}",
                of=("attribute_mse",),
                over_frames=reduction
                if horizon is None
                else FirstFrames(horizon, reduction),
                per_frame=False,
                horizon=horizon or 1,
            )


METRICS = (
    *(m for name in (None, *MATERIALS) for m in _errors("position", "length", name)),
    _error(
        name="position_rmse_20",
        unit="length",
        source="design 2, section 4",
        summary="Root mean squared position error of the first 20 frames, as "
        "LagrangeBench's MSE_20",
        of=("position_mse",),
        over_frames=lambda mse: math.sqrt(FirstFrames(20)(mse)),
        per_frame=False,
        horizon=20,
    ),
    *(
        m
        for name in (None, *MATERIALS)
        for m in _errors("velocity", "length/frame", name)
    ),
    attribute_mse,
    *_over_rollouts(),
)
"""Metrics of this family."""
