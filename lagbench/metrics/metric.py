"""A metric: a statistic of a frame pair, and how frames become one number.

Statistics are taken per (scenario, frame); everything else (roots, ratios, horizons) is
a function of their series over frames, so that a statistic is measured once however
many metrics use it. A metric of another package is a :class:`Metric` as well.
"""

from __future__ import annotations

import enum
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagbench.errors import UsageError, WorkFailedError

from .frame import Floats, FramePair

MINIMUM_NODES = 16
"""With fewer compared nodes the metrics of vorticity and divergence are undefined."""

SMALLEST_SCALE = 1e-3
"""Least scale of an error, as a share of the truth's greatest value."""


class Direction(enum.StrEnum):
    """Which values of a metric are better."""

    LOWER = "lower"
    HIGHER = "higher"
    TARGET = "target"  # the closer to the perfect value the better
    NONE = "none"  # an observable: shown, not judged


def always(_: FramePair) -> bool:
    """Return True: measured, or defined, in every frame."""
    return True


def at_slow_frames(pair: FramePair) -> bool:
    """Return whether this is a frame of interest or the last one."""
    return pair.frame in pair.scenario.config.slow_frames


def enough_nodes(pair: FramePair) -> bool:
    """Return whether enough nodes are compared for a vorticity field."""
    return pair.node_count >= MINIMUM_NODES


def has_rotation(pair: FramePair) -> bool:
    """Return whether nodes are enough and the truth's vorticity is not rounding."""
    return enough_nodes(pair) and pair.truth_rotates


def has_material(pair: FramePair, materials: tuple[str, ...]) -> bool:
    """Return whether the scenario has particles of one of some materials."""
    return any(material in pair.scenario.members for material in materials)


def identity(values: Floats) -> Floats:
    """Return a series as it is."""
    return values


def quotient(numerator: Floats, denominator: Floats) -> Floats:
    """Return the ratio of two series, NaN where the denominator is 0, shape [frame]."""
    ratio = np.full(len(numerator), np.nan)
    np.divide(numerator, denominator, out=ratio, where=denominator != 0.0)
    return ratio


def scaled_error(error: Floats, scale: Floats) -> Floats:
    """Return ``error / max(scale, 1e-3 max(scale))``, shape [frame].

    The least scale keeps frames in which the truth rests from dominating the mean. NaN
    where all scales are 0.
    """
    greatest = np.max(scale, initial=0.0, where=~np.isnan(scale))
    return quotient(error, np.maximum(scale, SMALLEST_SCALE * greatest))


def mean(values: Floats) -> float:
    """Return the mean over the defined frames, NaN if there are none."""
    defined = values[~np.isnan(values)]
    if not defined.size:
        return math.nan
    return float(np.mean(defined))


def mean_of_rows(values: Floats) -> Floats:
    """Return :func:`mean` of each row, to the same bits.

    Most metrics have the same gaps in all rows. An example are those that are measured
    at every tenth frame. Then all rows are taken at once.

    >>> mean_of_rows(np.array([[1.0, math.nan, 3.0], [4.0, math.nan, 8.0]])).tolist()
    [2.0, 6.0]
    """
    is_defined = ~np.isnan(values)
    has_same_gaps = bool((is_defined == is_defined[:1]).all())
    if has_same_gaps and is_defined[:1].any():
        defined = np.compress(is_defined[0], values, axis=1)
        return np.asarray(defined.mean(axis=1))
    return np.array([mean(row) for row in values])


def root_mean_square(values: Floats) -> float:
    """Return ``sqrt(mean(values^2))`` over the defined frames.

    Of RMSE per frame it is the root of the frame mean of MSE.
    """
    return math.sqrt(mean(values**2))


def last(values: Floats) -> float:
    """Return the value at the last frame (Eq. 4.18)."""
    return float(values[-1])


def total(values: Floats) -> float:
    """Return the sum over the defined frames, NaN if there are none."""
    defined = values[~np.isnan(values)]
    if not defined.size:
        return math.nan
    return float(np.sum(defined))


@dataclass(frozen=True)
class FirstFrames:
    """A reduction of the first predicted frames only; NaN when there are fewer."""

    count: int  # predicted frames that are taken
    reduction: Callable[[Floats], float] = mean  # of these frames

    def __call__(self, values: Floats) -> float:
        """Return the reduction of those frames."""
        if len(values) < self.count:
            return math.nan
        return self.reduction(values[: self.count])


NAME = re.compile("[a-z][a-z0-9_]{0,63}")
"""Names that metrics may have: names in scores.nc are split at blanks."""

