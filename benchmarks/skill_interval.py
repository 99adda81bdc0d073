"""How often the interval of skill holds the true ratio: by the logarithm's linear part, and by the ratio's.

    python benchmarks/skill_interval.py [--draws 2000]

Scores of a method and of a floor are drawn lognormal, with a correlation over scenarios. Prints the share of
draws in which either 95 % interval of the ratio of means holds the true one, and the greatest skill that any
interval reaches. docs/scoring.md quotes it.
"""

from __future__ import annotations

import argparse
import math

import numpy as np

from lagbench.metrics.aggregate import bootstrap_interval

CASES = ((1.9, 0.6, 0.6, 0.3), (0.4, 0.4, 0.3, 0.5), (0.4, 0.8, 0.6, 0.0), (1.0, 0.3, 0.3, 0.8))
"""Ratio of the means, deviations of the logarithms of method and floor, their correlation."""


def main() -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--draws", type=int, default=2000)
    draws = parser.parse_args().draws
    rng = np.random.Generator(np.random.PCG64(0))
    print("| scenarios | skill | log: holds | greatest | linear: holds | greatest |")
    print("|---:|---:|---:|---:|---:|---:|")
    for count in (6, 10, 16, 20):
        for ratio, spread, base_spread, correlation in CASES:
            held, greatest = np.zeros(2), np.full(2, -np.inf)
            for _ in range(draws):
                z = rng.multivariate_normal([0, 0], [[1, correlation], [correlation, 1]], count)
                deviations = np.array([spread, base_spread])
                ours, base = np.exp(deviations * z - deviations**2 / 2).T
                scale, found = np.mean(base), ratio * np.mean(ours) / np.mean(base)
                low, high = bootstrap_interval((ratio * ours / found - base) / scale)
                ends = [
                    (found * math.exp(low), found * math.exp(high)),
                    (found * (1 + low), found * (1 + high)),
                ]
                held += [a <= ratio <= b for a, b in ends]
                greatest = np.maximum(greatest, [1 - a for a, _ in ends])
            shares = (f"{share:.1%} | {top:.2f}" for share, top in zip(held / draws, greatest, strict=True))
            print(f"| {count} | {1 - ratio:.1f} | {' | '.join(shares)} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
