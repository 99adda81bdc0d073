"""Skill and `against_classical`: a method beside predictors that need no training.

``skill = 1 - score / score of the best naive predictor``, over the ranking metric. 1 is
perfect, 0 means that nothing was learned, below 0 the method is worse than not
learning.

``against_classical = score / score of the best classical solver that costs no more per
frame``. Where every solver costs more, it is the ratio to the cheapest one. It keeps
the rule of McGreivy and Hakim (Nature Machine Intelligence 6 (2024) 1256):
compare at equal cost or at equal accuracy, and with an efficient solver.

The best predictor has the least mean over its own scenarios (see
:mod:`lagbench.references`); the ratio is over the scenarios that both have.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lagbench.errors import ChecksFailedError, format_count
from lagbench.metrics.aggregate import (
    FEWEST_FOR_INTERVAL,
    Resampling,
    Score,
    bootstrap_interval,
    mean_over_seeds,
    quantiles,
    resample,
    student_quantile,
)
from lagbench.metrics.frame import Floats
from lagbench.metrics.metric import Direction


@dataclass(frozen=True, kw_only=True)
class Skill:
    """Improvement of a submission over the best naive predictor."""

    metric: str  # name of the ranking metric
    reference: str  # name of the best naive predictor
    value: float  # 1 - score / score of that reference
    # 95 %: scenarios, those of the reference with them, and seeds are resampled; NaN of
    # few scenarios
    interval: tuple[float, float]
    std: float = math.nan  # sample standard deviation over seeds; NaN for one

    def __str__(self) -> str:
        """Return value, interval (where there is one) and reference, as in a table."""
        low, high = self.interval
        if math.isnan(low):
            return f"{self.value:.3f} over {self.reference}"
        return f"{self.value:.3f} [{low:.3f}, {high:.3f}] over {self.reference}"


@dataclass(frozen=True, kw_only=True)
class AgainstClassical:
    """Score of a submission over that of the best classical solver that costs no more
    per frame; where every solver costs more, over that of the cheapest one.
    """

    metric: str  # name of the ranking metric
    reference: str  # name of the classical solver
    value: float  # score / score of that solver
    interval: tuple[float, float]  # 95 %, as that of a skill
    std: float = math.nan  # sample standard deviation over seeds; NaN for one
    solver_costs_more: bool = False  # whether every solver does; this is the cheapest

    def __str__(self) -> str:
        """Return value, interval (where there is one) and solver, as in a table."""
        solver = self.reference
        if self.solver_costs_more:
            solver += ", which costs more"
        low, high = self.interval
        if math.isnan(low):
            return f"{self.value:.2f} of {solver}"
        return f"{self.value:.2f} [{low:.2f}, {high:.2f}] of {solver}"


def best_reference(references: Mapping[str, Score]) -> str | None:
    """Return the name of the reference with the least mean above 0; None without one.

    Less must be better. A mean of 0 or NaN does not count, because nothing can be
    divided by it.
    """
    means = {}
    for name, score in references.items():
        means[name] = score.mean
    positive = []
    for name, mean in means.items():
        if mean > 0.0:
            positive.append(name)
    if positive:
        return min(positive, key=lambda name: means[name])
    return None


def compute_skill(
    seeds: Sequence[Score], references: Mapping[str, Score]
) -> Skill | None:
    """Return the skill of a method over naive predictors in the same metric.

    The interval never passes 1 (see :func:`_compute_ratio`).

    Args:
        seeds: score of each seed, over the same scenarios.
        references: scores of the naive predictors, by name.

    Returns:
        None without a naive predictor, without a scenario that both have, and for a
        metric of which less is not better.
    """
    name = best_reference(references)
    if name is None:
        return None
    ratio = _compute_ratio(seeds, references[name])
    if ratio is None:
        return None
    low, high = ratio.interval
    return Skill(
        metric=seeds[0].metric.name,
        reference=name,
        value=1.0 - ratio.value,
        interval=(1.0 - high, 1.0 - low),
        std=ratio.std,
    )


def compute_against_classical(
    seeds: Sequence[Score],
    solvers: Mapping[str, Score],
    *,
    seconds: Mapping[str, float],
    seconds_per_frame: float,
) -> AgainstClassical | None:
    """Return a method's score over that of the best classical solver that costs no more
    per frame.

    Where every solver costs more, the cheapest one takes its place. So a method never
    loses the comparison by becoming cheaper.

    Args:
        seeds: score of each seed, over the same scenarios.
        solvers: scores of the classical solvers, by name, in the same metric.
        seconds: processor time that a frame costs each solver [s].
        seconds_per_frame: the same of the method, on the same machine [s].

    Returns:
        None without a solver, without a scenario that both have, and for a metric of
        which less is not better.
    """
    scored = {}
    affordable = {}
    for name, score in solvers.items():
        if score.mean > 0.0:
            scored[name] = score
        if seconds[name] <= seconds_per_frame:
            affordable[name] = score
    if not scored:
        return None
    solver = best_reference(affordable)
    costs_more = solver is None
    if solver is None:
        solver = min(scored, key=lambda name: (seconds[name], scored[name].mean))
    ratio = _compute_ratio(seeds, solvers[solver])
    if ratio is None:
        return None
    return AgainstClassical(
        metric=seeds[0].metric.name,
        reference=solver,
        value=ratio.value,
        interval=ratio.interval,
        std=ratio.std,
        solver_costs_more=costs_more,
    )


@dataclass(frozen=True, kw_only=True)
class ScoreRatio:
    """Score of a method over that of a reference."""

    value: float  # ratio of the means [1]
    interval: tuple[float, float]  # 95 % [1]; NaN of few scenarios
    std: float  # sample standard deviation over seeds [1]; NaN for one


def _compute_ratio(seeds: Sequence[Score], reference: Score) -> ScoreRatio | None:
    """Return the ratio of two scores over the scenarios that both have.

    The interval is that of the ratio of means r = A / B, by the linear part of its
    logarithm: with e the two-way bootstrap of (a_si - r b_i) / (r B), where a_si is the
    score of seed s and b_i that of the reference in scenario i, it is r exp(e). So it
    stays above 0, and is one point where the ratio is the same everywhere. Two seeds
    say little: its upper end may lie far up.
    """
    if seeds[0].metric.direction is not Direction.LOWER:
        return None
    base = _values_in(reference, seeds[0].scenarios)  # shape [scenario]
    method = np.stack([score.values for score in seeds])  # shape [seed, scenario]
    has_both = ~np.isnan(base) & ~np.isnan(method).all(axis=0)
    base = base[has_both]
    method = method[:, has_both]
    if not base.any():
        return None

    scale = float(np.mean(base))
    ratio = float(np.mean(mean_over_seeds(method))) / scale
    relative = _relative_to(base, method, ratio)
    low, high = bootstrap_interval(relative / scale)
    return ScoreRatio(
        value=ratio,
        interval=(ratio * math.exp(low), ratio * math.exp(high)),
        std=_std_over_seeds(method, scale),
    )


def _relative_to(base: Floats, method: Floats, ratio: float) -> Floats:
    """Return ``method / ratio - base``; of a perfect method zeros, which are certain.

    Args:
        base: scores of the reference, shape [scenario].
        method: scores of the method, shape [..., scenario].
        ratio: ratio of their means [1].
    """
    if ratio > 0.0:
        return method / ratio - base
    return method


@dataclass(frozen=True, kw_only=True)
class SkillGap:
    """Difference of the skills of the same weights on two sets of scenarios."""

    first: float  # skill on the first set
    second: float  # skill on the second one
    # 95 % interval of first minus second, over the scenarios of both; NaN of few
    interval: tuple[float, float]

    @property
    def value(self) -> float:
        """First minus second."""
        return self.first - self.second


def skill_gap(
    first: Sequence[Score],
    first_reference: Score,
    second: Sequence[Score],
    second_reference: Score,
) -> SkillGap:
    """Return the difference of two skills over the same naive predictor.

    The sets of scenarios are independent draws and are resampled apart. Seeds are not
    resampled: the weights are the same on both sides.

    Args:
        first: score of each seed on the first set of scenarios.
        first_reference: score of the naive predictor there.
        second: score of each seed on the second set.
        second_reference: score of the naive predictor there.

    Raises:
        ChecksFailedError: a set has no scenario in which both have a value, or the
            naive predictor has no error there.
    """
    ratios = []
    deviations = []
    degrees = []
    sides = ((first, first_reference), (second, second_reference))
    for stream, (seeds, reference) in enumerate(sides):
        base = _values_in(reference, seeds[0].scenarios)  # shape [scenario]
        seed_values = [score.values for score in seeds]
        method = mean_over_seeds(np.stack(seed_values))
        has_base = ~np.isnan(base)
        has_method = ~np.isnan(method)
        has_both = has_base & has_method
        base = base[has_both]
        method = method[has_both]
        if len(base) == 0:
            raise ChecksFailedError(
                "there is no scenario that both have",
                where=seeds[0].metric.name,
                expected="values of the method and of the naive predictor",
                got="none that both have",
                fix="see which values are undefined: lagbench score --all",
            )
        base_mean = float(np.mean(base))
        if base_mean == 0.0:
            raise ChecksFailedError(
                "the naive predictor has no error, so no skill is defined",
                where=seeds[0].metric.name,
                expected="an error above 0 in some scenario",
                got=f"0 in {format_count(len(base), 'scenario')}",
                fix="compare with another naive predictor",
            )
        ratio = float(np.mean(method)) / base_mean
        resampling = resample(_relative_to(base, method, ratio) / base_mean)
        if len(base) < FEWEST_FOR_INTERVAL or resampling is None:
            degrees.append(math.nan)
            deviations.append(np.zeros(1))
        else:
            # other draws on each side: with as many scenarios they would be the same
            apart = Resampling(mean=0.0, parts={stream: resampling.parts[0]})
            degrees.append(resampling.freedom)
            deviations.append(apart.deviations)
        ratios.append(ratio)

    interval = (math.nan, math.nan)
    if not any(math.isnan(freedom) for freedom in degrees):
        student = student_quantile(min(degrees), 0.975)
        normal = student_quantile(1e6, 0.975)
        stretch = student / normal
        first_ratio = ratios[0] * np.exp(stretch * deviations[0])
        second_ratio = ratios[1] * np.exp(stretch * deviations[1])
        low, high = quantiles(second_ratio - first_ratio, (0.025, 0.975))
        interval = (low, high)
    return SkillGap(first=1.0 - ratios[0], second=1.0 - ratios[1], interval=interval)


def _values_in(score: Score, scenarios: Sequence[int]) -> Floats:
    """Return the values of a score in scenarios, NaN in others, shape [scenario]."""
    values = dict(zip(score.scenarios, score.values.tolist(), strict=True))
    return np.array([values.get(i, math.nan) for i in scenarios])


def _std_over_seeds(method: Floats, scale: float) -> float:
    """Return the standard deviation over the seeds that have a value in all scenarios.

    NaN with fewer than two such seeds. Scores have the shape [seed, scenario].
    """
    complete = method[~np.isnan(method).any(axis=1)]
    if len(complete) < 2:
        return math.nan
    means = np.mean(complete, axis=1) / scale
    return float(np.std(means, ddof=1))
