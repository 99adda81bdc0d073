"""Measure the floors of data sets and write what the package ships of them.

usage: python -m lagbench.scoring.record [--split cavity] [--size mini] [--root FOLDER]
           [--workers 2] [--floor analog ...] [--solver]

All splits and sizes whose data are there, or those named. With --floor only these are
measured anew, from the start; the others, and all costs, stay as they are. Without it
what is measured is kept under the root folder scenario by scenario: an interrupted run
goes on where it stopped. Last the solver itself is timed (``lagbench bench solver``);
with --solver nothing else is done. What is shipped is checked by
``lagbench leaderboard check --root FOLDER``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
from collections.abc import Collection, Sequence
from pathlib import Path

from lagbench.data.local import resolve_root
from lagbench.data.registry import Size
from lagbench.errors import DataError, LagbenchError, UsageError, WorkFailedError
from lagbench.references.shipped import (
    FOLDER,
    shipped_path,
    write_shipped,
    write_solver_seconds,
)
from lagbench.references.table import REFERENCES, references_of

from .references import kept_in, measure, measured_sizes
from .task import load_scored_task


def record(
    size: Size,
    root: Path,
    *,
    workers: int = 1,
    folder: Path = FOLDER,
    floors: Collection[str] | None = None,
) -> Path:
    """Measure the floors of a data set, or some of them, and write them to the folder
    of shipped scores.

    Raises:
        DataError: the data set is not recorded in datasets.yaml, or its files are
            missing.
        UsageError: the data set has none of these floors.
    """
    whole = floors is None
    if not whole and not {floor.name for floor in references_of(size)}.intersection(
        floors or ()
    ):
        raise UsageError(
            "the data set has no such floor",
            where=f"{size.split} {size.name}",
            got=floors,
        )
    if size.measured is None:
        raise DataError(
            "the data set has no recorded hash", where=f"{size.split} {size.name}"
        )
    setting = load_scored_task(size, root).setting
    path = write_shipped(
        size,
        measure(size, root, floors=floors, workers=workers, resume=whole),
        dataset_sha256=size.measured.dataset_sha256,
        reported=sorted(setting.slow_frames.intersection(setting.predicted_frames)),
        folder=folder,
        partial=not whole,
    )
    if whole:
        shutil.rmtree(kept_in(size, root))
    return path


def time_solver(size: Size, *, folder: Path = FOLDER) -> Path:
    """Time the solver in a process of its own and write what a frame costs."""
    options = ["--split", size.split, "--size", size.name, "--json"]
    command = [sys.executable, "-m", "lagbench", "bench", "solver", *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise WorkFailedError(
            "the solver could not be timed", got=done.stderr.strip()[-300:]
        )
    return write_solver_seconds(
        size, json.loads(done.stdout)["seconds_per_frame"], folder
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this module; return its exit code."""
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=layout)
    parser.add_argument("--split")
    parser.add_argument("--size")
    parser.add_argument("--root", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--floor", nargs="+", choices=sorted(REFERENCES))
    what.add_argument("--solver", action="store_true")
    options = parser.parse_args(arguments)
    root = resolve_root(options.root)
    try:
        for size in measured_sizes(root, split=options.split, name=options.size):
            if not options.solver:
                record(size, root, workers=options.workers, floors=options.floor)
            if not options.floor:
                time_solver(size)
            path = shipped_path(size)
            sys.stdout.write(
                f"{size.split} {size.name}: {path.name}, {path.stat().st_size} bytes\n"
            )
            sys.stdout.flush()
    except LagbenchError as error:
        sys.stderr.write(f"record: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
