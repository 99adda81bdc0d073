"""A metric: a statistic of a frame pair and how frames become one number.

Statistics are taken per (scenario, frame); everything else (roots, ratios, horizons) is a
function of their series over frames, so that a statistic is measured once however many
metrics use it. A metric of another package is a :class:`Metric` as well.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass

from lagbench.errors import UsageError

from .frame import Floats, FramePair
from .reductions import mean

__all__ = [
    "MINIMUM_NODES",
    "Direction",
    "Metric",
    "always",
    "at_slow_frames",
    "enough_nodes",
    "identity",
]

MINIMUM_NODES = 16
"""With fewer compared nodes the metrics of vorticity and divergence are undefined."""


class Direction(enum.StrEnum):
    """What better means."""

    LOWER = "lower"
    HIGHER = "higher"
    TARGET = "target"  # the closer to the perfect value the better
    NONE = "none"  # an observable: shown, not judged


def always(_: FramePair) -> bool:
    """Return True: measured, or defined, in every frame."""
    return True


def at_slow_frames(pair: FramePair) -> bool:
    """Tell whether this is a frame of interest or the last one."""
    return pair.frame in pair.scenario.setting.slow_frames


def enough_nodes(pair: FramePair) -> bool:
    """Tell whether there are nodes enough to speak of a vorticity field."""
    return pair.node_count >= MINIMUM_NODES


def identity(values: Floats) -> Floats:
    """Return a series as it is."""
    return values


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One entry of the table of metrics.

    NaN policy: where ``applies`` says no (no such material, not a slow frame) nothing is
    measured: an expected gap, not counted. Where ``defined`` says no, or a statistic is NaN,
    the frame is undefined: left out of the mean and counted.
    """

    name: str  # unique name
    family: str  # group of metrics that are shown together
    unit: str  # unit of the value
    direction: Direction  # what better means
    source: str  # equation or section that defines it
    summary: str  # what it says, one line
    perfect: float | None = None  # value of a perfect prediction; None where it depends on truth or task
    # value for one frame pair; None where the metric follows from others' series
    statistic: Callable[[FramePair], float] | None = None
    applies: Callable[[FramePair], bool] = always  # whether the statistic is measured for a frame pair
    defined: Callable[[FramePair], bool] = always  # whether it is defined there; otherwise it is NaN
    of: tuple[str, ...] = ()  # names of the statistics that 'series' takes, its own by default
    # value per frame from the series of those statistics, shape [frame]
    series: Callable[..., Floats] = identity
    over_frames: Callable[[Floats], float] = mean  # one number of a scenario from the value per frame
    per_frame: bool = True  # whether the value at a single frame means anything
    horizon: int = 1  # predicted frames needed; smaller tasks do not have the metric
    extra: str | None = None  # extra of lagbench that it needs; such a metric is measured only when asked for

    def __post_init__(self) -> None:
        """Fill in ``of``; refuse a metric that nothing could be computed for or judged by.

        Raises:
            UsageError: neither statistic nor others' series, or a target without its value.
        """
        if self.statistic is None and not self.of:
            raise UsageError(f"metric {self.name!r} has neither a statistic nor others to follow from")
        if self.perfect is None and self.direction is Direction.TARGET:
            raise UsageError(f"metric {self.name!r} aims at a target and does not say which")
        if not self.of:
            object.__setattr__(self, "of", (self.name,))

    def measure(self, pair: FramePair) -> float:
        """Return the statistic of a frame pair, NaN where it is undefined."""
        if self.statistic is None or not self.defined(pair):
            return math.nan
        return float(self.statistic(pair))

    def loss(self, value: float) -> float:
        """Return the value turned so that smaller is better.

        Raises:
            UsageError: an observable is not judged.
        """
        if self.direction is Direction.NONE:
            raise UsageError(f"{self.name} is an observable: it ranks nothing")
        if self.direction is Direction.TARGET and self.perfect is not None:
            return abs(value - self.perfect)
        return -value if self.direction is Direction.HIGHER else value
