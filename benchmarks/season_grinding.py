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

from lagbench.board.build import collect
from lagbench.board.model import Tab
from lagbench.figures.tables import markdown
from lagbench.references.shipped import shipped
from lagbench.references.table import NAIVE
from lagbench.scoring.skill import best_reference

REDRAWS = 200_000


def expected_best(values: NDArray[np.float64], tries: int) -> float:
    """Return the expected maximum of so many independent draws from values."""
    ordered = np.sort(values)
    rank = np.arange(1, len(ordered) + 1) / len(ordered)
    weights = np.diff(np.concatenate([[0.0], rank**tries]))
    return float(np.sum(weights * ordered))


def draw(count: int, scenarios: int) -> NDArray[np.intp]:
    """Return redraws of scenarios with replacement, shape [redraw, scenario]."""
    generator = np.random.Generator(np.random.PCG64(0))
    uniform = generator.random((REDRAWS, scenarios))
    return np.floor(uniform * count).astype(np.intp)


def leaders(tab: Tab, metric: str) -> list[tuple[str, NDArray[np.float64]]]:
    """Return the two best methods that are no variants, with their values."""
    rows = []
    for row in tab.rows:
        if row.variant_of is None and row.current and metric in row.values:
            values = np.array(row.values[metric].per_scenario)
            rows.append((row.entry.method, values))
    return sorted(rows, key=lambda row: float(np.mean(row[1])))[:2]


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

    gains = []
    swaps = []
    for tab in collect(options.board).tabs:
        if tab.size.name != options.size:
            continue
        metric = tab.ranking
        naive = {}
        for name, reference in (shipped(tab.size) or {}).items():
            if name in NAIVE and metric in reference.scores:
                naive[name] = reference.scores[metric]
        best = best_reference(naive)
        if best is None:
            continue
        base = naive[best].values
        chosen = draw(len(base), options.scenarios)
        denominator = base[chosen].mean(axis=1)
        rows = leaders(tab, metric)
        place = f"{tab.size.split} {tab.size.name}"
        method, values = rows[0]
        skills = 1.0 - values[chosen].mean(axis=1) / denominator
        middle = float(np.mean(skills))
        cells = [f"{middle:.3f}", f"{float(np.std(skills)):.3f}"]
        for tries in options.tries[1:]:
            cells.append(f"{expected_best(skills, tries) - middle:+.3f}")
        gains.append((place, method, *cells))
        if len(rows) > 1:
            other, other_values = rows[1]
            others = 1.0 - other_values[chosen].mean(axis=1) / denominator
            lead = others - skills
            share = float(np.mean(lead > 0.0))
            cells = [f"{float(np.mean(skills - others)):.3f}"]
            for tries in options.tries:
                cells.append(f"{1.0 - (1.0 - share) ** tries:.3f}")
            swaps.append((place, method, other, *cells))

    counts = [str(tries) for tries in options.tries]
    head = ["data set", "leader", "skill", "deviation of a redraw"]
    gain_head = [*head, *(f"gain, best of {count}" for count in counts[1:])]
    swap_head = ["data set", "leader", "next", "lead in skill"]
    swap_head += [f"next wins, best of {count}" for count in counts]
    sys.stdout.write(markdown(gain_head, gains) + "\n\n")
    sys.stdout.write(markdown(swap_head, swaps) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
