"""Errors of particles: position, velocity, and all attributes standardised.

The particle of the prediction is the particle of the truth: order matters, and a swapped
pair is an error even where the picture is the same. On chaotic flows these errors saturate
at the size of the flow; then vorticity and transport say more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from lagbench.data.writer import MATERIALS

from .frame import Floats, FramePair
from .metric import Direction, Metric
from .reductions import FirstFrames, last, mean, root_mean_square

__all__ = ["HORIZONS", "METRICS", "attribute_mse", "mean_absolute_error", "mean_squared_error"]

HORIZONS = (1, 5, 10, 20, 50)
"""Predicted frames at which ``mse_avg`` and ``mse_end`` are taken besides the whole rollout."""

SQUARED = {"length": "length^2", "length/frame": "length^2/frame^2"}


def mean_squared_error(error: Floats) -> float:
    """Return ``MSE = mean((y - yhat)^2)`` over particles and components (Eq. 3.3)."""
    return float(np.mean(error**2))


def mean_absolute_error(error: Floats) -> float:
    """Return ``MAE = mean(|y - yhat|)`` over particles and components (Eq. 3.4)."""
    return float(np.mean(np.abs(error)))


def attribute_mse(pair: FramePair) -> float:
    """Return ``L = sum((y - yhat)^2) / (N k)`` over z-scores of (x, y, u, v) (Eqs. 4.15, 4.16).

    The means of Eq. 4.15 cancel in the difference. 0 is perfect; 1 is the error of always
    predicting the mean of train.
    """
    std = np.array(pair.scenario.setting.attribute_std)
    error = np.concatenate([np.mean(pair.position_error**2, axis=0), np.mean(pair.velocity_error**2, axis=0)])
    return float(np.mean(error / std**2))


def position_error(pair: FramePair) -> Floats:
    """Return predicted minus true position [length], shape [particle, 2]."""
    return pair.position_error


def velocity_error(pair: FramePair) -> Floats:
    """Return predicted minus true per-frame velocity [length/frame], shape [particle, 2]."""
    return pair.velocity_error


@dataclass(frozen=True)
class ErrorMean:
    """Mean of a particle error over all particles, or over those of one material."""

    error: Callable[[FramePair], Floats]  # the error of all particles, shape [particle, 2]
    law: Callable[[Floats], float]  # mean_squared_error or mean_absolute_error
    material: str | None = None  # name of a material, None for all

    def __call__(self, pair: FramePair) -> float:
        """Return the mean for one frame pair."""
        error = self.error(pair)
        return self.law(error if self.material is None else error[pair.scenario.members[self.material]])

    def applies(self, pair: FramePair) -> bool:
        """Tell whether the split has several materials and the scenario has this one."""
        scenario = pair.scenario
        several = len(scenario.setting.materials) > 1
        return self.material is None or (several and self.material in scenario.members)


def _errors(
    quantity: str, unit: str, error: Callable[[FramePair], Floats], material: str | None
) -> Iterator[Metric]:
    """Yield MSE, MAE and RMSE of one quantity over one material."""
    whose = "all particles" if material is None else f"{material} particles"
    suffix = "" if material is None else f"_{material}"
    laws = {"mse": (mean_squared_error, SQUARED[unit], "3.3"), "mae": (mean_absolute_error, unit, "3.4")}
    for name, (law, law_unit, equation) in laws.items():
        statistic = ErrorMean(error, law, material)
        yield Metric(
            name=f"{quantity}_{name}{suffix}",
            family="pointwise",
            unit=law_unit,
            direction=Direction.LOWER,
            perfect=0.0,
            source=f"Eq. {equation}",
            summary=f"mean {'squared' if name == 'mse' else 'absolute'} {quantity} error of {whose}",
            statistic=statistic,
            applies=statistic.applies,
        )
    yield Metric(
        name=f"{quantity}_rmse{suffix}",
        family="pointwise",
        unit=unit,
        direction=Direction.LOWER,
        perfect=0.0,
        source="Eq. 3.3",
        summary=f"root mean squared {quantity} error of {whose}",
        of=(f"{quantity}_mse{suffix}",),
        series=np.sqrt,
        over_frames=root_mean_square,
    )


def _attribute_errors() -> Iterator[Metric]:
    """Yield ``attribute_mse`` and its mean and end over the rollout and at the horizons."""
    yield Metric(
        name="attribute_mse",
        family="pointwise",
        unit="1",
        direction=Direction.LOWER,
        perfect=0.0,
        source="Eqs. 4.15, 4.16",
        summary="mean squared error of standardised position and velocity",
        statistic=attribute_mse,
    )
    whole = {"mse_avg": (mean, "4.17", "mean"), "mse_end": (last, "4.18", "last")}
    for name, (reduction, equation, word) in whole.items():
        for horizon in (None, *HORIZONS):
            over = reduction if horizon is None else FirstFrames(horizon, end=reduction is last)
            frames = "the rollout" if horizon is None else f"the first {horizon} frames"
            yield Metric(
                name=name if horizon is None else f"{name}_{horizon}",
                family="pointwise",
                unit="1",
                direction=Direction.LOWER,
                perfect=0.0,
                source=f"Eq. {equation}",
                summary=f"{word} attribute_mse of {frames}",
                of=("attribute_mse",),
                over_frames=over,
                per_frame=False,
                horizon=horizon or 1,
            )


METRICS = (
    *(m for name in (None, *MATERIALS) for m in _errors("position", "length", position_error, name)),
    *(m for name in (None, *MATERIALS) for m in _errors("velocity", "length/frame", velocity_error, name)),
    *_attribute_errors(),
)
"""Metrics of this family."""
