"""From frames to scores: tallies that add, one number per scenario, a mean with its
interval.

RMSE is the root of the frame mean of MSE within a scenario, then the mean over
scenarios; every other metric is the mean over frames, then over scenarios. Undefined
frames are left out and counted; so is a scenario without a defined frame. Scenarios are
taken in id order.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import NormalDist
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.errors import UsageError

from .frame import Floats, FramePair
from .metric import Metric, mean

LARGEST = float(np.finfo(np.float32).max)

LONG_ROLLOUT = 100
"""Predicted frames beyond which statistics are rounded more coarsely than float32."""

LONG_BITS = 11
"""Significant bits of statistics of a long rollout: a relative error of 4.9e-4 at most.
"""

LEVEL = 0.95
"""Share of the resampled means that an interval holds."""

RESAMPLES = 10_000
"""Resamples of scenarios and of seeds."""

FEWEST_FOR_INTERVAL = 4
"""Scenarios below which no interval is given: of three, Student's quantile alone
doubles its width.
"""


@dataclass(frozen=True, eq=False)
class Tally:
    """Statistics of a scenario as sums that add, so that chunks and workers combine.

    Every (statistic, frame) holds a sum and its weight. Pieces measured apart have
    disjoint frames, and adding a zero changes no bit: any chunking, in any order, gives
    the same bytes.
    """

    names: tuple[str, ...]  # of the statistics
    frames: tuple[int, ...]  # absolute frame numbers
    total: Floats  # sum of the defined values, shape [statistic, frame]
    # how many defined values that is, shape [statistic, frame]
    weight: NDArray[np.int64]
    undefined: NDArray[np.int64]  # how many values were NaN, shape [statistic, frame]

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        frames: Sequence[int],
        measured: Mapping[int, Mapping[str, float]],
    ) -> Self:
        """Return the tally of values by frame and name; what is missing weighs
        nothing.
        """
        row = {name: i for i, name in enumerate(names)}
        column = {frame: i for i, frame in enumerate(frames)}
        values = np.zeros((len(row), len(column)))
        seen = np.zeros(values.shape, np.int64)
        for frame, statistics in measured.items():
            for name, value in statistics.items():
                if name not in row or frame not in column:
                    raise UsageError(
                        f"statistic {name!r} at frame {frame} has no place in the tally"
                    )
                values[row[name], column[frame]] = value
                seen[row[name], column[frame]] = 1
        nan = np.isnan(values)
        return cls(
            tuple(names),
            tuple(frames),
            np.where(nan, 0.0, values),
            seen * ~nan,
            seen * nan,
        )

    def __add__(self, other: Tally) -> Tally:
        """Combine two pieces of the same scenario."""
        if (self.names, self.frames) != (other.names, other.frames):
            raise UsageError("tallies of different statistics or frames do not add")
        total = self.total + other.total
        weight = self.weight + other.weight
        return Tally(
            self.names, self.frames, total, weight, self.undefined + other.undefined
        )

    @cached_property
    def _rows(self) -> Mapping[str, tuple[Floats, NDArray[np.bool_]]]:
        """Value and whether it was measured, by statistic, each of shape [frame]."""
        values = np.full(self.total.shape, np.nan)
        np.divide(self.total, self.weight, out=values, where=self.weight > 0)
        measured = self.weight + self.undefined > 0
        values.flags.writeable = measured.flags.writeable = False
        return dict(zip(self.names, zip(values, measured, strict=True), strict=True))

    def __getstate__(self) -> dict[str, object]:
        """Leave out what is read off the sums when they go to another process."""
        return {name: value for name, value in self.__dict__.items() if name != "_rows"}

    def series(self, name: str) -> Floats:
        """Return a statistic per frame, NaN where it has no value: shape [frame],
        read-only.
        """
        return self._rows[name][0]

    def measured(self, name: str) -> NDArray[np.bool_]:
        """Tell at which frames a statistic was measured, defined or not: shape [frame],
        read-only.
        """
        return self._rows[name][1]


def as_stored(tally: Tally) -> Tally:
    """Return a tally rounded as scores.nc holds it: to float32, of long rollouts to 11
    bits.

    Scores are formed from rounded statistics, so that whoever aggregates scores.nc
    again gets the same digits. Long rollouts have so many frames that their float32
    would not fit into a small file, and that rounding averages out. Beyond float32 a
    statistic saturates.
    """
    total = tally.total
    if len(tally.frames) > LONG_ROLLOUT:
        mantissa, exponent = np.frexp(total)
        total = np.ldexp(np.rint(np.ldexp(mantissa, LONG_BITS)), exponent - LONG_BITS)
    stored = np.clip(total, -LARGEST, LARGEST).astype(np.float32)
    return replace(tally, total=stored.astype(np.float64))


def measure(pair: FramePair, metrics: Iterable[Metric]) -> dict[str, float]:
    """Return the statistics of one frame pair by name, NaN where one is undefined."""
    found = {}
    for metric in metrics:
        if metric.statistic is None:
            continue
        try:
            applies = metric.applies(pair)
        except (Exception, SystemExit) as error:
            metric.blame(error, f"frame {pair.frame}")
        if applies:
            found[metric.name] = metric.measure(pair)
    return found


def tally(
    pairs: Iterable[FramePair], metrics: Sequence[Metric], frames: Sequence[int]
) -> Tally:
    """Measure consecutive frame pairs, holding one at a time."""
    names = [m.name for m in metrics if m.statistic is not None]
    return Tally.of(
        names, frames, {pair.frame: measure(pair, metrics) for pair in pairs}
    )


@functools.cache
def _shares(count: int, stream: int) -> Floats:
    """Return the share of each of some things in draws with replacement, shape
    [resample, thing].
    """
    # Generator.random is the one distribution whose stream NumPy keeps across versions
    uniform = np.random.Generator(np.random.PCG64(stream)).random((RESAMPLES, count))
    drawn = (
        np.floor(uniform * count).astype(np.intp)
        + count * np.arange(RESAMPLES)[:, None]
    )
    return (
        np.bincount(drawn.ravel(), minlength=RESAMPLES * count).reshape(
            RESAMPLES, count
        )
        / count
    )


@dataclass(frozen=True, eq=False)
class Resampling:
    """A mean over seeds and scenarios, and how far others of both would lead it."""

    mean: float
    # deviations of the things that are drawn, by stream: scenarios, seeds
    parts: Mapping[int, Floats]

    @cached_property
    def deviations(self) -> Floats:
        """Resampled means minus the mean, shape [resample]."""
        drawn = [
            math.sqrt(len(part) / (len(part) - 1))
            * np.einsum("rn,n->r", _shares(len(part), stream), part)
            for stream, part in self.parts.items()
        ]
        return np.asarray(np.sum(drawn, axis=0))

    @property
    def _variances(self) -> list[float]:
        return [
            float(np.sum(x**2)) / (len(x) * (len(x) - 1)) for x in self.parts.values()
        ]

    @property
    def error(self) -> float:
        """Standard deviation of the resampled means, without drawing."""
        return math.sqrt(math.fsum(self._variances))

    @property
    def freedom(self) -> float:
        """Degrees of freedom behind the error, after Satterthwaite."""
        drawn = zip(self._variances, self.parts.values(), strict=True)
        squares = math.fsum(v**2 / (len(x) - 1) for v, x in drawn)
        if squares:
            return math.fsum(self._variances) ** 2 / squares
        return math.inf

    @property
    def interval(self) -> tuple[float, float]:
        """95 % percentile interval, as much wider as Student's quantile exceeds the
        normal one's.

        NaN of fewer than four scenarios.
        """
        if len(self.parts[0]) < FEWEST_FOR_INTERVAL:
            return math.nan, math.nan
        if not self.error:
            return self.mean, self.mean
        tails = (1.0 - LEVEL) / 2.0, (1.0 + LEVEL) / 2.0
        wider = student_quantile(self.freedom, tails[1]) / NormalDist().inv_cdf(
            tails[1]
        )
        low, high = (
            self.mean + wider * tail for tail in quantiles(self.deviations, tails)
        )
        return low, high


def quantiles(values: Floats, shares: Sequence[float]) -> list[float]:
    """Return quantiles of two or more values, linear between them: the bits of
    ``np.quantile``.

    Only what stands beside them is put in its place, which takes a small part of the
    time of a sort.
    """
    places = [share * (len(values) - 1) for share in shares]
    lower = [min(int(place), len(values) - 2) for place in places]
    placed = np.partition(values, [i for below in lower for i in (below, below + 1)])
    found = []
    for place, below in zip(places, lower, strict=True):
        part, (low, high) = place - below, placed[below : below + 2].tolist()
        found.append(
            low + (high - low) * part
            if part < 0.5
            else high - (high - low) * (1.0 - part)
        )
    return found


@functools.cache
def student_quantile(freedom: float, share: float) -> float:
    """Return the quantile of Student's distribution, for shares up to 0.999 what SciPy
    returns to rounding.

    For whole degrees of freedom, which those of a single seed are, by Newton's method
    on the finite sums 26.7.3 and 26.7.4 of Abramowitz and Stegun: SciPy takes a quarter
    of a second to import. Shares are from 0.5 to 1.
    """
    # longer sums take longer; nan is not rounded
    whole = round(freedom) if 3 <= freedom <= 1000 else 0
    if not whole or abs(freedom - whole) > 1e-9:
        from scipy.special import stdtrit

        return float(stdtrit(freedom, share))
    odd = whole % 2
    angle = 0.0
    # density of the angle atan(t / sqrt(freedom)) in units of that of its first term
    scale = math.exp(math.lgamma((whole + 1) / 2) - math.lgamma(whole / 2)) / math.sqrt(
        math.pi
    )
    for _ in range(12):  # from four steps on few change more than the last digits
        sine = math.sin(angle)
        cosine = math.cos(angle)
        term = sine * (cosine if odd else 1.0)
        within = term
        for k in range(2 + odd, whole - 1, 2):
            term *= cosine**2 * (k - 1) / k
            within += term
        if odd:
            within = 2.0 / math.pi * (angle + within)
        else:
            within = within
        angle += (2.0 * share - 1.0 - within) / (2.0 * scale * cosine ** (whole - 1))
    return math.sqrt(whole) * math.tan(angle)


def mean_over_seeds(values: ArrayLike) -> Floats:
    """Return the mean over the seeds that have a value, NaN where none has: shape
    without the first axis.
    """
    seeds = np.asarray(values, np.float64)
    known = ~np.isnan(seeds)
    total = np.where(known, seeds, 0.0).sum(axis=0)
    count = known.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), math.nan)


def resample(values: ArrayLike, minus: ArrayLike | None = None) -> Resampling | None:
    """Draw scenarios and seeds with replacement: the two-way bootstrap of a mean.

    The value of seed s in scenario i is read as ``mean + b_i + a_s`` and a rest. The
    means over seeds ``b_i`` and those over scenarios ``a_s`` are drawn independently of
    each other, each stretched by ``sqrt(n / (n - 1))`` so that few seeds do not look
    alike by being few::

        Var = sum_i b_i^2 / (N (N - 1)) + sum_s a_s^2 / (S (S - 1))

    The rest enters both sums once, which errs on the side of too wide. With one seed
    only the scenarios are drawn: the mean is then that of these weights, not of the
    method. The draws are seeded: two calls with as many scenarios draw the same ones.

    Values are NaN where undefined, shape [scenario] or [seed, scenario]; with those of
    another method in the same scenarios as ``minus`` the mean is that of the
    difference. None where fewer than two scenarios are defined. Infinite values, and
    methods in different scenarios, are refused.
    """
    sides = [
        np.atleast_2d(np.asarray(side, np.float64))
        for side in (values, minus)
        if side is not None
    ]
    if len({side.shape[1] for side in sides}) > 1:
        expected, got = (side.shape[1] for side in sides)
        raise UsageError("methods over different scenarios", expected=expected, got=got)
    if any(np.isinf(side).any() for side in sides):
        raise UsageError(
            "losses are infinite",
            expected="numbers, NaN where undefined",
            got="infinity",
        )
    defined = np.all([~np.isnan(side).all(axis=0) for side in sides], axis=0)
    if np.count_nonzero(defined) < 2:
        return None
    means = np.zeros(np.count_nonzero(defined))
    seeds = []
    for sign, side in zip((1.0, -1.0), sides, strict=False):
        kept = side[:, defined]
        over_seeds = mean_over_seeds(kept)
        means += sign * over_seeds
        rows = np.array([mean(row) for row in kept - over_seeds])
        seeds.append(sign * rows[~np.isnan(rows)])
    parts = {
        stream: part - np.mean(part)
        for stream, part in enumerate([means, *seeds])
        if len(part) > 1
    }
    return Resampling(mean=float(np.mean(means)), parts=parts)


def bootstrap_interval(
    values: ArrayLike, minus: ArrayLike | None = None
) -> tuple[float, float]:
    """Return the 95 % interval of a mean by the two-way bootstrap, which takes these:
    :func:`resample`.

    NaN when fewer than four scenarios are defined.
    """
    found = resample(values, minus)
    if found is None:
        return (math.nan, math.nan)
    return found.interval


@dataclass(frozen=True, eq=False)
class Score:
    """What a metric says of one prediction."""

    metric: Metric
    scenarios: tuple[int, ...]  # ids, ascending
    frames: tuple[int, ...]  # absolute numbers of the predicted frames
    per_frame: Floats  # NaN where not measured or undefined, shape [scenario, frame]
    values: Floats  # over the horizon, shape [scenario]
    undefined: tuple[int, ...]  # measured frames without a value, shape [scenario]

    @property
    def mean(self) -> float:
        """Mean over the scenarios that have a value."""
        return mean(self.values)

    @cached_property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the mean of these weights, by bootstrap over scenarios."""
        return bootstrap_interval(self.values)

    def at(self, frame: int) -> Floats:
        """Return the value at one absolute frame, shape [scenario]."""
        return self.per_frame[:, self.frames.index(frame)]


