"""Print what the floors score, and whether the tasks can be won without learning, as
Markdown.

    python benchmarks/floors.py [--data cavity/full ...] [--each]

From the scores that the package ships (``python -m lagbench.scoring.measure_references`` measures
them): for each data set and floor the ranking metric with its 95 % interval over test
scenarios, the correlation of vorticity at frame 54 (tiny: the last), and the CPU time
of a frame; the best floor is marked. Then, for the full boxes, the share of test
scenarios in which the frozen field correlates below 0.8 at that frame, and its median
relative error of the vorticity; for the free surfaces how long the truth moves. Exits
with 1 where, at full or mini, that share is below 75 %, or the median error of the
cavity below 0.8. ``frozen_field.py`` measures the same from the data.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping

import numpy as np

from lagbench.data.registry import Size, load
from lagbench.metrics.table import ranking_metric
from lagbench.references import ReferenceScores, shipped
from lagbench.references.table import COUNTING
from lagbench.scoring.skill import best_reference

FALLEN = 0.8
SHARE = 0.75
ERROR = 0.8
ACCEPTED = ("full", "mini")


def main() -> int:
    """Print both tables; tell whether every task asks enough."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--data", nargs="+", metavar="SPLIT/SIZE")
    parser.add_argument(
        "--each",
        action="store_true",
        help="correlation of the frozen field by scenario",
    )
    given = parser.parse_args()
    registry = load()
    names = given.data or [
        f"{name}/{tier}" for name, s in registry.splits.items() for tier in s.sizes
    ]
    sizes = [registry.size(*name.split("/")) for name in names]
    held = [(size, floors) for size in sizes if (floors := shipped(size))]
    print(
        "| data set | floor | ranking metric | 95 % interval | correlation | seconds "
        "per frame |"
    )
    print("|---|---|---:|---:|---:|---:|")
    for size, floors in held:
        _print_floors(size, floors)
    print(
        "\n| data set | frozen field below 0.8 | median correlation | median error "
        "|\n|---|---:|---:|---:|"
    )
    enough = [_asks_enough(size, floors, each=given.each) for size, floors in held]
    print(
        "\n| data set | active frames, median | least | greatest | of "
        "|\n|---|---:|---:|---:|---:|"
    )
    for size, floors in held:
        _print_active(size, floors)
    if all(enough):
        return 0
    return 1


def _print_floors(size: Size, floors: Mapping[str, ReferenceScores]) -> None:
    ranking = ranking_metric(size)
    best = best_reference(
        {name: floors[name].scores[ranking] for name in COUNTING.intersection(floors)}
    )
    for name, floor in floors.items():
        score = floor.scores[ranking]
        low, high = score.interval
        known = floor.correlation[np.isfinite(floor.correlation)]
        if known.size:
            correlation = f"{np.mean(known):.3f}"
        else:
            correlation = "undefined"
        print(
            f"| {size.split} {size.name} | {name}{' (best)' if name == best else ''} "
            f"| {score.mean:.4g} |"
            f" {low:.3g} to {high:.3g} | {correlation} | "
            f"{floor.seconds_per_frame:.2g} |"
        )


def _asks_enough(
    size: Size, floors: Mapping[str, ReferenceScores], *, each: bool
) -> bool:
    """Print how often the frozen field fails; a correlation that is undefined has
    failed.
    """
    if "frozen-field" not in floors:
        return True
    frozen = floors["frozen-field"]
    correlation = frozen.correlation
    error = float(np.median(frozen.scores["vorticity_nrmse"].values))
    below = float(np.mean(~(correlation >= FALLEN)))
    middle = float(np.nanmedian(correlation))
    print(
        f"| {size.split} {size.name} | {below:.0%} of {correlation.size} | "
        f"{middle:.3f} | {error:.3g} |"
    )
    if each:
        print(f"| | {' '.join(f'{value:.2f}' for value in correlation)} | | |")
    strong = size.split != "cavity" or error >= ERROR
    return size.name not in ACCEPTED or (below >= SHARE and strong)


def _print_active(size: Size, floors: Mapping[str, ReferenceScores]) -> None:
    """Print for how many of the predicted frames the truth of a free surface moves."""
    if "free-flight" in floors:
        active = floors["free-flight"].scores["active_frames"].values
        where = f"{size.split} {size.name} | {np.median(active):g}"
        print(
            f"| {where} | {np.min(active):g} | {np.max(active):g} | "
            f"{size.task.horizon} |"
        )


if __name__ == "__main__":
    raise SystemExit(main())
