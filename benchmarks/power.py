"""How often do tests over seeds and scenarios tell methods apart, rightly and wrongly?

    python benchmarks/power.py                    # prints the tables
    python benchmarks/power.py --write            # and writes docs/power.md

Seeds, scenarios and the rest scatter, relative to a method's mean: by three stated
assumptions, and as the score files below leaderboard/scores say, for a data set with
two near methods, one of them of several seeds. From that model, seeded draws of methods
that are equal, or 5, 10 and 20 % apart.
"""

from __future__ import annotations

import argparse
import itertools
import re
from collections import defaultdict
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import load
from lagbench.metrics import differ
from lagbench.metrics.significance import SIGNIFICANCE
from lagbench.metrics.table import ranking_metric
from lagbench.scoring.score_file import read_statistics

Floats = NDArray[np.float64]

ROOT = Path(__file__).parent.parent
TEST = {"cavity": 20, "curl-noise": 16, "fluid": 16, "multimaterial": 16}
DIFFERENCES = (0.05, 0.10, 0.20)
SEEDS = 3
DRAWS = 1000


@dataclass(frozen=True)
class Scatter:
    """Standard deviations relative to a method's mean."""

    seed: float  # of the mean over scenarios, from seed to seed
    rest: float  # of one scenario, from seed to seed, that mean aside
    method: float  # of one scenario, from method to method, their means aside


ASSUMED = {
    "small scatter": Scatter(0.02, 0.05, 0.05),
    "middling": Scatter(0.05, 0.10, 0.10),
    "large": Scatter(0.10, 0.20, 0.20),
}
"""What is assumed of methods and seeds that nobody has measured."""


def read_methods(split: str) -> dict[str, Floats]:
    """Return the ranking metric's values of each method of the mini size, shape [seed,
    scenario].
    """
    metric = ranking_metric(load().size(split, "mini"))
    held = defaultdict(list)
    for path in sorted((ROOT / "leaderboard" / "scores" / split / "mini").glob("*.nc")):
        held[re.sub(r"_\d+$", "", path.stem)].append(
            read_statistics(path).scores()[metric].values
        )
    return {name: np.array(seeds) for name, seeds in held.items()}


def measured_scatter(methods: dict[str, Floats]) -> Scatter:
    """Return the scatter of methods; NaN where no method has two seeds, or none a
    rival.
    """
    seeds = []
    rests = []
    relative = {name: values / values.mean() for name, values in methods.items()}
    for values in relative.values():
        if len(values) > 1:
            off = values - values.mean(axis=0)
            count = values.shape[1]
            within = off - off.mean(axis=1, keepdims=True)
            rest = float(np.sum(within**2)) / ((len(values) - 1) * (count - 1))
            rests.append(rest)
            seeds.append(
                max(0.0, float(np.var(off.mean(axis=1), ddof=1)) - rest / count)
            )
    near = [
        (a, b)
        for a, b in itertools.permutations(methods, 2)
        if len(methods[a]) > 1 and 0.5 < methods[a].mean() / methods[b].mean() < 2.0
    ]
    pairs = {frozenset(pair) for pair in near}
    if rests:
        noise = float(np.mean(rests))
    else:
        noise = np.nan
    gaps = []
    for a, b in sorted(map(sorted, pairs)):
        apart = float(
            np.var(relative[a].mean(axis=0) - relative[b].mean(axis=0), ddof=1)
        )
        of_seeds = noise * (1 / len(methods[a]) + 1 / len(methods[b]))
        gaps.append(max(0.0, apart - of_seeds) / 2)

    def root(variances: list[float]) -> float:
        if variances:
            return float(np.sqrt(np.mean(variances)))
        return np.nan

    return Scatter(root(seeds), root(rests), root(gaps))


