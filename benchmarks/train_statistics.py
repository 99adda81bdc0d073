"""Print the statistics of train of every split beside those of the thesis.

    python benchmarks/train_statistics.py [--size full]

Per-frame velocity x(f) - x(f-1) and acceleration (second difference), mean and standard
deviation over all train scenarios, from datasets.yaml. Table 5.3 is read as the cavity, Table
5.1 as curl noise (design section 12); the thesis gives none for the free-surface splits.
"""

from __future__ import annotations

import argparse

from lagbench.data.registry import load

THESIS = {
    "cavity": {
        "velocity_mean": (-3.5108e-05, -2.6359e-06),
        "velocity_std": (0.002191, 0.002195),
        "acceleration_mean": (8.5449e-10, 1.3844e-07),
        "acceleration_std": (9.9393e-05, 9.9605e-05),
    },
    "curl-noise": {
        "position_mean": (0.499, 0.4999),
        "position_std": (0.272, 0.272),
        "velocity_mean": (-1.8180e-05, 4.789e-07),
        "velocity_std": (1.600e-03, 1.600e-03),
        "acceleration_mean": (-3.116e-09, 7.532e-08),
        "acceleration_std": (7.334e-05, 7.315e-05),
    },
}


def main() -> int:
    """Print one Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", default="full")
    name = parser.parse_args().size
    registry = load()
    print(f"| split, `{name}` | statistic of `train` | x | y | thesis x | thesis y |")
    print("|---|---|---:|---:|---:|---:|")
    for split in registry.splits:
        measured = registry.size(split, name).measured
        for statistic, values in measured.statistics.items() if measured else ():
            thesis = THESIS.get(split, {}).get(statistic) if name == "full" else None
            cells = [*values, *(thesis or ("", ""))]
            words = (f"{cell:.4g}" if isinstance(cell, float) else cell for cell in cells)
            print(f"| {split} | {statistic.replace('_', ' ')} | {' | '.join(words)} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
