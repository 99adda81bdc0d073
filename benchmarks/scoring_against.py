"""The scorer of this tree against that of another commit, on one core, in one run.

    python benchmarks/scoring_against.py --against 0e958a2

checks the other commit out beside this one (0e958a2 is the last with version 1 of the
data). Each tree makes a submission to cavity full of the same rotating_disc by its own
``score_data.py`` and scores it in processes of its own, in turns; the first round,
which may hash the truth, is not counted. Printed is the processor time per scenario of
90 frames, imports aside (best of the rounds), what the validation's child takes of it,
the memory of the largest process, and the ratios.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import tomllib
from pathlib import Path

from solver_against import HERE, checked_out, on_one_core

from lagbench.baselines.machine import hardware

MAKE = """
import sys
from pathlib import Path
sys.path.insert(0, "benchmarks")
from score_data import make_score_data
make_score_data(Path(sys.argv[1]))
"""

SCORE = """
import json, resource, sys
from pathlib import Path
import lagbench.scoring.score, netCDF4, scipy.special  # imports are not counted
from lagbench.data.registry import load
for name, module in list(sys.modules.items()):
    if name.startswith("lagbench.submission.") and hasattr(module, "CPU_SECONDS"):
        module.CPU_SECONDS = 600.0  # on a busy machine processor time is no constant
folder, who = Path(sys.argv[1]), (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
def used():
    return [sum(resource.getrusage(one)[:2]) for one in who]
before, registry = used(), load(folder / "datasets.yaml")
lagbench.scoring.score.score(
    folder / "predictions.nc", root=folder / "root", registry=registry, workers=1
)
own, children = (after - then for after, then in zip(used(), before))
count = len(registry.size("cavity", "full").subsets["test"])
peak = int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
peak = max(peak, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
print(json.dumps({
    "cpu": (own + children) / count,
    "children": children / count,
    "memory": 1024 * peak,
}))
"""


def score(tree: Path, data: Path) -> dict[str, float]:
    """Return what a tree's scorer takes for the data that it made."""
    printed = on_one_core(tree, "-c", SCORE, str(data), OMP_NUM_THREADS="1")
    costs: dict[str, float] = json.loads(printed)
    return costs


def declare(tree: Path) -> None:
    """Write the entry points that a tree declares.

    An installation of another tree would hide them.
    """
    settings_path = tree / "pyproject.toml"
    settings = tomllib.loads(settings_path.read_text())
    entry_point_groups = settings["project"]["entry-points"]
    lines = []
    for group, entry_points in entry_point_groups.items():
        lines.append(f"[{group}]")
        for name, target in entry_points.items():
            lines.append(f"{name} = {target}")
        lines.append("")
    folder = tree / "lagbench.egg-info"
    folder.mkdir()
    (folder / "PKG-INFO").write_text(
        "Metadata-Version: 2.1\nName: lagbench\nVersion: 0\n"
    )
    (folder / "entry_points.txt").write_text("\n".join(lines))


def main() -> int:
    """Check the other commit out, score in both trees in turns and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", required=True, metavar="REV")
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, checked_out(options.against) as other:
        declare(other)
        best: dict[Path, dict[str, float]] = {}
        data_folders = {
            other: Path(folder, "theirs"),
            HERE: Path(folder, "ours"),
        }
        for tree, data in data_folders.items():
            data.mkdir()
            on_one_core(tree, "-c", MAKE, str(data), OMP_NUM_THREADS="1")
        for tree, data in data_folders.items():
            score(tree, data)
        for _ in range(options.rounds):
            for tree, data in data_folders.items():
                costs = score(tree, data)
                best_costs = best.setdefault(tree, costs)
                if costs["cpu"] < best_costs["cpu"]:
                    best[tree] = costs
    print(f"{hardware()['processor']}, one core, cavity full, all metrics but Sinkhorn")
    print(
        f"| per scenario of 90 frames | {options.against} | this tree | ratio "
        f"|\n|---|---|---|---|"
    )
    print_row("processor time [s]", best[other]["cpu"], best[HERE]["cpu"])
    print_row("of it in children [s]", best[other]["children"], best[HERE]["children"])
    print_row(
        "memory of the largest process [MB]",
        best[other]["memory"] / 1e6,
        best[HERE]["memory"] / 1e6,
    )
    return 0


def print_row(name: str, theirs: float, ours: float) -> None:
    """Print a cost of both trees and the ratio of ours to theirs."""
    ratio = ours / theirs
    print(f"| {name} | {theirs:.2f} | {ours:.2f} | {ratio:.2f} |")


if __name__ == "__main__":
    raise SystemExit(main())
