"""How often the interval of skill holds the true one, and how far it reaches.

    python benchmarks/skill_interval.py [--draws 400]

Scores of a method and of a naive baseline are drawn lognormal, correlated over
scenarios; each seed of the method has a factor of its own. Beside the shipped interval,
on the logarithm of the ratio, stands that of the ratio itself. Prints the share of
draws in which either 95 % interval holds the true skill, and the least and greatest end
of any. docs/scoring.md quotes it.
"""

from __future__ import annotations

import argparse

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics.aggregate import Score, bootstrap_interval
from lagbench.metrics.table import METRICS
from lagbench.scoring.skill import compute_skill

CASES = (
    (1.9, 0.6, 0.6, 0.3),
    (0.4, 0.4, 0.3, 0.5),
    (0.4, 0.8, 0.6, 0.0),
    (1.0, 0.3, 0.3, 0.8),
)
"""Ratio of the means, then of the logarithms over scenarios: both deviations (method,
naive baseline) and their correlation.
"""

SEED = 0.15
"""Deviation of the logarithm of a seed's factor."""

HEADS = (
    "seeds",
    "scenarios",
    "skill",
    "deviations",
    "shipped: holds",
    "least",
    "greatest",
)


def score_of(values: NDArray[np.float64]) -> Score:
    """Return made-up values as the score of a ranking metric."""
    return Score(
        metric=METRICS["vorticity_nrmse"],
        scenarios=tuple(range(len(values))),
        frames=(0,),
        per_frame=values[:, None],
        values=values,
        undefined=(0,) * len(values),
    )


def main() -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=400)
    draws = parser.parse_args().draws
    rng = np.random.Generator(np.random.PCG64(0))
    heads = (*HEADS, "of the ratio: holds", "least", "greatest")
    print(f"| {' | '.join(heads)} |\n|{'---:|' * len(heads)}")
    for seeds in (1, 2, 3):
        for count in (6, 16, 20):
            for ratio, spread, base_spread, correlation in CASES:
                hit_counts = np.zeros(2)
                least = np.full(2, np.inf)
                greatest = np.full(2, -np.inf)
                covariance = [[1, correlation], [correlation, 1]]
                deviations = np.array([spread, base_spread])
                true_skill = 1.0 - ratio
                for _ in range(draws):
                    normal = rng.multivariate_normal([0, 0], covariance, count)
                    log_factors = deviations * normal - deviations**2 / 2
                    method_factor, baseline = np.exp(log_factors).T
                    seed_factor = np.ones(1)
                    if seeds > 1:
                        seed_normal = rng.normal(0.0, SEED, seeds)
                        log_seeds = seed_normal - SEED**2 / 2
                        seed_factor = np.exp(log_seeds)
                    # shape [seed, scenario]
                    method = ratio * seed_factor[:, None] * method_factor
                    estimate = compute_skill(
                        [score_of(row) for row in method],
                        {"persistence": score_of(baseline)},
                    )
                    if estimate is None:
                        raise ValueError("persistence does not count for skill")
                    estimated_ratio = 1.0 - estimate.value
                    excess = method - estimated_ratio * baseline
                    relative_excess = excess / np.mean(baseline)
                    low, high = bootstrap_interval(relative_excess)
                    of_ratio = (estimate.value - high, estimate.value - low)
                    intervals = np.array([estimate.interval, of_ratio])
                    lower, upper = intervals.T
                    hit_counts += (lower <= true_skill) & (true_skill <= upper)
                    least = np.minimum(least, lower)
                    greatest = np.maximum(greatest, upper)
                shares = zip(hit_counts / draws, least, greatest, strict=True)
                cells = [
                    f"{share:.1%} | {low:.2f} | {high:.2f}"
                    for share, low, high in shares
                ]
                what = f"{seeds} | {count} | {1 - ratio:.1f} | {spread}, {base_spread}"
                print(f"| {what} | {' | '.join(cells)} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