RESERVED = ("skill",)
"""Names that no metric may have: tables have a row `skill`."""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One entry of the table of metrics.

    NaN policy: where ``applies`` is False (no such material, not a slow frame) nothing
    is measured: an expected gap, not counted. Where ``defined`` is False, or a
    statistic is NaN, the frame is undefined: left out of the mean and counted.

    Raises:
        UsageError: both ``statistic`` and ``of`` are missing, or a name does not
            consist of small letters, digits and underscores.
    """

    name: str  # unique
    family: str  # metrics that are shown together
    unit: str  # of the value
    direction: Direction  # which values are better
    source: str  # equation, section or paper that defines it
    summary: str  # its meaning, one line
    # value of a perfect prediction; None where it depends on truth or task
    perfect: float | None = None
    # ends of the values that it can have, at which intervals are cut off; None: without
    # end, or the perfect value where less, or more, is better
    least: float | None = None
    greatest: float | None = None
    # of one frame pair; None if it follows from others
    statistic: Callable[[FramePair], float] | None = None
    # whether the statistic is measured for a frame pair
    applies: Callable[[FramePair], bool] = always
    # whether it is defined there; otherwise it is NaN
    defined: Callable[[FramePair], bool] = always
    of: tuple[str, ...] = ()  # statistics that ``series`` takes, its own by default
    # value per frame from those, which are read-only, shape [frame]
    series: Callable[..., Floats] = identity
    # one number of a scenario from the value per frame
    over_frames: Callable[[Floats], float] = mean
    per_frame: bool = True  # whether the value at a single frame has a meaning
    horizon: int = 1  # predicted frames needed; smaller tasks do not have the metric
    # extra of lagbench that it needs; measured only when asked for
    extra: str | None = None
    module: str | None = None  # module of that extra that the statistic imports

    def __post_init__(self) -> None:
        """Fill in ``of``; refuse a metric that is incomplete or has no usable name."""
        names = tuple(self.of) or (self.name,)
        for name in (self.name, *names):
            if not NAME.fullmatch(name) or name in RESERVED:
                raise UsageError(
                    f"{name!r:.80} names no metric; take up to 64 small letters, "
                    "digits and underscores, as in my_error, not skill"
                )
        if self.statistic is None and not self.of:
            raise UsageError(
                "no statistic; decorate its function, or name others by of=",
                where=f"metric {self.name!r}",
            )
        object.__setattr__(self, "direction", Direction(self.direction))
        object.__setattr__(self, "of", names)

    def measure(self, pair: FramePair) -> float:
        """Return the statistic of a frame pair, NaN where it is undefined.

        Raises:
            WorkFailedError: a function of the metric fails, or gives no number.
        """
        if self.statistic is None:
            return math.nan
        try:
            if not self.defined(pair):
                return math.nan
            return float(self.statistic(pair))
        except Exception as error:
            raise self.failure(error, f"frame {pair.frame}") from error

    def failure(self, error: Exception, place: str) -> WorkFailedError:
        """Return the error for a function of the metric that fails."""
        return WorkFailedError(
            f"the metric {self.name} failed, {place}: {type(error).__name__}: "
            f"{str(error)[:200]}; mend it, or uninstall the package that adds it"
        )

    @property
    def is_on_request(self) -> bool:
        """Whether it is of an extra, though every score file has its statistics."""
        return self.extra is not None and self.statistic is None

    @property
    def value_range(self) -> tuple[float, float]:
        """Least and greatest value that the metric can have, infinite without end."""
        least = self.least
        greatest = self.greatest
        if least is None and self.direction is Direction.LOWER:
            least = self.perfect
        if greatest is None and self.direction is Direction.HIGHER:
            greatest = self.perfect
        return (
            -math.inf if least is None else least,
            math.inf if greatest is None else greatest,
        )

    def loss(self, value: float) -> float:
        """Return the value turned so that smaller is better.

        Raises:
            UsageError: an observable is not judged.
        """
        if self.direction is Direction.NONE:
            raise UsageError(
                f"{self.name} is an observable, which ranks nothing; compare by another"
            )
        if self.direction is Direction.TARGET and self.perfect is not None:
            return abs(value - self.perfect)
        if self.direction is Direction.HIGHER:
            return -value
        return value


def metric(
    *,
    unit: str,
    source: str,
    direction: Direction = Direction.NONE,
    perfect: float | None = None,
    of: tuple[str, ...] = (),
    family: str | None = None,
    **fields: Any,  # noqa: ANN401 - further fields of Metric, as they are
) -> Callable[[Callable[..., Any]], Metric]:
    """Return a decorator that makes a metric of a function.

    Name and summary are the function's name and the first paragraph of its docstring.
    The function takes a frame pair and is the statistic; with ``of`` it takes the
    series of those statistics and returns the value per frame.
    """
    if perfect is None and direction is Direction.LOWER:
        perfect = 0.0

    def make_metric(function: Callable[..., Any]) -> Metric:
        paragraph, _, _ = (function.__doc__ or "").strip().partition("\n\n")
        if of:
            fields.update(of=of, series=function)
        else:
            fields.update(statistic=function)
        return Metric(
            name=function.__name__,
            family=family or function.__module__.rpartition(".")[2],
            unit=unit,
            direction=direction,
            source=source,
            summary=" ".join(paragraph.split()).rstrip("."),
            perfect=perfect,
            **fields,
        )

    return make_metric


def metrics_of(module: Mapping[str, object]) -> tuple[Metric, ...]:
    """Return the metrics among the names of a module, in order of definition."""
    return tuple(value for value in module.values() if isinstance(value, Metric))
