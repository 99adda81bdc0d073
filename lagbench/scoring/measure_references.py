"""Measure the reference predictors of data sets and write the scores that are shipped.

usage: python -m lagbench.scoring.measure_references [--split cavity] [--size mini]
           [--subset shift] [--root FOLDER] [--workers 2] [--predictor analog ...]
           [--costs]

All splits and sizes whose data are there are measured on test, or those named, or on
another subset, which then must be there. With --predictor only these references are
measured anew; the others, and all costs, stay as they are. Last a frame of each
reference and of the solver itself (``lagbench bench``) is timed on one core; with
--costs nothing else is done. ``git diff`` then shows which shipped scores have changed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Collection, Sequence
from pathlib import Path

from lagbench.data.limits import SCORED_SUBSETS
from lagbench.data.local import resolve_root
from lagbench.data.registry import Size
from lagbench.errors import DataError, LagbenchError, UsageError, WorkFailedError
from lagbench.references.shipped import (
    FOLDER,
    shipped_path,
    write_costs,
    write_shipped,
)
from lagbench.references.table import REFERENCES, references_of

from .references import measure, sizes_with_test_files, time_references
from .task import load_scored_task


def measure_and_ship(
    size: Size,
    root: Path,
    *,
    workers: int = 1,
    folder: Path = FOLDER,
    names: Collection[str] | None = None,
) -> Path:
    """Measure references of a data set and write them to the folder of shipped scores.

    Args:
        size: the split and size.
        root: folder of all data sets.
        workers: worker processes.
        folder: folder of shipped scores.
        names: names of the references; by default all.

    Raises:
        DataError: the data set is not recorded in datasets.yaml, or its files are
            missing.
        UsageError: the data set has none of these references.
    """
    where = f"{size.split} {size.name}"
    if names is not None:
        names_here = {reference.name for reference in references_of(size)}
        if names_here.isdisjoint(names):
            raise UsageError(f"none of its references: {', '.join(names)}", where=where)
    if size.measured is None:
        raise DataError("the data set has no recorded hash", where=where)

    config = load_scored_task(size, root).config
    reported = config.slow_frames.intersection(config.predicted_frames)
    scores = measure(size, root, names=names, workers=workers)
    return write_shipped(
        size,
        scores,
        dataset_sha256=size.measured.dataset_sha256,
        reported=sorted(reported),
        folder=folder,
        partial=names is not None,
    )


def time_all(size: Size, root: Path, *, folder: Path = FOLDER) -> Path:
    """Time a frame of each reference and of the solver; write what they cost.

    Raises:
        WorkFailedError: the solver fails.
    """
    options = ["--split", size.split, "--size", size.name, "--json"]
    command = [sys.executable, "-m", "lagbench", "bench", *options]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    if process.returncode != 0:
        raise WorkFailedError(
            f"the solver could not be timed: {process.stderr.strip()[-300:]}"
        )
    solver = json.loads(process.stdout)["seconds_per_frame"]
    seconds = time_references(size, root)
    return write_costs(size, seconds, solver=solver, folder=folder)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this module; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--split")
    parser.add_argument("--size")
    parser.add_argument("--subset", default="test", choices=SCORED_SUBSETS)
    parser.add_argument("--root", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--predictor", nargs="+", choices=sorted(REFERENCES))
    part.add_argument("--costs", action="store_true")
    options = parser.parse_args(arguments)

    root = resolve_root(options.root)
    try:
        for any_size in sizes_with_test_files(
            root, split=options.split, name=options.size
        ):
            size = any_size.scored_on(options.subset)
            if not options.costs:
                measure_and_ship(
                    size, root, workers=options.workers, names=options.predictor
                )
            if not options.predictor:
                time_all(size, root)
            path = shipped_path(size)
            length = path.stat().st_size
            sys.stdout.write(f"{size.split} {size.name}: {path.name}, {length} bytes\n")
            sys.stdout.flush()
    except LagbenchError as error:
        sys.stderr.write(f"measure_references: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
