"""Generate data sets and print what each took: wall time, CPU time, memory, bytes.

    python benchmarks/data_sets.py --root FOLDER [--split NAME ...]
        [--size NAME ...] [--workers N]

Prints one Markdown row per data set; what is there already is generated again, so the
figures are those of a whole generation, cards and hash checks included.
"""

from __future__ import annotations

import argparse
import resource
from pathlib import Path

from lagbench.data.registry import load
from lagbench.make.generate import GenerationResult, generate

HEADER = (
    "| split | size | scenarios | frames | wall [s] | CPU [s] | largest worker [MB] | "
    "on disk [MB] |\n"
    "|---|---|---:|---:|---:|---:|---:|---:|"
)


def main() -> int:
    """Generate what the arguments name and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--root", type=Path, required=True)
    parser.add_argument("--split", nargs="+", default=list(load().splits))
    parser.add_argument("--size", nargs="+", default=["tiny", "mini", "full"])
    parser.add_argument("--workers", type=int)
    options = parser.parse_args()
    print(HEADER)
    for size in options.size:
        for split in options.split:
            cpu_start = _cpu_seconds()
            result = generate(
                split,
                size,
                root=options.root,
                workers=options.workers,
                force=True,
            )
            cpu = _cpu_seconds() - cpu_start
            print(_row(result, cpu), flush=True)
    return 0


def _row(result: GenerationResult, cpu: float) -> str:
    size = load().size(result.split, result.size)
    frame_count = 0
    for scenario in size.scenarios:
        frame_count += size.frame_count(scenario)
    disk_bytes = 0
    for path in result.folder.rglob("*.nc"):
        disk_bytes += path.stat().st_size
    workers = resource.getrusage(resource.RUSAGE_CHILDREN)
    largest = workers.ru_maxrss / 1000  # [MB]
    return (
        f"| {result.split} | {result.size} | {len(size.scenarios)} | {frame_count} | "
        f"{result.seconds:.0f} "
        f"| {cpu:.0f} | {largest:.0f} | {disk_bytes / 1e6:.1f} |"
    )


def _cpu_seconds() -> float:
    """Return the CPU time of this process and of its children that have ended."""
    seconds = 0.0
    for processes in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN):
        usage = resource.getrusage(processes)
        seconds += usage.ru_utime + usage.ru_stime
    return seconds


if __name__ == "__main__":
    raise SystemExit(main())
