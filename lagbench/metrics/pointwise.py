"""Errors of particles: position, velocity, and all attributes standardised.

Each particle of the prediction is compared with the same particle of the truth: order
matters, and a swapped pair is an error even where the picture is the same. On chaotic
flows these errors saturate at the size of the flow; then vorticity and transport say
more, and ``position_rmse_20`` stops while most flows can still be followed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
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


def _errors(quantity: str, unit: str) -> Iterator[Metric]:
    """Yield MSE, MAE and RMSE of a quantity over all particles, then by material."""
    error = attrgetter(f"{quantity}_error")
    for material in (None, *MATERIALS):
        suffix = "" if material is None else f"_{material}"
        particles = "all particles" if material is None else f"{material} particles"

        def over_particles(
            norm: Callable[[Floats], float], material: str | None = material
        ) -> Callable[[FramePair], float]:
            def mean_error(pair: FramePair) -> float:
                if material is None:
                    return norm(error(pair))
                return norm(error(pair)[pair.scenario.members[material]])

            return mean_error

        def applies(pair: FramePair, material: str | None = material) -> bool:
            # a material has errors of its own where there are several
            is_mixed = len(pair.scenario.config.materials) > 1
            return material is None or (is_mixed and material in pair.scenario.members)

        yield _error(
            name=f"{quantity}_mse{suffix}",
            unit=SQUARED[unit],
            source="Eq. 3.3",
            summary=f"Mean squared {quantity} error of {particles}",
            statistic=over_particles(mean_squared_error),
            applies=applies,
        )
        yield _error(
            name=f"{quantity}_mae{suffix}",
            unit=unit,
            source="Eq. 3.4",
            summary=f"Mean absolute {quantity} error of {particles}",
            statistic=over_particles(mean_absolute_error),
            applies=applies,
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
    horizon, the number of whose last frame ends the summary.
    """
    rollout = partial(
        _error, unit="1", source=source, of=("attribute_mse",), per_frame=False
    )
    yield rollout(name=name, summary=summary, over_frames=reduction)
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
