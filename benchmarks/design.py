"""Searches of the design track: what is known of each task, and the rows of the board.

    python -m benchmarks.design known [--runs 300]
    python -m benchmarks.design search METHOD [--seed 0] [--budget 10]

Both take ``--families pour,stir``, ``--instances 4`` (the first of each family) and
``--rows`` (another folder than leaderboard/design).

``known`` writes the best of 64 random draws and the best of a CMA-ES search (of
``stir`` the best of four constant programs) to lagbench/design/known.json; better
parameters in leaderboard/design take their place. ``search`` searches once with a
budget of 100 simulator runs' worth of processor time, and writes what it had found
after 1, 10 and 100 of them, judged, to leaderboard/design/METHOD-BUDGET-SEED.json. Both
can be interrupted and go on.

METHOD is random, cma (CMA-ES on the simulator), cma-coarse (CMA-ES on the restarted
simulator with half as many cells along each axis), cma-neuralmpm (CMA-ES on a trained
NeuralMPM) or gradient-neuralmpm (Adam through it); the last two for one family.
"""

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from lagbench.atomic import write_atomically
from lagbench.design.judge import (
    DesignEntry,
    Known,
    Verdict,
    judge_task,
    read_entry,
    write_entry,
)
from lagbench.design.search import Objective, cma_search, random_search
from lagbench.design.tasks import FAMILIES, INSTANCES, DesignTask, load_task, task_names

ROOT = Path(__file__).parents[1]
KNOWN = ROOT / "lagbench" / "design" / "known.json"
ROWS = ROOT / "leaderboard" / "design"
RANDOM_DRAWS = 64
RANDOM_SEED = 64
BUDGETS = (1, 10, 100)

Search = Callable[..., list[float]]

SIMULATED: dict[str, tuple[Search, float]] = {
    "random": (random_search, 1.0),
    "cma": (cma_search, 1.0),
    "cma-coarse": (cma_search, 0.5),
}
"""Search of each method, and the refinement of the simulator that it runs."""

COARSE_RUNS = {"pour": 2.9, "stir": 2.6, "identify": 2.7}
"""Runs with half as many cells in the time of one run of the judge's simulator, from
the least times of nine runs of each.
"""

THROUGH_MODEL = ("cma-neuralmpm", "gradient-neuralmpm")
"""Searches that run a trained NeuralMPM, whose file ``--weights`` names."""


def find_known(runs: int, names: Sequence[str], rows: Path) -> None:
    """Add what is known of each task to the file, task by task."""
    known: dict[str, Known] = {}
    if KNOWN.is_file():
        for name, values in json.loads(KNOWN.read_text()).items():
            known[name] = Known(**values)
    for name in names:
        task = load_task(name)
        if name not in known:
            drawn = random_search(
                task, task.objective, runs=RANDOM_DRAWS, seed=RANDOM_SEED
            )
            best = drawn
            if task.truth is not None:
                best = list(task.truth)
            elif task.marked_axis is not None:
                best = min(constant_programs(task), key=task.objective)
            elif runs:
                best = cma_search(task, task.objective, runs=runs, seed=RANDOM_SEED)
            known[name] = Known(
                random=task.error(drawn), best=task.error(best), parameters=best
            )
        for path in sorted(rows.glob("*.json")):
            entry = read_entry(path)
            verdict = entry.verdicts.get(name)
            if verdict is None or verdict.error is None:
                continue
            if verdict.error < known[name].best:
                known[name] = known[name].model_copy(
                    update={
                        "best": verdict.error,
                        "parameters": entry.parameters[name],
                    }
                )
        write_known(known)
        print(name, known[name].random, known[name].best, flush=True)


def constant_programs(task: DesignTask) -> list[list[float]]:
    """Return programs of both walls of ``stir`` at full speed, either way."""
    knots = len(task.parameters) // 2
    programs = []
    for first in (0.0, 1.0):
        for second in (0.0, 1.0):
            programs.append(task.at(knots * [first] + knots * [second]))
    return programs


def write_known(known: dict[str, Known]) -> None:
    """Write what is known of the tasks to the file."""
    content = {name: known[name].model_dump() for name in task_names() if name in known}
    write_atomically(KNOWN, (json.dumps(content, indent=1) + "\n").encode())


