"""Errors of total momentum and angular momentum, scaled by the truth's motion.

The scale adds magnitudes, so it does not vanish where the momenta of a closed flow cancel;
where the truth comes to rest it has a floor. All particles of a scenario have one mass; it
cancels, and gap and scale are told over it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from .frame import Floats, FramePair, Snapshot
from .metric import Direction, Metric
from .reductions import floored_quotient

__all__ = ["METRICS", "angular_momentum", "momentum"]


def momentum(snapshot: Snapshot) -> Floats:
    """Return ``sum(u)``: momentum over the particle mass [length/frame], shape [2]."""
    return np.asarray(np.sum(snapshot.velocity, axis=0))


def angular_momentum(snapshot: Snapshot, centre: tuple[float, float]) -> float:
    """Return ``sum(r x u)`` about the centre (Eq. 5.1), over the particle mass [length^2/frame]."""
    r, u = snapshot.position - centre, snapshot.velocity
    return float(np.sum(r[:, 0] * u[:, 1] - r[:, 1] * u[:, 0]))


def _length(vectors: Floats) -> Floats:
    """Return the Euclidean length of vectors, shape [particle]."""
    return np.sqrt(vectors[:, 0] ** 2 + vectors[:, 1] ** 2)


def momentum_gap(pair: FramePair) -> float:
    """Return ``|P_pred - P_true|`` over the particle mass [length/frame]."""
    dx, dy = momentum(pair.prediction) - momentum(pair.truth)
    return math.hypot(dx, dy)


def momentum_scale(pair: FramePair) -> float:
    """Return ``sum(|u|)`` of the truth [length/frame]."""
    return float(np.sum(_length(pair.truth.velocity)))


def angular_momentum_gap(pair: FramePair) -> float:
    """Return ``|L_pred - L_true|`` over the particle mass [length^2/frame]."""
    centre = pair.scenario.setting.centre
    return abs(angular_momentum(pair.prediction, centre) - angular_momentum(pair.truth, centre))


def angular_momentum_scale(pair: FramePair) -> float:
    """Return ``sum(|r| |u|)`` of the truth, r from the box centre [length^2/frame]."""
    arms = _length(pair.truth.position - pair.scenario.setting.centre)
    return float(np.sum(arms * _length(pair.truth.velocity)))


def _metrics(
    name: str,
    *,
    unit: str,
    source: str,
    text: str,
    gap: Callable[[FramePair], float],
    scale: Callable[[FramePair], float],
) -> Iterator[Metric]:
    """Yield the error of a momentum, its scale, and the error over the floored scale."""
    observed = {f"{name}_gap": (gap, f"error of {text}, unscaled")}
    observed[f"{name}_scale"] = (scale, f"the truth's sum of magnitudes that scales {name}_error")
    for observable, (statistic, summary) in observed.items():
        yield Metric(
            name=observable,
            family="momentum",
            unit=unit,
            direction=Direction.NONE,
            source=source,
            summary=summary,
            statistic=statistic,
        )
    yield Metric(
        name=f"{name}_error",
        family="momentum",
        unit="1",
        direction=Direction.LOWER,
        perfect=0.0,
        source=source,
        summary=f"error of {text} over its scale (at least 1e-3 of its greatest)",
        of=tuple(observed),
        series=floored_quotient,
    )


METRICS = (
    *_metrics(
        "momentum",
        unit="length/frame",
        source="section 5.2",
        text="total momentum",
        gap=momentum_gap,
        scale=momentum_scale,
    ),
    *_metrics(
        "angular_momentum",
        unit="length^2/frame",
        source="section 5.2, Eq. 5.1",
        text="angular momentum about the box centre",
        gap=angular_momentum_gap,
        scale=angular_momentum_scale,
    ),
)
"""Metrics of this family."""
