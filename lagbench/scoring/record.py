"""Measure the floors of data sets and write what the package ships of them.

usage: python -m lagbench.scoring.record [--split cavity] [--size mini] [--root FOLDER]
           [--workers 2] [--check]

All splits and sizes whose data are there, or those named. What is measured is kept under the
root folder scenario by scenario: an interrupted run goes on where it stopped. With --check
nothing is written; exit code 4 says that what is shipped is not what was measured.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from lagbench.data.layout import resolve_root
from lagbench.data.registry import Size, load
from lagbench.errors import DataError, LagbenchError
from lagbench.floors import shipped
from lagbench.floors.shipped import FOLDER, shipped_path, write_shipped
from lagbench.submission.truth import Truth

from .floors import differences, kept_in, measure
from .task import load_scored_task

__all__ = ["main", "record"]


def record(size: Size, root: Path, *, workers: int = 1, folder: Path = FOLDER) -> Path:
    """Measure the floors of a data set and write them to the folder of shipped scores.

    Raises:
        DataError: the data set is not recorded in datasets.yaml, or its files are missing.
    """
    if size.measured is None:
        raise DataError("the data set has no recorded hash", where=f"{size.split} {size.name}")
    setting = load_scored_task(size, root).setting
    reported = sorted(setting.slow_frames.intersection(setting.predicted_frames))
    path = write_shipped(
        size,
        measure(size, root, workers=workers, resume=True),
        dataset_sha256=size.measured.dataset_sha256,
        reported=reported,
        folder=folder,
    )
    shutil.rmtree(kept_in(size, root))
    return path


def _check(size: Size, root: Path, workers: int) -> None:
    """Measure again, from the data and not from what was kept, and compare."""
    unlike = differences(shipped(size) or {}, measure(size, root, workers=workers))
    if unlike:
        listing = "; ".join(f"{name}: {', '.join(metrics)}" for name, metrics in unlike.items())
        raise DataError(
            "the shipped scores of floors are not those of the data",
            where=str(shipped_path(size)),
            got=listing,
            fix=f"python -m lagbench.scoring.record --split {size.split} --size {size.name}",
        )


def _sizes(split: str | None, name: str | None, root: Path) -> Iterator[Size]:
    """Yield what was named; else every size of ours whose test subset is there."""
    registry = load()
    for held in (split,) if split else registry.splits:
        for tier in (name,) if name else registry.split(held).sizes:
            size = registry.size(held, tier)
            truth = Truth(size, root)
            if (split and name) or all(truth.path(i).is_file() for i in size.subsets["test"]):
                yield size


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this module; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--split")
    parser.add_argument("--size")
    parser.add_argument("--root", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args(arguments)
    root = resolve_root(options.root)
    try:
        for size in _sizes(options.split, options.size, root):
            if options.check:
                _check(size, root, options.workers)
                sys.stdout.write(f"{size.split} {size.name}: as shipped\n")
            else:
                path = record(size, root, workers=options.workers)
                sys.stdout.write(f"{size.split} {size.name}: {path.name}, {path.stat().st_size} bytes\n")
            sys.stdout.flush()
    except LagbenchError as error:
        sys.stderr.write(f"record: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
