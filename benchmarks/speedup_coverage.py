"""How often does the interval of the speedup contain the true one?

    python benchmarks/speedup_coverage.py [--draws 400] [--board leaderboard]

The scenarios of each model of the leaderboard, with the rows beside it, are taken as
the whole population, whose speedup is the true one. As many scenarios are drawn from
them with replacement, and the interval of the draw is compared with the true value.
Models count whose interval is not one point in most draws: beyond both ends of the hull
the speedup does not depend on the error.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lagbench.board.collect import collect
from lagbench.scoring.front import FrontRow, Speedup, compute_speedup

MOST_CERTAIN = 0.2
"""Share of draws with an interval of one point, above which a model does not count."""


def coverage(
    model: FrontRow, rows: Sequence[FrontRow], draws: int
) -> tuple[float, float] | None:
    """Return the shares of intervals with the true speedup, and of single points.

    None for a model without a speedup.
    """
    true = compute_speedup(model, rows)
    if not isinstance(true, Speedup):
        return None
    generator = np.random.default_rng(0)
    count = model.errors.shape[1]
    hits = 0
    points = 0
    for _ in range(draws):
        drawn = generator.integers(0, count, count)
        speedup = compute_speedup(
            replace(model, errors=model.errors[:, drawn]),
            [replace(row, errors=row.errors[:, drawn]) for row in rows],
        )
        low, high = 0.0, 0.0  # of a model that is no better than a naive one here
        if isinstance(speedup, Speedup):
            low, high = speedup.interval
        hits += low * (1.0 - 1e-9) <= true.value <= high * (1.0 + 1e-9)
        points += high <= low * (1.0 + 1e-6)
    return hits / draws, points / draws


def main() -> int:
    """Print the coverage of each model, and the mean."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=400)
    parser.add_argument("--board", type=Path, default=Path("leaderboard"))
    options = parser.parse_args()
    shares = []
    print("| data set | model | scenarios | covered |\n| --- | --- | ---: | ---: |")
    for tab in collect(options.board).tabs:
        for row in tab.front_rows:
            if row.kind not in ("learned", "hybrid"):
                continue
            found = coverage(row, tab.front_rows, options.draws)
            if found is None or found[1] > MOST_CERTAIN:
                continue
            covered, _ = found
            shares.append(covered)
            count = row.errors.shape[1]
            print(f"| {tab.id} | {row.name} | {count} | {covered:.3f} |", flush=True)
    print(f"\nmean {np.mean(shares):.3f} of {len(shares)} models")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
