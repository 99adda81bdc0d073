"""From frames to scores: tallies that add, scores of scenarios, mean and interval.

RMSE is the root of the frame mean of MSE within a scenario, then the mean over
scenarios; every other metric is the mean over frames, then over scenarios. Undefined
frames are left out and counted; so is a scenario without a defined frame. Scenarios are
taken in id order.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from statistics import NormalDist
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lagbench.data.layout import format_ids
from lagbench.errors import UsageError

from .frame import Floats, FramePair
from .metric import Metric, identity, mean, mean_of_rows, root_mean_square

LARGEST = float(np.finfo(np.float32).max)

LONG_ROLLOUT = 100
"""Predicted frames beyond which statistics are rounded more coarsely than float32."""

LONG_BITS = 11
"""Significant bits of statistics of a long rollout: relative error 4.9e-4."""

LEVEL = 0.95
"""Probability of an interval: the share of the resampled means between its ends."""

RESAMPLES = 10_000
"""Resamples of scenarios and of seeds."""

ELEMENTS_PER_BLOCK = 1 << 18
"""Most elements of resamples that are drawn at once."""

FEWEST_FOR_INTERVAL = 4
"""Fewest scenarios with an interval: Student's quantile of three doubles its width."""


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
    weight: NDArray[np.int64]  # number of defined values, shape [statistic, frame]
    undefined: NDArray[np.int64]  # number of NaN values, shape [statistic, frame]

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        frames: Sequence[int],
        measured: Mapping[int, Mapping[str, float]],
    ) -> Self:
        """Return the tally of values by frame and name; a missing value has weight 0.

        Raises:
            UsageError: a value of a statistic or a frame that the tally does not have.
        """
        row = {name: i for i, name in enumerate(names)}
        column = {frame: i for i, frame in enumerate(frames)}
        values = np.zeros((len(row), len(column)))
        is_measured = np.zeros(values.shape, np.int64)

        for frame, statistics in measured.items():
            for name, value in statistics.items():
                if name not in row or frame not in column:
                    raise UsageError(
                        f"statistic {name!r} at frame {frame} has no place in the tally"
                    )
                values[row[name], column[frame]] = value
                is_measured[row[name], column[frame]] = 1

        is_nan = np.isnan(values)
        return cls(
            names=tuple(names),
            frames=tuple(frames),
            total=np.where(is_nan, 0.0, values),
            weight=is_measured * ~is_nan,
            undefined=is_measured * is_nan,
        )

    def __add__(self, other: Tally) -> Tally:
        """Combine two pieces of the same scenario."""
        if (self.names, self.frames) != (other.names, other.frames):
            raise UsageError("tallies of different statistics or frames do not add")
        return Tally(
            names=self.names,
            frames=self.frames,
            total=self.total + other.total,
            weight=self.weight + other.weight,
            undefined=self.undefined + other.undefined,
        )

    @cached_property
    def values(self) -> Floats:
        """Statistics per frame, NaN without a value, [statistic, frame], read-only."""
        values = np.full(self.total.shape, np.nan)
        np.divide(self.total, self.weight, out=values, where=self.weight > 0)
        values.flags.writeable = False
        return values

    @cached_property
    def is_measured(self) -> NDArray[np.bool_]:
        """Whether a value was measured, defined or not, [statistic, frame]."""
        return np.asarray(self.weight + self.undefined > 0)

    def __getstate__(self) -> dict[str, object]:
        """Return the fields; another process forms the cached arrays again."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    def series(self, name: str) -> Floats:
        """Return a statistic per frame, NaN without a value, [frame], read-only."""
        series: Floats = self.values[self.names.index(name)]
        return series

    def measured(self, name: str) -> NDArray[np.bool_]:
        """Return at which frames a statistic was measured, defined or not.

        The shape is [frame].
        """
        is_measured: NDArray[np.bool_] = self.is_measured[self.names.index(name)]
        return is_measured


def round_statistics(tally: Tally) -> Tally:
    """Return a tally rounded as in scores.nc: to float32, of long rollouts to 11 bits.

    Scores are formed from rounded statistics, so that whoever aggregates scores.nc
    again gets the same digits. Long rollouts have so many frames that their float32
    would not fit into a small file, and that rounding averages out. Beyond float32 a
    statistic saturates.
    """
    total = tally.total
    if len(tally.frames) > LONG_ROLLOUT:
        mantissa, exponent = np.frexp(total)
        rounded = np.rint(np.ldexp(mantissa, LONG_BITS))
        total = np.ldexp(rounded, exponent - LONG_BITS)
    single = np.clip(total, -LARGEST, LARGEST).astype(np.float32)
    return replace(tally, total=single.astype(np.float64))


def measure(pair: FramePair, metrics: Iterable[Metric]) -> dict[str, float]:
    """Return the statistics of one frame pair by name, NaN where one is undefined."""
    values = {}
    for metric in metrics:
        if metric.statistic is None:
            continue
        try:
            applies = metric.applies(pair)
        except Exception as error:
            raise metric.failure(error, f"frame {pair.frame}") from error
        if applies:
            values[metric.name] = metric.measure(pair)
    return values


def tally(
    pairs: Iterable[FramePair], metrics: Sequence[Metric], frames: Sequence[int]
) -> Tally:
    """Measure consecutive frame pairs, one in memory at a time."""
    names = [metric.name for metric in metrics if metric.statistic is not None]
    values = {pair.frame: measure(pair, metrics) for pair in pairs}
    return Tally.of(names, frames, values)


@functools.cache
def resampled_shares(count: int, stream: int) -> Floats:
    """Return the share of each element in draws with replacement.

    The shape is [resample, element].
    """
    # Generator.random is the one distribution whose stream NumPy keeps across versions
    generator = np.random.Generator(np.random.PCG64(stream))
    shares = np.empty((RESAMPLES, count))
    # In blocks they are the draws of one call. Of many scenarios one call would take
    # several times the memory of the result.
    block_length = max(1, ELEMENTS_PER_BLOCK // count)
    for start in range(0, RESAMPLES, block_length):
        block = shares[start : start + block_length]
        uniform = generator.random(block.shape)
        element = np.floor(uniform * count).astype(np.intp)

        # one flat bin per (resample, element)
        first_bin = count * np.arange(len(block))[:, None]
        bins = (element + first_bin).ravel()
        counts = np.bincount(bins, minlength=block.size)
        block[:] = counts.reshape(block.shape) / count
    return shares


@dataclass(frozen=True, eq=False)
class Resampling:
    """A mean over seeds and scenarios, and its spread when both are resampled."""

    mean: float
    # deviations from the mean by stream of draws: 0 for scenarios, then seeds
    parts: Mapping[int, Floats]

    @cached_property
    def deviations(self) -> Floats:
        """Resampled means minus the mean, shape [resample]."""
        deviations = []
        for stream, part in self.parts.items():
            count = len(part)
            stretch = math.sqrt(count / (count - 1))
            shares = resampled_shares(count, stream)
            deviations.append(stretch * np.einsum("rn,n->r", shares, part))
        return np.asarray(np.sum(deviations, axis=0))

    @cached_property
    def _variances(self) -> list[float]:
        """Variance of the mean by part: ``sum(x^2) / (n (n - 1))``."""
        return [
            float(np.sum(part**2)) / (len(part) * (len(part) - 1))
            for part in self.parts.values()
        ]

    @property
    def error(self) -> float:
        """Standard deviation of the resampled means, without drawing."""
        return math.sqrt(math.fsum(self._variances))

    @property
    def freedom(self) -> float:
        """Degrees of freedom behind the error, after Satterthwaite."""
        counts = [len(part) for part in self.parts.values()]
        return satterthwaite(self._variances, counts)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % percentile interval, widened by Student's over the normal quantile.

        NaN of fewer than four scenarios.
        """
        if len(self.parts[0]) < FEWEST_FOR_INTERVAL:
            return (math.nan, math.nan)
        if not self.error:
            return (self.mean, self.mean)

        upper = (1.0 + LEVEL) / 2.0
        lower = (1.0 - LEVEL) / 2.0
        normal = NormalDist().inv_cdf(upper)
        stretch = student_quantile(self.freedom, upper) / normal
        low, high = np.quantile(self.deviations, (lower, upper)).tolist()
        return (self.mean + stretch * low, self.mean + stretch * high)


