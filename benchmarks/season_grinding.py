"""How much does it pay to grind the seed of a blind season?

usage: python benchmarks/season_grinding.py [--board leaderboard] [--size mini]
           [--scenarios 8] [--tries 1 10 100 1000 10000]

Whoever submits last could change a bit of a model, draw the blind scenarios that
follow, and repeat that until the draw suits the model. The scores of the board say what
that gains. A redraw takes scenarios of test with replacement; of so many redraws the
best skill counts. The second table compares the best method with the next one: how
often the next one looks better in the best of so many redraws. Redraws are seeded:
every call prints the same.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lagbench.board.build import Scope, collect
from lagbench.board.folder import Folder
from lagbench.board.model import Tab
from lagbench.figures.tables import markdown
from lagbench.references.shipped import shipped
from lagbench.references.table import NAIVE
from lagbench.scoring.skill import best_reference

Floats = NDArray[np.float64]

REDRAWS = 200_000


def expected_best(values: Floats, tries: int) -> float:
    """Return the expected maximum of so many independent draws from values."""
    ordered = np.sort(values)
    count = len(ordered)
    # Probability that one draw is no greater than each value; of all draws its power.
    ranks = np.arange(1, count + 1)
    one_draw = ranks / count
    all_draws = one_draw**tries
    distribution = np.concatenate([[0.0], all_draws])
    weights = np.diff(distribution)
    weighted = weights * ordered
    return float(np.sum(weighted))


def draw(count: int, scenarios: int) -> NDArray[np.intp]:
    """Return redraws of scenarios with replacement, shape [redraw, scenario]."""
    generator = np.random.Generator(np.random.PCG64(0))
    uniform = generator.random((REDRAWS, scenarios))
    numbers = np.floor(uniform * count)
    return numbers.astype(np.intp)


def leaders(tab: Tab, metric: str) -> list[tuple[str, Floats]]:
    """Return the two best methods that are no variants, with their values."""
    methods = []
    for row in tab.rows:
        if row.variant_of is not None or not row.current:
            continue
        if metric in row.values:
            score = row.values[metric]
            values = np.array(score.per_scenario)
            methods.append((row.entry.method, values))
    methods.sort(key=_mean_score)
    return methods[:2]


def _mean_score(method: tuple[str, Floats]) -> float:
    """Return the mean score of a method over the scenarios."""
    _, values = method
    return float(np.mean(values))


def naive_values(tab: Tab, metric: str) -> Floats | None:
    """Return the scores of the best naive predictor by scenario, None without any."""
    references = shipped(tab.size) or {}
    naive = {}
    for name, reference in references.items():
        if name in NAIVE and metric in reference.scores:
            naive[name] = reference.scores[metric]
    best = best_reference(naive)
    if best is None:
        return None
    return naive[best].values


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the two tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--board", default="leaderboard")
    parser.add_argument("--size", default="mini")
    parser.add_argument("--scenarios", type=int, default=8)
    parser.add_argument(
        "--tries", type=int, nargs="+", default=[1, 10, 100, 1000, 10000]
    )
    options = parser.parse_args(arguments)

    data_sets = set()
    for split, size in Folder(options.board).data_sets():
        if size == options.size:
            data_sets.add((split, size))
    ranking_only = Scope(metrics=(), intervals=(), has_pictures=False)
    gains = []
    swaps = []
    for tab in collect(options.board, only=data_sets, scope=ranking_only).tabs:
        metric = tab.ranking
        base = naive_values(tab, metric)
        if base is None:
            continue
        chosen = draw(len(base), options.scenarios)
        base_redraws = base[chosen]
        base_means = base_redraws.mean(axis=1)
        methods = leaders(tab, metric)
        place = f"{tab.size.split} {tab.size.name}"

        method, values = methods[0]
        redraws = values[chosen]
        means = redraws.mean(axis=1)
        skills = 1.0 - means / base_means
        mean_skill = float(np.mean(skills))
        deviation = float(np.std(skills))
        cells = [f"{mean_skill:.3f} ± {deviation:.3f}"]
        for tries in options.tries[1:]:
            best_skill = expected_best(skills, tries)
            gain = best_skill - mean_skill
            cells.append(f"{gain:+.3f}")
        gains.append((place, method, *cells))

        if len(methods) > 1:
            next_method, next_values = methods[1]
            next_redraws = next_values[chosen]
            next_means = next_redraws.mean(axis=1)
            next_skills = 1.0 - next_means / base_means
            leads = skills - next_skills
            lead = float(np.mean(leads))
            share_behind = float(np.mean(leads >= 0.0))
            cells = [f"{lead:.3f}"]
            for tries in options.tries:
                always_behind = share_behind**tries
                probability = 1.0 - always_behind
                cells.append(f"{probability:.3f}")
            swaps.append((place, method, next_method, *cells))

    gain_head = ["data set", "leading entry", "skill of a draw ± standard deviation"]
    for tries in options.tries[1:]:
        gain_head.append(f"gain, best of {tries:,}")
    swap_head = ["data set", "leading entry", "second entry", "lead in skill"]
    for tries in options.tries:
        place = "1 draw"
        if tries > 1:
            place = f"one of {tries:,} draws"
        swap_head.append(f"second leads in {place}")
    gain_table = markdown(gain_head, gains)
    swap_table = markdown(swap_head, swaps)
    sys.stdout.write(f"{gain_table}\n\n")
    sys.stdout.write(f"{swap_table}\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
