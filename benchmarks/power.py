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
from collections import Counter, defaultdict
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


def count_test_scenarios() -> dict[str, int]:
    """Return the number of test scenarios at size mini, by split."""
    registry = load()
    counts = {}
    for split in registry.splits:
        size = registry.size(split, "mini")
        counts[split] = len(size.subsets["test"])
    return counts


def read_methods(split: str) -> dict[str, Floats]:
    """Return the ranking metric of each method of the mini size.

    The shape is [seed, scenario].
    """
    size = load().size(split, "mini")
    metric = ranking_metric(size)
    folder = ROOT / "leaderboard" / "scores" / split / "mini"
    seeds_by_method = defaultdict(list)
    for path in sorted(folder.glob("*.nc")):
        method = re.sub(r"_\d+$", "", path.stem)
        scores = read_statistics(path).scores()
        seeds_by_method[method].append(scores[metric].values)
    methods = {}
    for method, seeds in seeds_by_method.items():
        methods[method] = np.array(seeds)
    return methods


def measure_scatter(methods: dict[str, Floats]) -> Scatter:
    """Return the scatter of methods.

    It is NaN where no method has two seeds, or none of those has a near rival.
    """
    relative = {}
    for name, values in methods.items():
        relative[name] = values / values.mean()
    seed_variances = []
    rest_variances = []
    for values in relative.values():
        seed_count, scenario_count = values.shape
        if seed_count < 2:
            continue
        deviation = values - values.mean(axis=0)
        seed_deviation = deviation.mean(axis=1, keepdims=True)
        rest = deviation - seed_deviation
        freedom = (seed_count - 1) * (scenario_count - 1)
        square_sum = float(np.sum(rest**2))
        rest_variance = square_sum / freedom
        rest_variances.append(rest_variance)
        variance = float(np.var(seed_deviation, ddof=1))
        seed_variance = variance - rest_variance / scenario_count
        seed_variances.append(max(0.0, seed_variance))

    noise = np.nan
    if rest_variances:
        noise = float(np.mean(rest_variances))
    method_variances = []
    for first, second in _near_pairs(methods):
        first_seeds = relative[first]
        second_seeds = relative[second]
        difference = first_seeds.mean(axis=0) - second_seeds.mean(axis=0)
        variance = float(np.var(difference, ddof=1))
        seed_share = 1 / len(first_seeds) + 1 / len(second_seeds)
        variance_of_both = max(0.0, variance - noise * seed_share)
        method_variances.append(variance_of_both / 2)
    return Scatter(
        seed=_root_mean(seed_variances),
        rest=_root_mean(rest_variances),
        method=_root_mean(method_variances),
    )


def _near_pairs(methods: dict[str, Floats]) -> list[tuple[str, str]]:
    """Return pairs whose means differ by less than a factor 2, one with two seeds."""
    pairs = []
    for first, second in itertools.combinations(sorted(methods), 2):
        first_seeds = methods[first]
        second_seeds = methods[second]
        ratio = first_seeds.mean() / second_seeds.mean()
        most_seeds = max(len(first_seeds), len(second_seeds))
        if most_seeds > 1 and 0.5 < ratio < 2.0:
            pairs.append((first, second))
    return pairs


def _root_mean(variances: list[float]) -> float:
    if not variances:
        return np.nan
    variance = np.mean(variances)
    return float(np.sqrt(variance))


def share_told_apart(
    scatter: Scatter,
    scenarios: int,
    difference: float,
    *,
    seeds: int,
    other_seeds: int | None = None,
) -> float:
    """Return the share of draws in which the test tells two methods apart.

    Their means differ by a relative difference. The second has as many seeds as the
    first, or ``other_seeds``.
    """
    rng = np.random.Generator(np.random.PCG64(0))
    method_scatter = scatter.method if difference else 0.0
    other_level = 1.0 - difference
    level_and_seeds = [(1.0, seeds), (other_level, other_seeds or seeds)]
    significant_count = 0
    for _ in range(DRAWS):
        sides = []
        for level, count in level_and_seeds:
            by_scenario = rng.normal(0.0, method_scatter, scenarios)
            by_seed = rng.normal(0.0, scatter.seed, (count, 1))
            rest = rng.normal(0.0, scatter.rest, (count, scenarios))
            relative = 1.0 + by_scenario + by_seed + rest
            sides.append(level * relative)
        significance = differ(*sides)
        significant_count += significance < SIGNIFICANCE
    return significant_count / DRAWS


def count_pairs_of_seeds() -> tuple[Counter[str], int]:
    """Return how many pairs of seeds of one method each split has at size mini, and in
    how many of all pairs the seeds differ.
    """
    pairs: Counter[str] = Counter()
    differing_count = 0
    for split in count_test_scenarios():
        for values in read_methods(split).values():
            for first, second in itertools.combinations(values, 2):
                pairs[split] += 1
                differing_count += differ(first, second) < SIGNIFICANCE
    return pairs, differing_count