def share_told_apart(
    scatter: Scatter,
    scenarios: int,
    difference: float,
    seeds: int,
    others: int | None = None,
) -> float:
    """Return the share of draws of two methods so far apart that the test tells apart.

    The second has as many seeds as the first, or others.
    """
    rng = np.random.Generator(np.random.PCG64(0))
    told = 0
    for _ in range(DRAWS):
        sides = []
        for level, count in ((1.0, seeds), (1.0 - difference, others or seeds)):
            own = rng.normal(0.0, scatter.method if difference else 0.0, scenarios)
            seed = rng.normal(0.0, scatter.seed, (count, 1))
            sides.append(
                level
                * (1.0 + own + seed + rng.normal(0.0, scatter.rest, (count, scenarios)))
            )
        told += differ(*sides) < SIGNIFICANCE
    return told / DRAWS


def pairs_of_seeds() -> tuple[int, int]:
    """Return how many pairs of seeds of one method there are, and how many differ as
    weights.
    """
    p = [
        differ(a, b)
        for split in TEST
        for values in read_methods(split).values()
        for a, b in itertools.combinations(values, 2)
    ]
    return len(p), sum(value < SIGNIFICANCE for value in p)


def tables() -> str:
    """Return the page."""
    cases = [(f"assumed: {name}", 16, scatter) for name, scatter in ASSUMED.items()]
    for split, scenarios in TEST.items():
        scatter = measured_scatter(read_methods(split))
        if np.isfinite(astuple(scatter)).all():
            cases.append((split, scenarios, scatter))
    rows = []
    wrong = []
    for name, scenarios, scatter in cases:
        spread = " | ".join(f"{100 * value:.1f} %" for value in astuple(scatter))
        power = " | ".join(
            f"{share_told_apart(scatter, scenarios, d, SEEDS):.2f}" for d in DIFFERENCES
        )
        rows.append(f"| {name} | {scenarios} | {spread} | {power} |")
        sides = ((1, 1), (1, SEEDS), (2, 2), (3, 3), (5, 5))
        false = [
            100 * share_told_apart(scatter, scenarios, 0.0, *seeds) for seeds in sides
        ]
        wrong.append(f"| {name} | {' | '.join(f'{share:.1f} %' for share in false)} |")
    pairs, differing = pairs_of_seeds()
    return f"""# Power: what the test can tell apart

Written by `python benchmarks/power.py --write`: by three assumptions about how much methods and seeds
scatter, and from the score files of the mini sizes below leaderboard/scores, a row for each data set that
has two near methods, one of them of several seeds (two methods of two seeds each are a rough measure).

The value of seed s in scenario i is read as mean x (1 + scenario + method-in-scenario + seed + rest).
Two methods share the scenarios; what is left are the three standard deviations below, relative to a
method's mean. The last three columns say how often `lagbench.metrics.differ` tells two methods apart
at 5 %, with {SEEDS} seeds each, if one is better by 5, 10 and 20 % ({DRAWS} draws).

| case | test scenarios | seed | rest | method in scenario | 5 % | 10 % | 20 % |
|---|---|---|---|---|---|---|---|
{chr(10).join(rows)}

A difference that is small beside the scatter of seeds is not found with more scenarios: only with
more seeds. A board that ranks by hundredths ranks by chance.

## Equal methods that are told apart

Both sides are seeds of one method: at most 5 % may differ (give or take 1.4, the error of so many draws).
With one seed a side the test is the sign-flip test over scenarios. It is right about those weights, and
wrong about the method as often as the first column says: why such a row says "these weights". So does a
row of one seed beside one of several, whose scatter alone is known.

| case | 1 seed a side | 1 and {SEEDS} | 2 | 3 | 5 |
|---|---|---|---|---|---|
{chr(10).join(wrong)}

The score files have {pairs} pairs of single seeds of one method; {differing} of them differ as weights.
"""


def main() -> int:
    """Print the tables; write them with --write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="write docs/power.md")
    write = parser.parse_args().write
    page = tables()
    print(page)
    if write:
        (ROOT / "docs" / "power.md").write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
