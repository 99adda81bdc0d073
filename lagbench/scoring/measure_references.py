"""Measure the reference predictors of a data set and write the scores that are shipped.

usage: python -m lagbench.scoring.measure_references --split cavity --size mini
           [--subset shift] [--root FOLDER] [--workers 2] [--predictor analog ...]
           [--costs]

With --predictor only these references are measured anew; the others, and all costs,
stay as they are. Last a frame of each reference and of the solver itself (``lagbench
bench``) is timed on one core; with --costs nothing else is done. ``git diff`` then
shows which shipped scores have changed.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np

from lagbench.data.limits import SCORED_SUBSETS
from lagbench.data.local import resolve_root
from lagbench.data.registry import Size, load
from lagbench.errors import DataError, LagbenchError, UsageError, WorkFailedError
from lagbench.metrics.aggregate import aggregate
from lagbench.metrics.table import METRICS, select
from lagbench.references.predictor import given_in
from lagbench.references.shipped import (
    ReferenceScores,
    correlation_of,
    write_costs,
    write_shipped,
)
from lagbench.references.table import REFERENCES, references_of
from lagbench.work.run import Meter, Progress

from .score import check_train, score_scenarios, time_frames
from .task import load_scored_task, predict_reference

TIMED_SCENARIOS = 2
"""Test scenarios on which the references are timed."""


def measure(
    size: Size,
    root: Path,
    *,
    names: Collection[str] | None = None,
    workers: int = 1,
    progress: Callable[[Progress], None] | None = None,
) -> dict[str, ReferenceScores]:
    """Return the scores of references of a data set by name.

    The scored subset must be there, and train for those that look things up there; the
    values of both are hashed and compared with the recorded hashes.

    Args:
        size: the split and size, and the subset that it scores.
        root: folder of all data sets.
        names: names of the references; by default all.
        workers: worker processes.
        progress: called with the state of the work.
    """
    task = load_scored_task(size, root)
    metrics = select(known=METRICS)
    references = tuple(
        one.name for one in references_of(size) if names is None or one.name in names
    )
    check_train(size, root, references)
    outcomes = score_scenarios(
        task,
        metrics=metrics,
        references=references,
        workers=workers,
        meter=Meter(progress),
    )

    measured = {}
    for name in references:
        tallies = {one.scenario: one.tallies[name] for one in outcomes}
        scores = aggregate(metrics, tallies)
        medians = [np.median(one.seconds[name]) for one in outcomes]
        measured[name] = ReferenceScores(
            name=name,
            scores=scores,
            seconds_per_frame=float(np.median(medians)),
            correlation=correlation_of(scores),
        )
    return measured


def time_references(size: Size, root: Path) -> dict[str, float]:
    """Return the processor time of a frame by name of the reference [s].

    The median over the frames of the first test scenarios, one core, no scoring.
    """
    task = load_scored_task(size, root)
    seconds: dict[str, list[float]] = {}
    for scenario in task.scenarios[:TIMED_SCENARIOS]:
        with task.opened(scenario) as truth:
            given = given_in(truth.file, size, root)
        for reference in references_of(size):
            times = seconds.setdefault(reference.name, [])
            for _ in time_frames(predict_reference(reference, given), times):
                pass
    return {name: float(np.median(times)) for name, times in seconds.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line of this module; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--split", required=True)
    parser.add_argument("--size", required=True)
    parser.add_argument("--subset", default="test", choices=SCORED_SUBSETS)
    parser.add_argument("--root", type=Path)
    parser.add_argument("--workers", type=int, default=1)
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--predictor", nargs="+", choices=sorted(REFERENCES))
    part.add_argument("--costs", action="store_true")
    options = parser.parse_args(arguments)

    root = resolve_root(options.root)
    names = options.predictor
    where = f"{options.split} {options.size}"
    try:
        size = load().size(options.split, options.size).scored_on(options.subset)
        names_here = {reference.name for reference in references_of(size)}
        if names and names_here.isdisjoint(names):
            raise UsageError(f"none of its references: {', '.join(names)}", where=where)
        if size.measured is None:
            raise DataError("the data set has no recorded hash", where=where)
        if not options.costs:
            config = load_scored_task(size, root).config
            reported = config.slow_frames.intersection(config.predicted_frames)
            path = write_shipped(
                size,
                measure(size, root, names=names, workers=options.workers),
                dataset_sha256=size.measured.dataset_sha256,
                reported=sorted(reported),
                partial=names is not None,
            )
        if not names:
            bench = ["bench", "--split", size.split, "--size", size.name, "--json"]
            process = subprocess.run(
                [sys.executable, "-m", "lagbench", *bench],
                capture_output=True,
                text=True,
                check=False,
            )
            if process.returncode != 0:
                raise WorkFailedError(
                    f"the solver could not be timed: {process.stderr.strip()[-300:]}"
                )
            solver = json.loads(process.stdout)["seconds_per_frame"]
            path = write_costs(size, time_references(size, root), solver=solver)
        sys.stdout.write(f"{where}: {path.name}, {path.stat().st_size} bytes\n")
    except LagbenchError as error:
        sys.stderr.write(f"measure_references: {error}\n")
        return error.exit_code
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
