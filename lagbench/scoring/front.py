"""The front: what a model's accuracy would cost on the classical side.

``speedup = cost of the classical side at the model's error / cost of the model``

The classical side are the classical and calibrated rows of a data set. Between them it
is the lower left hull of (log cost, log error), so that its cost at an error e is

    log cost(e) = min over pairs (i, j) with e_i <= e <= e_j of the straight line
                  between (log c_i, log e_i) and (log c_j, log e_j), at log e

A model less accurate than the cheapest row gets that row's cost. One that is more
accurate than every row gets the cost of the most accurate row, and the speedup is "at
least" this. A model no better than the best naive predictor has no speedup. Learning
pays where the whole 95 % interval is above 1.5: measured costs are not sharper.

The comparison is at equal accuracy and with an efficient solver, as McGreivy and Hakim
ask for (Nature Machine Intelligence 6 (2024) 1256).
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lagbench.data.checksums import round_digits
from lagbench.metrics.aggregate import (
    FEWEST_FOR_INTERVAL,
    LEVEL,
    Score,
    mean_over_seeds,
    resampled_shares,
    satterthwaite,
    student_quantile,
)
from lagbench.metrics.frame import Floats
from lagbench.metrics.metric import mean, mean_of_rows
from lagbench.metrics.significance import SIGNIFICANCE, holm

CLASSICAL_SIDE = ("classical", "calibrated")
"""Kinds of rows that a speedup is measured against."""

NOISE = 1.5
"""Least ratio of two costs that is more than the noise of their measurement.

