"""A metric: a statistic of a frame pair and how frames become one number.

Statistics are taken per (scenario, frame); everything else (roots, ratios, horizons) is
a function of their series over frames, so that a statistic is measured once however
many metrics use it. A metric of another package is a :class:`Metric` as well.
"""

from __future__ import annotations

import enum
import math
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from lagbench.errors import UsageError, WorkFailedError

from .frame import Floats, FramePair

MINIMUM_NODES = 16
"""With fewer compared nodes the metrics of vorticity and divergence are undefined."""

SCALE_FLOOR = 1e-3
"""Share of the truth's greatest value below which errors are no longer scaled by its
value.
"""


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


def turning(pair: FramePair) -> bool:
    """Tell whether there are nodes enough and the truth's vorticity there is more than
    rounding.
    """
    return enough_nodes(pair) and pair.truth_turns


def identity(values: Floats) -> Floats:
    """Return a series as it is."""
    return values


def quotient(numerator: Floats, denominator: Floats) -> Floats:
    """Return the ratio of two series, NaN where the denominator is 0, shape [frame]."""
    ratio = np.full(len(numerator), np.nan)
    np.divide(numerator, denominator, out=ratio, where=denominator != 0.0)
    return ratio


def floored_quotient(error: Floats, scale: Floats) -> Floats:
    """Return ``error / max(scale, 1e-3 max(scale))``, shape [frame]; NaN where all
    scales are 0.

    The floor keeps frames in which the truth rests from ruling the mean.
    """
    greatest = np.max(scale, initial=0.0, where=~np.isnan(scale))
    return quotient(error, np.maximum(scale, SCALE_FLOOR * greatest))


def mean(values: Floats) -> float:
    """Return the mean over the defined frames, NaN if there are none."""
    defined = values[~np.isnan(values)]
    return float(np.mean(defined)) if defined.size else math.nan


def root_mean_square(values: Floats) -> float:
    """Return ``sqrt(mean(values^2))``: for RMSE per frame, the root of the frame mean
    of MSE.
    """
    return math.sqrt(mean(values**2))


def last(values: Floats) -> float:
    """Return the value at the last frame (Eq. 4.18)."""
    return float(values[-1])


def total(values: Floats) -> float:
    """Return the sum over the defined frames, NaN if there are none."""
    defined = values[~np.isnan(values)]
    return float(np.sum(defined)) if defined.size else math.nan


@dataclass(frozen=True)
class FirstFrames:
    """A reduction of the first predicted frames only; NaN when there are fewer."""

    count: int  # predicted frames that are taken
    reduction: Callable[[Floats], float] = mean  # what is made of them

    def __call__(self, values: Floats) -> float:
        """Return the reduction of those frames."""
        return (
            math.nan
            if len(values) < self.count
            else self.reduction(values[: self.count])
        )


NAME = re.compile("[a-z][a-z0-9_]{0,63}")
RESERVED = ("skill",)
"""What a metric may be called: stored names are split at blanks, and tables have a row
`skill`.
"""