PAGE = """\
# Power: which differences can the test find?

`lagbench compare` and the leaderboard use the statistical test
`lagbench.metrics.differ`. After this page you know:

- how small a difference the test can find;
- how often the test finds a difference between two trainings of the same method.

This command writes the page:

```bash
python benchmarks/power.py --write
```

## Differences that the test finds

We drew random scores of two methods, {draws} times. Each method had {seeds} seeds. One
method was better by 5, 10 or 20 %. The last three columns show the share of the draws
in which the test found this difference at the level of 5 %:

| case | test scenarios | seed | rest | method in scenario | 5 % | 10 % | 20 % |
|---|---|---|---|---|---|---|---|
{rows}

**Scatter.** With seed s in scenario i, a method of mean m has the score
m (1 + b_i + c_s + e_si). The columns show the standard deviations of the three random
terms:

- *seed*: c_s changes all scores of a seed;
- *method in scenario*: b_i changes the scores of all seeds of a method in a scenario;
- *rest*: e_si changes the score of one seed in one scenario.

A scenario may be harder for both methods. We left out this effect, because it nearly
cancels in the difference of the two methods.

**Rows.** The first three rows use assumed values. The other rows use values from the
score files of size mini. *Seed* and *rest* come from all methods with several seeds.
*Method in scenario* comes from pairs of methods whose means differ by less than a
factor of two, and of which at least one has several seeds. A split may have only one
such pair, so these values are rough. A split without such a pair has no row.

More scenarios do not remove the scatter between seeds. Train more seeds if two methods
differ by less than this scatter.

## Differences between equal methods

In this table both sides have seeds of the same method. With several seeds on each side
the test should find a difference in at most 5 % of the draws. With {draws} draws, a
rate of 5 % gives a share between 3.6 and 6.4 % (95 % interval).

| case | 1 seed each | 1 against {seeds} seeds | 2 each | 3 each | 5 each |
|---|---|---|---|---|---|
{false_rows}

If one side has only one seed, the test judges the weights of this seed, not the method
([table](scoring.md#comparing-two-methods)). These weights may really be better or worse
than other weights of the same method. So the leaderboard speaks of "these weights".

The rows *middling* and *large* are equal. All deviations of *large* are twice those of
*middling*, and a common factor does not change the test.

The score files of size mini have {pair_count} pairs of two seeds of the same method:
{pairs_by_split}. The test finds a difference in {differing_count} of these pairs. The
entries of some of these score files are not [active](glossary.md).
"""

SIDES = ((1, 1), (1, SEEDS), (2, 2), (3, 3), (5, 5))
"""Seeds of two equal methods."""


def render_page() -> str:
    """Return the page."""
    cases = []
    for name, scatter in ASSUMED.items():
        cases.append((f"assumed: {name}", 16, scatter))
    for split, scenarios in count_test_scenarios().items():
        methods = read_methods(split)
        scatter = measure_scatter(methods)
        is_known = np.isfinite(astuple(scatter))
        if is_known.all():
            cases.append((split, scenarios, scatter))

    rows = []
    false_rows = []
    for name, scenarios, scatter in cases:
        cells = [name, str(scenarios)]
        for deviation in astuple(scatter):
            cells.append(f"{100 * deviation:.1f} %")
        for difference in DIFFERENCES:
            share = share_told_apart(
                scatter,
                scenarios,
                difference,
                seeds=SEEDS,
            )
            cells.append(f"{share:.2f}")
        rows.append(f"| {' | '.join(cells)} |")

        false_cells = [name]
        for seeds, other_seeds in SIDES:
            share = share_told_apart(
                scatter,
                scenarios,
                0.0,
                seeds=seeds,
                other_seeds=other_seeds,
            )
            false_cells.append(f"{100 * share:.1f} %")
        false_rows.append(f"| {' | '.join(false_cells)} |")
    pairs, differing_count = count_pairs_of_seeds()
    pairs_by_split = [f"{count} on {split}" for split, count in pairs.items()]
    return PAGE.format(
        seeds=SEEDS,
        draws=DRAWS,
        rows="\n".join(rows),
        false_rows="\n".join(false_rows),
        pair_count=pairs.total(),
        pairs_by_split=", ".join(pairs_by_split),
        differing_count=differing_count,
    )


def main() -> int:
    """Print the tables; write them with --write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--write", action="store_true", help="write docs/power.md")
    write = parser.parse_args().write
    page = render_page()
    print(page)
    if write:
        path = ROOT / "docs" / "power.md"
        path.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
