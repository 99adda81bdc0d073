"""Print the statistics of train of every split beside those of the thesis.

    PYTHONPATH=. python benchmarks/train_statistics.py [--size full]

Per-frame velocity x(f) - x(f-1) and acceleration (second difference), mean and standard
deviation over all train scenarios, from datasets.yaml. Table 5.3 of the thesis is
its cavity. We read Table 5.1, of the "vorticity conservation model", as curl noise. The
thesis has no such table for the free-surface splits.
"""

from __future__ import annotations

import argparse

from lagbench.data.registry import load
from studies.thesis.published import STATISTICS


def main() -> int:
    """Print one Markdown table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--size", default="full")
    size_name = parser.parse_args().size
    registry = load()
    print(
        f"| split, `{size_name}` | statistic of `train` | x | y | thesis x | thesis y |"
    )
    print("|---|---|---:|---:|---:|---:|")
    for split in registry.splits:
        measured = registry.size(split, size_name).measured
        if measured is None:
            continue
        for statistic, values in measured.statistics.items():
            thesis = None
            if size_name == "full":
                thesis = STATISTICS.get(split, {}).get(statistic)
            cells = [f"{value:.4g}" for value in values]
            if thesis is None:
                cells += ["", ""]
            else:
                cells += [f"{value:.4g}" for value in thesis]
            name = statistic.replace("_", " ")
            print(f"| {split} | {name} | {' | '.join(cells)} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