@dataclass(frozen=True, kw_only=True)
class Metric:
    """One entry of the table of metrics.

    NaN policy: where ``applies`` says no (no such material, not a slow frame) nothing
    is measured: an expected gap, not counted. Where ``defined`` says no, or a statistic
    is NaN, the frame is undefined: left out of the mean and counted.

    Raises:
        UsageError: neither a statistic nor others' series, a text as ``of``, a target
            without its value, a name that is not of small letters, digits and
            underscores, or no direction.
    """

    name: str  # unique
    family: str  # metrics that are shown together
    unit: str  # of the value
    direction: Direction  # what better means
    source: str  # equation or section that defines it
    summary: str  # what it says, one line
    # value of a perfect prediction; None where it depends on truth or task
    perfect: float | None = None
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
    per_frame: bool = True  # whether the value at a single frame means anything
    horizon: int = 1  # predicted frames needed; smaller tasks do not have the metric
    # extra of lagbench that it needs; measured only when asked for
    extra: str | None = None

    def __post_init__(self) -> None:
        """Fill in ``of``; refuse a metric that nothing could be computed for, judged
        by, or stored under.
        """
        try:
            # a package may give a text
            object.__setattr__(self, "direction", Direction(self.direction))
        except ValueError:
            what = f"metric {self.name!r} has no such direction"
            got = repr(self.direction)
            fault = UsageError(
                what, expected=", ".join(Direction), got=got, fix="name one of these"
            )
            raise fault from None
        given: object = self.of
        if isinstance(given, str):
            what = f"metric {self.name!r} follows from a text, not from a tuple of statistics"
            raise UsageError(
                what, expected=f"({given!r},)", got=repr(given), fix="add the comma"
            )
        for name in (self.name, *self.of):
            if (
                not isinstance(name, str)
                or not NAME.fullmatch(name)
                or name in RESERVED
            ):
                expected = "up to 64 small letters, digits and underscores, as in my_error; not skill"
                raise UsageError(
                    f"no name for a metric: {name!r}",
                    expected=expected,
                    fix="rename it",
                )
        if self.statistic is None and not self.of:
            raise UsageError(
                f"metric {self.name!r} has neither a statistic nor others to "
                f"follow from"
            )
        if self.perfect is None and self.direction is Direction.TARGET:
            raise UsageError(
                f"metric {self.name!r} aims at a target and does not say which"
            )
        if not self.of:
            object.__setattr__(self, "of", (self.name,))

    def measure(self, pair: FramePair) -> float:
        """Return the statistic of a frame pair, NaN where it is undefined.

        Raises:
            WorkFailedError: it is no number, whether it is defined is neither true nor
                false, or it would end the program.
        """
        if self.statistic is None:
            return math.nan
        try:
            told: object = self.defined(pair)
            clear = isinstance(told, (bool, np.bool_))
            value: object = self.statistic(pair) if clear and told else math.nan
        except (Exception, SystemExit) as error:
            self.blame(error, f"frame {pair.frame}")
        if clear and isinstance(value, float):  # nearly always
            return float(value)
        place = f"frame {pair.frame}"
        if not clear:
            raise self._broken(
                "whether a metric is defined is neither true nor false",
                place,
                "a bool",
                told,
            )
        with suppress(
            TypeError, ValueError, OverflowError, RuntimeError
        ):  # as arrays of others raise
            if not isinstance(value, (str, bytes, complex)):
                return float(value)  # type: ignore[arg-type]
        raise self._broken("a metric gave no number", place, "a float", value)

    def blame(self, error: Exception | SystemExit, place: str) -> NoReturn:
        """Raise again what the metric raised, with name and place; what would end the
        program as a fault.
        """
        if isinstance(error, SystemExit):
            raise self._broken(
                "a metric would end the program", place, "a number", error
            ) from error
        error.add_note(f"in metric {self.name}, {place}")
        raise error

    def _broken(
        self, what: str, place: str, expected: str, got: object
    ) -> WorkFailedError:
        package = getattr(
            self.series if self.statistic is None else self.statistic, "__module__", "?"
        )
        where = f"{package}, {self.name}, {place}"
        told = f"{type(got).__name__}: {got!r:.60}"
        fix = "mend or uninstall the package that adds it"
        return WorkFailedError(what, where=where, expected=expected, got=told, fix=fix)

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


def metric(
    *,
    unit: str,
    source: str,
    direction: Direction = Direction.NONE,
    perfect: float | None = None,
    of: tuple[str, ...] = (),
    family: str | None = None,
    **more: Any,  # noqa: ANN401 - further fields of Metric, as they are
) -> Callable[[Callable[..., Any]], Metric]:
    """Make a metric of a function; its name and the first line of its docstring are the
    metric's.

    The function takes a frame pair and is the statistic; with ``of`` it takes the
    series of those statistics and returns the value per frame.
    """
    if perfect is None and direction is Direction.LOWER:
        perfect = 0.0

    def made(function: Callable[..., Any]) -> Metric:
        role: dict[str, Any]
        if of:
            role = {"of": of, "series": function}
        else:
            role = {"statistic": function}
        return Metric(
            name=function.__name__,
            family=family or function.__module__.rpartition(".")[2],
            unit=unit,
            direction=direction,
            source=source,
            summary=_first_paragraph(function.__doc__ or "").rstrip("."),
            perfect=perfect,
            **role,
            **more,
        )

    return made


def _first_paragraph(docstring: str) -> str:
    paragraph, _, _ = docstring.strip().partition("\n\n")
    return " ".join(paragraph.split())


def metrics_of(module: Mapping[str, object]) -> tuple[Metric, ...]:
    """Return the metrics among the names of a module, in the order of their
    definition.
    """
    return tuple(value for value in module.values() if isinstance(value, Metric))
