"""Which materials meet where methods of the board err: the error by the materials of a
test scenario.

    python benchmarks/by_materials.py --size full --root DATA neuralmpm-projected neuralmpm-conserving

prints, for the entries named (mean over their seeds) and the floors of a split, the
metric that ranks in the mean over the test scenarios of each set of materials, and over
all. Data are read for the materials alone.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from lagbench.data import MATERIALS
from lagbench.data.local import resolve_root
from lagbench.data.registry import load
from lagbench.data.scenario import read_scenario
from lagbench.figures.tables import markdown
from lagbench.errors import LagbenchError, nearest
from lagbench.metrics.table import ranking_metric
from lagbench.references import shipped
from lagbench.scoring.stored import published

BOARD = Path(__file__).parent.parent / "leaderboard"


def main() -> int:
    """Read and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("methods", nargs="+", help="entries of the board")
    parser.add_argument("--split", default="multimaterial")
    parser.add_argument("--size", default="mini")
    parser.add_argument("--root", type=Path, help="where data sets are")
    asked = parser.parse_args()
    size = load().size(asked.split, asked.size)
    root = resolve_root(asked.root)
    metric = ranking_metric(size)
    scenarios = sorted(size.subsets["test"])
    kinds = []
    for scenario in scenarios:
        with read_scenario(size.path(root, scenario)) as file:
            kinds.append(
                " + ".join(MATERIALS[kind] for kind in np.unique(file.read("material")))
            )
    rows = {
        name: floor.scores[metric].values
        for name, floor in (shipped(size) or {}).items()
    }
    folder = BOARD / "scores" / asked.split / asked.size
    for method in asked.methods:
        files = [
            path
            for path in sorted(folder.glob("*.nc"))
            if method == path.stem.rpartition("_")[0]
        ]
        if (folder / f"{method}.nc").is_file():
            files = [folder / f"{method}.nc"]
        else:
            files = files
        if not files:
            known = sorted(
                {path.stem.partition("_")[0] for path in folder.glob("*.nc")}
            )
            parser.error(
                f"no entry {method!r} of {asked.split} {asked.size}: "
                f"{nearest(method, known)}"
            )
        seeds = [published(path).scores["submission"][metric].values for path in files]
        rows[method] = np.mean(seeds, axis=0)
    sets = sorted(set(kinds))
    lines = []
    for name, values in rows.items():
        means = [
            float(np.mean(np.asarray(values)[np.array(kinds) == one])) for one in sets
        ]
        lines.append(
            [name, *(f"{mean:.4f}" for mean in [*means, float(np.mean(values))])]
        )
    head = [f"{one} ({kinds.count(one)})" for one in sets]
    print(markdown([metric, *head, f"all ({len(kinds)})"], lines))
    return 0


if __name__ == "__main__":
    try:
        raise SystemExit(main())
    except LagbenchError as error:
        print(f"by_materials: {error}", file=sys.stderr)
        raise SystemExit(error.exit_code) from error
