"""Print the statistics of train of every split beside those of the thesis.

    python benchmarks/train_statistics.py [--size full]

Per-frame velocity x(f) - x(f-1) and acceleration (second difference), mean and standard
deviation over all train scenarios, from datasets.yaml. Table 5.3 is read as the cavity,
Table 5.1 as curl noise (design section 12); the thesis gives none for the free-surface
splits.
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
    name = parser.parse_args().size
    registry = load()
    print(f"| split, `{name}` | statistic of `train` | x | y | thesis x | thesis y |")
    print("|---|---|---:|---:|---:|---:|")
    for split in registry.splits:
        measured = registry.size(split, name).measured
        for statistic, values in measured.statistics.items() if measured else ():
            if name == "full":
                thesis = STATISTICS.get(split, {}).get(statistic)
            else:
                thesis = None
            cells = [*values, *(thesis or ("", ""))]
            words = (
                f"{cell:.4g}" if isinstance(cell, float) else cell for cell in cells
            )
            print(f"| {split} | {statistic.replace('_', ' ')} | {' | '.join(words)} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