def score(metric: Metric, tallies: Mapping[int, Tally]) -> Score | None:
    """Return the score of one metric, None where it was measured nowhere or the task is
    too short.
    """
    if not tallies:
        return None
    scenarios = tuple(sorted(tallies))
    frames = tallies[scenarios[0]].frames
    asked = np.array(
        [
            np.all([tallies[i].measured(name) for name in metric.of], axis=0)
            for i in scenarios
        ]
    )
    if metric.horizon > len(frames) or not asked.any():
        return None
    try:
        rows = [metric.series(*map(tallies[i].series, metric.of)) for i in scenarios]
        series = np.stack([np.asarray(row, np.float64) for row in rows])
        if metric.over_frames is mean and not np.isnan(series).any():
            # all rows at once, to the same bits
            values = np.asarray(series.mean(axis=1))
        else:
            values = np.array([metric.over_frames(row) for row in series])
    except (Exception, SystemExit) as error:
        metric.blame(error, "over all frames")
    undefined = tuple(np.count_nonzero(asked & np.isnan(series), axis=1).tolist())
    return Score(metric, scenarios, frames, series, values, undefined)


def aggregate(
    metrics: Iterable[Metric], tallies: Mapping[int, Tally]
) -> dict[str, Score]:
    """Return the scores of all metrics that this split and size have, by name."""
    scores = {metric.name: score(metric, tallies) for metric in metrics}
    return {name: found for name, found in scores.items() if found is not None}
