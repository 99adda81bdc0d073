"""What it costs to keep fewer scenario files open than a split trains on.

    python benchmarks/open_files.py --root DATA --split multimaterial --size full

Prints processor time of the first windows of an epoch with 32 files kept open and with
as many as lagbench keeps, in turns in one process, and their ratio.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

from lagbench.data.registry import load
from lagbench.store import windows
from lagbench.torch import WindowDataset, WindowSampler

FEW = 32
MANY = windows.OPEN_FILES


def spent(root: Path | None, split: str, size: str, *, files: int, count: int) -> float:
    """Return the processor time of so many windows with so many files kept open [s]."""
    windows.OPEN_FILES = files
    data = WindowDataset(split, size=size, root=root, history=1, future=1)
    sampler = WindowSampler(data, seed=0)
    start = time.process_time()
    for drawn, index in enumerate(sampler, 1):
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
    options = parser.parse_args()
    size = load().size(options.split, options.size)
    scenarios = len(size.subsets["train"])
    if scenarios <= FEW:
        parser.error(
            f"{options.split} {options.size} trains on {scenarios} scenarios: name a "
            f"split with more"
        )
    seconds = {FEW: math.inf, MANY: math.inf}  # least of the rounds, by open files
    for _ in range(options.rounds):
        for files, least in seconds.items():
            spent_seconds = spent(
                options.root,
                options.split,
                options.size,
                files=files,
                count=options.windows,
            )
            seconds[files] = min(least, spent_seconds)

    data_set = f"{options.split} {options.size}"
    print(f"{options.windows} windows of {data_set}, the first of an epoch")
    for files, least in seconds.items():
        print(f"{files:4d} files open  {least:6.2f} s")
    print(f"ratio {seconds[FEW] / seconds[MANY]:.2f}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