def satterthwaite(variances: Sequence[float], counts: Sequence[int]) -> float:
    """Return the degrees of freedom of a sum of variances of means."""
    squares = math.fsum(
        variance**2 / (count - 1)
        for variance, count in zip(variances, counts, strict=False)
    )
    return math.fsum(variances) ** 2 / squares if squares else math.inf


@functools.cache
def student_quantile(freedom: float, share: float) -> float:
    """Return the quantile of Student's distribution."""
    # commands that form no interval save its import
    from scipy.special import stdtrit

    return float(stdtrit(freedom, share))


def mean_over_seeds(values: ArrayLike) -> Floats:
    """Return the mean over the seeds that have a value, NaN where none has one.

    The seeds are the first axis; the result has the other axes.
    """
    seeds = np.asarray(values, np.float64)
    is_defined = ~np.isnan(seeds)
    total = np.where(is_defined, seeds, 0.0).sum(axis=0)
    count = is_defined.sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), math.nan)


def as_method(values: ArrayLike) -> Floats:
    """Return the values of a method as an array of shape [seed, scenario].

    Args:
        values: numbers, NaN where undefined, shape [scenario] or [seed, scenario].

    Raises:
        UsageError: the values are no finite numbers, or have another shape.
    """
    try:
        method = np.asarray(values, np.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise UsageError(f"no array of numbers: {values!r:.60}") from error
    if method.ndim > 2 or np.isinf(method).any():
        raise UsageError(
            f"infinite values, or shape {method.shape}; give finite numbers, NaN where "
            "undefined, of shape [scenario] or [seed, scenario]"
        )
    return np.atleast_2d(method)


def resample(values: ArrayLike, minus: ArrayLike | None = None) -> Resampling | None:
    """Draw scenarios and seeds with replacement: the two-way bootstrap of a mean.

    The value of seed s in scenario i is read as ``mean + w_i + u_s`` and a rest. The
    means over seeds ``w_i`` and those over scenarios ``u_s`` are drawn independently of
    each other, each stretched by ``sqrt(n / (n - 1))`` so that few seeds do not look
    alike by being few::

        Var = sum_i w_i^2 / (N (N - 1)) + sum_s u_s^2 / (S (S - 1))

    The rest enters both sums once, which errs on the side of too wide. With one seed
    only the scenarios are drawn: the mean is then that of this one training, not of
    the method. The draws are seeded: two calls with as many scenarios draw the same
    ones.

    Args:
        values: values of a method, NaN where undefined, shape [scenario] or [seed,
            scenario].
        minus: values of another method in the same scenarios; the mean is then that of
            the difference.

    Returns:
        None where fewer than two scenarios are defined.

    Raises:
        UsageError: values are infinite or no numbers, have another shape, or the
            methods have different scenarios.
    """
    methods = [as_method(values)]
    if minus is not None:
        methods.append(as_method(minus))
    counts = {method.shape[1] for method in methods}
    if len(counts) > 1:
        raise UsageError(f"methods over different scenarios: {sorted(counts)}")
    has_value = [~np.isnan(method).all(axis=0) for method in methods]
    defined = np.all(has_value, axis=0)  # shape [scenario]
    if np.count_nonzero(defined) < 2:
        return None

    over_seeds = np.zeros(np.count_nonzero(defined))  # b_i, shape [scenario]
    over_scenarios = []  # a_s of each method, shape [seed]
    for sign, method in zip((1.0, -1.0), methods, strict=False):
        seeds = method[:, defined]
        seed_mean = mean_over_seeds(seeds)
        over_seeds += sign * seed_mean
        offsets = mean_of_rows(seeds - seed_mean)
        over_scenarios.append(sign * offsets[~np.isnan(offsets)])

    parts = {}
    for stream, part in enumerate([over_seeds, *over_scenarios]):
        if len(part) > 1:
            parts[stream] = part - np.mean(part)
    return Resampling(mean=float(np.mean(over_seeds)), parts=parts)


def bootstrap_interval(
    values: ArrayLike, minus: ArrayLike | None = None
) -> tuple[float, float]:
    """Return the 95 % interval of a mean by the two-way bootstrap, :func:`resample`.

    NaN when fewer than four scenarios are defined.

    Raises:
        UsageError: as :func:`resample`.
    """
    resampling = resample(values, minus)
    if resampling is None:
        return (math.nan, math.nan)
    return resampling.interval


def interval_in_range(
    values: ArrayLike, value_range: tuple[float, float]
) -> tuple[float, float]:
    """Return the interval of a mean, cut off at the range of the values.

    The bootstrap of few skewed values is stretched beyond it, where no mean can lie:
    nothing that is cut off could have been the mean. Values that lie outside all the
    same widen the range.

    Args:
        values: as :func:`bootstrap_interval` takes them.
        value_range: least and greatest value that there can be.
    """
    low, high = bootstrap_interval(values)
    if math.isnan(low):
        return (low, high)
    least, greatest = value_range
    low = max(low, min(least, float(np.nanmin(values))))
    high = min(high, max(greatest, float(np.nanmax(values))))
    return (low, high)


@dataclass(frozen=True, eq=False)
class Score:
    """The values of a metric for one prediction."""

    metric: Metric
    scenarios: tuple[int, ...]  # ids, ascending
    frames: tuple[int, ...]  # absolute numbers of the predicted frames
    per_frame: Floats  # NaN where not measured or undefined, shape [scenario, frame]
    values: Floats  # over the horizon, shape [scenario]
    undefined: tuple[int, ...]  # measured frames without a value, shape [scenario]

    def __repr__(self) -> str:
        """Return metric, mean and counts; the values are too many."""
        return (
            f"<{type(self).__name__}: {self.metric.name} {self.mean:.4g}, "
            f"{len(self.scenarios)} scenarios, {len(self.frames)} frames>"
        )

    @cached_property
    def mean(self) -> float:
        """Mean over the scenarios that have a value."""
        return mean(self.values)

    @cached_property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the mean, by bootstrap over scenarios.

        It says nothing about other trainings (seeds) of the method. It is cut off at
        the range of the metric, and NaN with fewer than four scenarios.
        """
        return interval_in_range(self.values, self.value_range)

    @property
    def value_range(self) -> tuple[float, float]:
        """Least and greatest value over the horizon, infinite without end."""
        least, greatest = self.metric.value_range
        if self.metric.unit == "frame":
            # no more frames can count than there are
            greatest = min(greatest, float(len(self.frames)))
        return least, greatest

    def at(self, frame: int) -> Floats:
        """Return the value at one absolute frame, shape [scenario].

        NaN where it is undefined, or not measured in this frame.

        Raises:
            UsageError: the metric has no value in single frames, as `stable_frames`, or
                the frame is not predicted.
        """
        name = self.metric.name
        if not self.metric.per_frame:
            raise UsageError(
                f"{name} has no value in single frames; take .values, of whole rollouts"
            )
        if frame not in self.frames:
            raise UsageError(
                f"frame {frame!r:.40} of {name} is not predicted; choose one of "
                f"{format_ids(self.frames)}"
            )
        column = self.frames.index(frame)
        return self.per_frame[:, column]

    def interval_at(self, frame: int) -> tuple[float, float]:
        """Return the 95 % interval of the mean at one absolute frame.

        Raises:
            UsageError: as :meth:`at`.
        """
        return interval_in_range(self.at(frame), self.metric.value_range)


def score(metric: Metric, tallies: Mapping[int, Tally]) -> Score | None:
    """Return the score of one metric, by the tallies of the scenarios.

    None where it was measured nowhere or the task is too short.
    """
    return aggregate([metric], tallies).get(metric.name)


def aggregate(
    metrics: Iterable[Metric], tallies: Mapping[int, Tally]
) -> dict[str, Score]:
    """Return the scores of all metrics that this split and size have, by name.

    All tallies have the same statistics and frames, and every statistic of a metric.

    Raises:
        WorkFailedError: a metric gives no value per frame, or no number.
    """
    scores: dict[str, Score] = {}
    if not tallies:
        return scores
    scenarios = tuple(sorted(tallies))
    in_order = [tallies[i] for i in scenarios]
    frames = in_order[0].frames
    rows = {name: row for row, name in enumerate(in_order[0].names)}
    # shape [statistic, scenario, frame]
    values = np.stack([one.values for one in in_order], axis=1)
    was_measured = np.stack([one.is_measured for one in in_order], axis=1)
    values.flags.writeable = False
    for metric in metrics:
        parts = [values[rows[name]] for name in metric.of]
        is_measured = np.all([was_measured[rows[name]] for name in metric.of], axis=0)
        if metric.horizon > len(frames) or not is_measured.any():
            continue
        try:
            series = parts[0]
            if metric.series is not identity:
                by_scenario = zip(*parts, strict=True)
                series = np.stack([metric.series(*part) for part in by_scenario])
            if series.shape != parts[0].shape:
                raise ValueError(f"shape {series.shape}, not {parts[0].shape}")
            # all scenarios at once, to the same bits
            if metric.over_frames is mean:
                over_horizon = mean_of_rows(series)
            elif metric.over_frames is root_mean_square:
                over_horizon = np.sqrt(mean_of_rows(series**2))
            else:
                over_horizon = np.array([metric.over_frames(row) for row in series])
            scores[metric.name] = Score(
                metric=metric,
                scenarios=scenarios,
                frames=frames,
                per_frame=np.asarray(series, np.float64),
                values=np.asarray(over_horizon, np.float64),
                undefined=tuple(
                    np.count_nonzero(is_measured & np.isnan(series), axis=1).tolist()
                ),
            )
        except Exception as error:
            raise metric.failure(error, "over all frames") from error
    return scores