class Recorder:
    """An objective that remembers what it was asked, and when."""

    def __init__(self, objective: Objective) -> None:
        self.objective = objective
        self.history: list[tuple[float, list[float]]] = []
        self.seconds: list[float] = []  # processor time after each run [s]
        self.started = time.process_time()

    def __call__(self, values: Sequence[float]) -> float:
        """Return the objective of parameters."""
        value = self.objective(values)
        self.history.append((value, list(values)))
        self.seconds.append(time.process_time() - self.started)
        return value


def search_all(
    method: str,
    *,
    seed: int,
    names: Sequence[str],
    budget: int,
    rows: Path,
    weights: Path | None,
) -> None:
    """Search every task; the entries of all budgets grow task by task."""
    entries = {}
    for each in BUDGETS:
        path = rows / f"{method}-{each}-{seed}.json"
        if path.is_file():
            entries[path] = read_entry(path)
        elif each <= budget:
            entries[path] = DesignEntry(
                method=method, budget=each, seed=seed, parameters={}
            )
    speeds: dict[str, float] = {}
    for name in names:
        task = load_task(name)
        family = name.partition("-")[0]
        if all(name in entry.parameters for entry in entries.values()):
            continue
        search, objective = method_of(method, task, weights)
        # runs in the time of one run of the judge's simulator
        if method == "cma-coarse":
            speeds[family] = COARSE_RUNS[family]
        elif method in SIMULATED:
            speeds[family] = 1.0
        elif family not in speeds:
            speeds[family] = time_of(task, task.objective) / time_of(task, objective)
        recorder = Recorder(objective)
        search(task, recorder, runs=max(1, round(budget * speeds[family])), seed=seed)
        judged: dict[tuple[float, ...], Verdict] = {}
        for path, entry in entries.items():
            runs = round((entry.budget or 0) * speeds[family])
            if not 0 < runs <= len(recorder.history) or name in entry.parameters:
                continue
            _, values = min(recorder.history[:runs])
            key = tuple(values)
            if key not in judged:
                judged[key] = judge_task(name, values)
            entry.parameters[name] = values
            entry.seconds[name] = round(recorder.seconds[runs - 1], 3)
            entry.runs[name] = runs
            entry.verdicts[name] = judged[key]
            write_entry(entry, path)
            print(path.stem, name, judged[key].error, flush=True)


def method_of(
    method: str, task: DesignTask, weights: Path | None
) -> tuple[Search, Objective]:
    """Return the search and the objective of a method."""
    if method in SIMULATED:
        search, refinement = SIMULATED[method]
        return search, partial(task.objective, refinement=refinement)
    if weights is None:
        message = f"{method} needs --weights"
        raise SystemExit(message)
    # without torch for the others
    neuralmpm = importlib.import_module("benchmarks.design_neuralmpm")
    surrogate = neuralmpm.Surrogate(weights, task)
    if method == "cma-neuralmpm":
        return cma_search, surrogate.objective
    return partial(
        neuralmpm.descend, surrogate=surrogate
    ), surrogate.objective_and_gradient


def time_of(task: DesignTask, objective: Objective) -> float:
    """Return the processor time of a run [s], kernels compiled: the least of five."""
    values = task.at(np.full(len(task.parameters), 0.5))
    objective(values)
    times = []
    for _ in range(5):
        started = time.process_time()
        objective(values)
        times.append(time.process_time() - started)
    return min(times)


def choose_tasks(families: str, instances: int) -> list[str]:
    """Return the first instances of some families, one of each family in turn."""
    names = []
    for number in range(instances):
        names += [f"{family}-{number:02d}" for family in families.split(",")]
    return names


def main() -> int:
    """Run one of the two commands."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    known = commands.add_parser("known")
    known.add_argument("--runs", type=int, default=300)
    search = commands.add_parser("search")
    search.add_argument("method", choices=(*SIMULATED, *THROUGH_MODEL))
    search.add_argument("--weights", type=Path)
    search.add_argument("--seed", type=int, default=0)
    search.add_argument("--budget", type=int, choices=BUDGETS, default=BUDGETS[-1])
    for command in (known, search):
        command.add_argument("--families", default=",".join(FAMILIES))
        command.add_argument("--instances", type=int, default=INSTANCES)
        command.add_argument("--rows", type=Path, default=ROWS)
    arguments = parser.parse_args()
    names = choose_tasks(arguments.families, arguments.instances)
    if arguments.command == "known":
        find_known(arguments.runs, names, arguments.rows)
    else:
        search_all(
            arguments.method,
            seed=arguments.seed,
            names=names,
            budget=arguments.budget,
            rows=arguments.rows,
            weights=arguments.weights,
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
