"""Score the two floors, persistence and constant velocity, and print them as Markdown.

    python benchmarks/floors.py --root FOLDER [--data cavity/mini ...]

The submission is the template that `lagbench template` writes (persistence); the scorer computes
both floors beside every submission. Intervals are 95 % bootstrap intervals over test scenarios.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import lagbench
from lagbench.errors import DataError
from lagbench.scoring.card import ScoreCard

DATA = ("cavity/full", "cavity/mini", "curl-noise/mini", "fluid/mini", "multimaterial/mini")
METRICS = ("vorticity_rmse", "vorticity_pearson", "position_rmse", "mse_avg", "energy_error")
ROWS = ("persistence", "constant-velocity")


def main() -> int:
    """Print one row per data set and floor; the ranking metric carries its interval."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--data", nargs="+", default=DATA, metavar="SPLIT/SIZE")
    given = parser.parse_args()
    print(f"| data set | floor | {' | '.join(f'`{name}`' for name in METRICS)} |")
    print(f"|---|---|{'---:|' * len(METRICS)}")
    for name in given.data:
        split, size = name.split("/")
        try:
            card = _score(split, size, given.root)
        except DataError as error:
            print(f"{name} is left out: {error}", file=sys.stderr)
            continue
        for row in ROWS:
            cells = [_cell(card.scores[row][metric], ranks=metric == card.ranking) for metric in METRICS]
            print(f"| {split} {size} | {row} | {' | '.join(cells)} |", flush=True)
    return 0


def _score(split: str, size: str, root: Path) -> ScoreCard:
    """Score the template of a data set, in a folder that is gone afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "predictions.nc"
        lagbench.template(split, size, output=file, root=root)
        return lagbench.score(file, root=root)


def _cell(score: lagbench.metrics.Score, *, ranks: bool) -> str:
    if score.mean != score.mean:  # NaN: undefined in every frame
        return "undefined"
    interval = f" ({score.interval[0]:.3g} to {score.interval[1]:.3g})" if ranks else ""
    return f"{score.mean:.3g}{interval}"


if __name__ == "__main__":
    raise SystemExit(main())
