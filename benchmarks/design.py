"""Searches of the design track: what is known of each task, and the rows of the board.

    python -m benchmarks.design known [--runs 300]      lagbench/design/known.json
    python -m benchmarks.design row METHOD --budget 10 [--seed 0] -o ENTRY.json

``known`` finds the best of 64 random draws and the best that CMA-ES finds. A budget is
so many runs of the judge's simulator in processor time. METHOD: random, cma, cma-coarse
(CMA-ES on the simulator with half as many cells along each axis). Both can be
interrupted and go on.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lagbench.atomic import write_atomically
from lagbench.data.registry import Size
from lagbench.design.search import cma_search, random_search
from lagbench.design.tasks import VERSION, Task, load_task, task_names

KNOWN = Path(__file__).parents[1] / "lagbench" / "design" / "known.json"
RANDOM_DRAWS = 64


def halved(task: Task) -> Size:
    """Return the size with half as many cells along each axis."""
    size = task.size
    parameters = dict(size.parameters)
    for name, divisor in (
        ("grid", 2),
        ("wall", 2),
        ("substeps_per_frame", 2),
        ("particles", 4),
    ):
        value = int(size.value(name)) // divisor
        parameters[name] = parameters[name].model_copy(update={"value": value})
    return size.model_copy(update={"parameters": parameters})


def find_known(runs: int) -> None:
    """Add what is known of each task to the file, task by task."""
    known: dict[str, Any] = {}
    if KNOWN.is_file():
        known = json.loads(KNOWN.read_text())
    for name in task_names():
        if name in known:
            continue
        task = load_task(name)
        draws = random_search(task, task.objective, runs=RANDOM_DRAWS, seed=64)
        best = cma_search(task, task.objective, runs=runs, seed=0)
        known[name] = {
            "random": task.error(draws),
            "best": task.error(best),
            "parameters": best,
        }
        write_atomically(KNOWN, (json.dumps(known, indent=1) + "\n").encode())
        print(name, known[name]["random"], known[name]["best"], flush=True)


def search_all(method: str, *, budget: int, seed: int, output: Path) -> None:
    """Search every task with a budget; the entry grows task by task."""
    entry: dict[str, Any] = {
        "method": f"{method}, {budget} runs, seed {seed}",
        "version": VERSION,
        "parameters": {},
        "seconds": {},
        "runs": {},
    }
    if output.is_file():
        entry = json.loads(output.read_text())
    for name in task_names():
        if name in entry["parameters"]:
            continue
        task = load_task(name)
        size = halved(task) if method == "cma-coarse" else None
        runs = budget
        if size is not None:
            runs = round(budget * time_of(task, None) / time_of(task, size))

        def objective(
            values: Sequence[float], task: Task = task, size: Size | None = size
        ) -> float:
            return task.objective(values, size=size)

        search = random_search if method == "random" else cma_search
        started = time.process_time()
        values = search(task, objective, runs=runs, seed=seed)
        entry["parameters"][name] = values
        entry["seconds"][name] = round(time.process_time() - started, 3)
        entry["runs"][name] = runs
        write_atomically(output, (json.dumps(entry, indent=1) + "\n").encode())
        print(name, task.error(values), flush=True)


def time_of(task: Task, size: Size | None) -> float:
    """Return the processor time of a run [s], kernels compiled: the least of three."""
    values = task.at(np.full(len(task.parameters), 0.5))
    task.objective(values, size=size)
    times = []
    for _ in range(3):
        started = time.process_time()
        task.objective(values, size=size)
        times.append(time.process_time() - started)
    return min(times)


def main() -> int:
    """Run one of the two commands."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    known = commands.add_parser("known")
    known.add_argument("--runs", type=int, default=300)
    row = commands.add_parser("row")
    row.add_argument("method", choices=("random", "cma", "cma-coarse"))
    row.add_argument("--budget", type=int, required=True)
    row.add_argument("--seed", type=int, default=0)
    row.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    if arguments.command == "known":
        find_known(arguments.runs)
    else:
        search_all(
            arguments.method,
            budget=arguments.budget,
            seed=arguments.seed,
            output=arguments.output,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