docs/scoring.md has the spread of repeated measurements.
"""

LEAST_ERROR = 1e-12
"""A smaller error counts as this one: the logarithm of 0 has no place on the hull."""


def digits(value: float) -> float | None:
    """Return a number with nine significant digits, None where it is not finite.

    >>> digits(2 / 3)
    0.666666667
    """
    return round_digits(value) if math.isfinite(value) else None


@dataclass(frozen=True, kw_only=True, eq=False)
class FrontRow:
    """Cost and errors of one method on a data set, in its ranking metric."""

    name: str
    kind: str  # naive, classical, calibrated, learned or hybrid
    # processor time of a frame [s], on the machine of the other rows; NaN if unknown
    seconds: float
    # ranking metric, where less is better, NaN where undefined, shape [seed, scenario];
    # all rows have the same scenarios
    errors: Floats

    @property
    def error(self) -> float:
        """Mean over seeds, then over scenarios; NaN where undefined."""
        return mean(mean_over_seeds(self.errors))

    @property
    def is_on_classical_side(self) -> bool:
        """Whether a speedup is measured against it: cost and error are known."""
        has_place = self.seconds > 0.0 and not math.isnan(self.error)
        return has_place and self.kind in CLASSICAL_SIDE


def front_row(
    *,
    name: str,
    kind: str,
    seconds: float | None,
    seeds: Sequence[Score],
    scenarios: Sequence[int],
) -> FrontRow:
    """Return the row of a method from the scores of its seeds.

    Args:
        name: name of the method.
        kind: how its predictions come about.
        seconds: processor time of a frame [s]; None if unknown.
        seeds: ranking metric of each seed.
        scenarios: ids of the scenarios that all rows of the data set have; a value that
            a seed lacks is NaN.
    """
    errors = []
    for score in seeds:
        value = dict(zip(score.scenarios, score.values.tolist(), strict=True))
        errors.append([value.get(i, math.nan) for i in scenarios])
    return FrontRow(
        name=name,
        kind=str(kind),
        seconds=math.nan if seconds is None else seconds,
        errors=np.array(errors),
    )


def classical_hull(rows: Sequence[FrontRow]) -> list[FrontRow]:
    """Return the corners of the classical side's hull, the cheapest row first.

    The broken line joins (log cost, log error) of these rows, upright above its first
    and level beyond its last corner.
    """
    side = [row for row in rows if row.is_on_classical_side]
    side.sort(key=lambda row: (row.seconds, row.error))
    corners = []
    least_error = math.inf
    for row in side:
        cost, _ = classical_seconds(side, row.error)
        is_corner = row.seconds <= cost * (1.0 + 1e-9)
        if is_corner and row.error < least_error:
            corners.append(row)
            least_error = row.error
    return corners


def classical_seconds(rows: Sequence[FrontRow], error: float) -> tuple[float, bool]:
    """Return what a frame costs the classical side at an error [s].

    The cost is NaN without a row of the classical side.

    Returns:
        The cost, and whether no row is as accurate: then it is that of the best one.
    """
    side = [row for row in rows if row.is_on_classical_side]
    if not side:
        return math.nan, False
    log_errors = _logarithm(np.array([[row.error for row in side]]))
    log_costs = np.log([row.seconds for row in side])
    log_error = _logarithm(np.array([error]))
    log_cost = _hull_cost(log_error, log_errors, log_costs)
    is_beyond = bool(log_error[0] < log_errors.min())
    return float(np.exp(log_cost[0])), is_beyond


def _logarithm(errors: Floats) -> Floats:
    return np.asarray(np.log(np.maximum(errors, LEAST_ERROR)))


def _hull_cost(model: Floats, errors: Floats, costs: Floats) -> Floats:
    """Return the logarithm of the classical cost at the errors of a model.

    Args:
        model: logarithm of the model's error, shape [draw].
        errors: logarithms of the errors of the classical side, shape [draw, row].
        costs: logarithms of their costs, shape [row].
    """
    best = np.argmin(errors, axis=1)
    best_error = np.min(errors, axis=1)
    cost = np.where(model < best_error, costs[best], math.inf)
    for i in range(len(costs)):
        is_as_accurate = errors[:, i] <= model
        cost = np.where(is_as_accurate, np.minimum(cost, costs[i]), cost)
        for j in range(len(costs)):
            is_between = is_as_accurate & (model < errors[:, j])
            way = np.where(is_between, errors[:, j] - errors[:, i], 1.0)
            share = (model - errors[:, i]) / way
            line = costs[i] + share * (costs[j] - costs[i])
            cost = np.where(is_between, np.minimum(cost, line), cost)
    return cost


class NoSpeedup(enum.StrEnum):
    """Why a method has no speedup."""

    NO_COST = (
        "seconds_per_frame or solver_seconds_per_frame is not stated; `lagbench "
        "predict` states both, `lagbench bench` times our solver"
    )
    NO_CLASSICAL = "no classical or calibrated solver was scored and timed here"
    NOT_BETTER_THAN_NAIVE = "it is no better than the best naive predictor"
    TOO_FEW = "there is no scenario in which all rows have a value"


@dataclass(frozen=True, kw_only=True)
class Speedup:
    """How many times less a model costs than the classical side at its error."""

    value: float  # cost of the classical side at the model's error / cost of the model
    interval: tuple[float, float]  # 95 %; NaN of fewer than four scenarios
    p: float  # two-sided, of a speedup of NOISE; NaN where there is no interval
    classical_seconds: float  # cost of the classical side at the model's error [s]
    at_least: bool  # whether no classical row is as accurate: the sign ">"

    @property
    def pays(self) -> bool:
        """Whether the whole interval is beyond the noise of costs: learning pays."""
        return self.interval[0] > NOISE

    def as_json(self) -> dict[str, Any]:
        """Return the speedup as plain values; undefined ones are None."""
        return {
            "value": digits(self.value),
            "interval": [digits(bound) for bound in self.interval],
            "at_least": self.at_least,
            "classical_seconds": digits(self.classical_seconds),
        }

    def __str__(self) -> str:
        """Return sign, value and interval (where there is one), as in a table."""
        sign = "> " if self.at_least else ""
        low, high = self.interval
        if math.isnan(low):
            return f"{sign}{self.value:.3g}"
        return f"{sign}{self.value:.3g} [{low:.3g}, {high:.3g}]"


def compute_speedup(model: FrontRow, rows: Sequence[FrontRow]) -> Speedup | NoSpeedup:
    """Return the speedup of a model over the classical side.

    The interval is that of the paired bootstrap: each draw of scenarios is the same for
    all rows, the seeds of the model are drawn with it, and hull and best naive
    predictor are found anew. The logarithm of a mean error moves by the drawn deviation
    over the mean, times ``sqrt(n / (n - 1))`` and Student's over the normal quantile. A
    draw in which the model is no better than the best naive predictor counts as 0.

    Args:
        model: the row of the model.
        rows: the rows beside it; classical, calibrated and naive ones count.

    Returns:
        The speedup, or the reason why there is none.
    """
    side = []
    naive = []
    for row in rows:
        if row.is_on_classical_side and row.name != model.name:
            side.append(row)
        elif row.kind == "naive":
            naive.append(row)
    if not model.seconds > 0.0:
        return NoSpeedup.NO_COST
    if not side:
        return NoSpeedup.NO_CLASSICAL

    values = np.stack([mean_over_seeds(row.errors) for row in (model, *side, *naive)])
    is_defined = ~np.isnan(values).any(axis=0)
    values = values[:, is_defined]  # shape [row, scenario]
    if not is_defined.any():
        return NoSpeedup.TOO_FEW
    # less than the least error of a naive predictor is needed
    errors = np.mean(values, axis=1)
    limit = float(np.min(errors[1 + len(side) :], initial=math.inf))
    if not errors[0] < limit:
        return NoSpeedup.NOT_BETTER_THAN_NAIVE

    log_costs = np.log([row.seconds for row in side])
    log_seconds = math.log(model.seconds)

    def speedups(deviations: Floats) -> Floats:
        """Return the speedup of each draw from relative deviations, [draw, row]."""
        log_errors = _logarithm(errors) + deviations
        log_model = log_errors[:, 0]
        log_side = log_errors[:, 1 : 1 + len(side)]
        log_naive = np.min(log_errors[:, 1 + len(side) :], axis=1, initial=math.inf)
        log_speedup = _hull_cost(log_model, log_side, log_costs) - log_seconds
        return np.where(log_model < log_naive, np.exp(log_speedup), 0.0)

    value = float(speedups(np.zeros((1, len(errors))))[0])
    interval = (math.nan, math.nan)
    p = math.nan
    if values.shape[1] >= FEWEST_FOR_INTERVAL:
        relative = (values - errors[:, None]) / np.maximum(errors, LEAST_ERROR)[:, None]
        parts = [_drawn(relative, stream=0)]
        seeds = model.errors[:, is_defined]
        offsets = mean_of_rows(seeds - values[0])
        offsets = offsets[~np.isnan(offsets)] / max(errors[0], LEAST_ERROR)
        if len(offsets) > 1:
            of_seeds = np.zeros_like(parts[0])
            of_seeds[:, :1] = _drawn((offsets - np.mean(offsets))[None], stream=1)
            parts.append(of_seeds)
        freedom = satterthwaite(
            [float(np.var(speedups(part))) for part in parts],
            [values.shape[1], len(offsets)],
        )
        upper = (1.0 + LEVEL) / 2.0
        stretch = student_quantile(freedom, upper) / student_quantile(1e6, upper)
        drawn = speedups(stretch * np.sum(parts, axis=0))
        low, high = np.quantile(drawn, (1.0 - upper, upper)).tolist()
        interval = (low, high)
        below = np.count_nonzero(drawn <= NOISE)
        above = np.count_nonzero(drawn >= NOISE)
        p = min(1.0, 2.0 * (1 + min(below, above)) / (1 + len(drawn)))
    return Speedup(
        value=value,
        interval=interval,
        p=p,
        classical_seconds=value * model.seconds,
        at_least=bool(errors[0] < np.min(errors[1 : 1 + len(side)])),
    )


def _drawn(deviations: Floats, *, stream: int) -> Floats:
    """Return means of deviations drawn with replacement, shape [draw, row].

    They are stretched by ``sqrt(n / (n - 1))``, so that few do not look alike.
    """
    count = deviations.shape[1]
    shares = resampled_shares(count, stream)
    return np.asarray(math.sqrt(count / (count - 1)) * shares @ deviations.T)


def pays_after_holm(speedups: Mapping[str, Speedup]) -> list[str]:
    """Return the data sets where learning pays, corrected for their number by Holm.

    Args:
        speedups: by data set, the speedup of the model that decides there.
    """
    corrected = holm([speedup.p for speedup in speedups.values()])
    pays = []
    for (name, speedup), p in zip(speedups.items(), corrected, strict=True):
        if speedup.pays and p < SIGNIFICANCE:
            pays.append(name)
    return pays


def breakeven(
    speedup: Speedup, *, seconds_per_frame: float, frames: int, hours: float
) -> float:
    """Return after how many predicted scenarios a model was worth its making.

    It is (time to generate train + time to train) / (time saved in a scenario), all of
    them processor time; infinite where the model saves nothing.

    Args:
        speedup: of the model.
        seconds_per_frame: processor time of a frame of the model [s].
        frames: predicted frames of a scenario.
        hours: processor time to generate train and to train [h].
    """
    saved = (speedup.value - 1.0) * seconds_per_frame * frames
    if saved <= 0.0:
        return math.inf
    return 3600.0 * hours / saved


def seconds_where_measured(
    *,
    seconds_per_frame: float | None,
    solver_seconds: float | None,
    solver_seconds_here: float | None,
) -> float | None:
    """Return what a frame would cost a method where the references were timed [s].

    The solver that made the data is timed on both machines: the method's time is scaled
    by the ratio of the two. None where one of the times is not known.

    Args:
        seconds_per_frame: time of the method on its machine [s].
        solver_seconds: time of our solver on that machine [s].
        solver_seconds_here: time of our solver where the references were timed [s].
    """
    if not seconds_per_frame or not solver_seconds or not solver_seconds_here:
        return None
    return seconds_per_frame * solver_seconds_here / solver_seconds
