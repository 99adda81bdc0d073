"""Print the error of methods of the board by the materials of a test scenario.

    python benchmarks/by_materials.py --size full --root DATA neuralmpm-projected

prints the metric that ranks, for the named entries (mean over their seeds) and for the
reference predictors of a split: the mean over the test scenarios of each set of
materials, and over all. Scenarios without a value do not count; a mean of none is nan.
Data are read for the materials alone.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lagbench.data import MATERIALS
from lagbench.data.local import resolve_root
from lagbench.data.registry import Size, load
from lagbench.data.scenario import read_scenario
from lagbench.errors import LagbenchError, UsageError, suggest_name
from lagbench.figures.tables import markdown
from lagbench.metrics.aggregate import mean_over_seeds
from lagbench.metrics.metric import mean
from lagbench.metrics.table import ranking_metric
from lagbench.references import shipped
from lagbench.scoring.score_file_checks import read_published_scores

BOARD = Path(__file__).parent.parent / "leaderboard"


def main() -> int:
    """Read and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("methods", nargs="+", help="entries of the board")
    parser.add_argument("--split", default="multimaterial")
    parser.add_argument("--size", default="mini")
    parser.add_argument("--root", type=Path, help="folder of all data sets")
    options = parser.parse_args()
    size = load().size(options.split, options.size)
    metric = ranking_metric(size)
    values_by_method = {}
    references = shipped(size) or {}
    for name, reference in references.items():
        values_by_method[name] = reference.scores[metric].values
    for method in options.methods:
        values_by_method[method] = read_values(size, method, metric)

    root = resolve_root(options.root)
    kinds = np.array(read_kinds(size, root))
    names, counts = np.unique(kinds, return_counts=True)
    heads = [metric]
    for name, count in zip(names, counts, strict=True):
        heads.append(f"{name} ({count})")
    heads.append(f"all ({len(kinds)})")
    lines = []
    for method, values in values_by_method.items():
        cells = [method]
        for kind_mean in means_by_kind(values, kinds):
            cells.append(f"{kind_mean:.4f}")
        lines.append(cells)
    print(markdown(heads, lines))
    return 0


def read_kinds(size: Size, root: Path) -> list[str]:
    """Return the materials of each test scenario, as in "liquid + snow"."""
    kinds = []
    for scenario in sorted(size.subsets["test"]):
        path = size.path(root, scenario)
        with read_scenario(path) as file:
            materials = np.unique(file.read("material"))
        names = [MATERIALS[material] for material in materials]
        kinds.append(" + ".join(names))
    return kinds


def read_values(size: Size, method: str, metric: str) -> NDArray[np.float64]:
    """Return a metric of an entry, the mean over its seeds, shape [scenario].

    Seeds without a value do not count.
    """
    folder = BOARD / "scores" / size.split / size.name
    seed_files = []
    methods = set()
    for path in sorted(folder.glob("*.nc")):
        file_method, _, _ = path.stem.rpartition("_")
        methods.add(file_method or path.stem)
        if file_method == method:
            seed_files.append(path)
    single_file = folder / f"{method}.nc"
    if single_file.is_file():
        seed_files = [single_file]
    if not seed_files:
        raise UsageError(
            f"no entry {method!r} of {size.split} {size.name}",
            where="METHOD",
            fix=suggest_name(method, sorted(methods)),
        )
    seeds = []
    for path in seed_files:
        published = read_published_scores(path)
        score = published.scores["submission"][metric]
        seeds.append(score.values)
    return mean_over_seeds(seeds)


def means_by_kind(values: NDArray[np.float64], kinds: NDArray[np.str_]) -> list[float]:
    """Return the mean over the scenarios of each kind, then that over all.

    Args:
        values: a metric of a method, shape [scenario]; NaN does not count.
        kinds: materials of the scenarios, shape [scenario].
    """
    means = []
    for name in np.unique(kinds):
        is_kind = kinds == name
        means.append(mean(values[is_kind]))
    means.append(mean(values))
    return means


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"by_materials: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
