"""What it costs to keep fewer scenario files open than a split trains on.

    python benchmarks/open_files.py --root DATA --split multimaterial --size full

Prints processor time of the first windows of an epoch with 32 files kept open and with
as many as lagbench keeps, in turns in one process, and their ratio.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from lagbench.data.registry import load
from lagbench.store import windows
from lagbench.torch import WindowDataset, WindowSampler

FEW = 32
KEPT = windows.OPEN_FILES


def spent(root: Path | None, split: str, size: str, *, files: int, count: int) -> float:
    """Return the processor time of so many windows with so many files kept open [s]."""
    windows.OPEN_FILES = files
    data = WindowDataset(split, size=size, root=root, history=1, future=1)
    start = time.process_time()
    for drawn, index in enumerate(WindowSampler(data, seed=0), 1):
        data[index]
        if drawn == count:
            break
    return time.process_time() - start


def main() -> int:
    """Measure what the arguments name and print it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--root", type=Path)
    parser.add_argument("--split", default="multimaterial")
    parser.add_argument("--size", default="full")
    parser.add_argument("--windows", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    took: dict[int, list[float]] = {FEW: [], KEPT: []}
    scenarios = len(load().size(given.split, given.size).subsets["train"])
    if scenarios <= FEW:
        parser.error(
            f"{given.split} {given.size} trains on {scenarios} scenarios: name a "
            f"split with more"
        )
    for _ in range(given.rounds):
        for files, times in took.items():
            times.append(
                spent(
                    given.root,
                    given.split,
                    given.size,
                    files=files,
                    count=given.windows,
                )
            )
    few, kept = (min(took[files]) for files in (FEW, KEPT))
    print(
        f"{given.windows} windows of {given.split} {given.size}, the first of an epoch"
    )
    print(f"{FEW:4d} files open  {few:6.2f} s")
    print(f"{KEPT:4d} files open  {kept:6.2f} s")
    print(f"ratio {few / kept:.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
