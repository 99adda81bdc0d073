"""Searches for the parameters of a task: random draws, and CMA-ES."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from lagbench.errors import require

from .tasks import Task

Objective = Callable[[Sequence[float]], float]
"""From parameters to what is minimised; infinite where a run fails."""

FAILED = 1e6
"""Objective of a run that fails, for searches that need a number."""


def random_search(
    task: Task, objective: Objective, *, runs: int, seed: int
) -> list[float]:
    """Return the best of so many random draws."""
    rng = np.random.default_rng(seed)
    best = task.at(rng.random(len(task.parameters)))
    least = objective(best)
    for _ in range(runs - 1):
        values = task.at(rng.random(len(task.parameters)))
        value = objective(values)
        if value < least:
            least = value
            best = values
    return best


def cma_search(
    task: Task, objective: Objective, *, runs: int, seed: int
) -> list[float]:
    """Return the best that CMA-ES finds in so many runs (Hansen 2016, library ``cma``).

    Raises:
        UsageError: the library is missing.
    """
    cma = require("cma", extra="design")
    options = {
        "bounds": [0.0, 1.0],
        "seed": seed + 1,  # 0 would take the time as the seed
        "maxfevals": runs,
        "verbose": -9,
    }
    strategy = cma.CMAEvolutionStrategy(len(task.parameters) * [0.5], 0.3, options)
    best = task.at(np.full(len(task.parameters), 0.5))
    least = math.inf
    spent = 0
    while spent < runs:
        shares = strategy.ask()[: runs - spent]
        values = [task.at(np.asarray(share)) for share in shares]
        results = [objective(each) for each in values]
        spent += len(results)
        for each, result in zip(values, results, strict=True):
            if result < least:
                least = result
                best = each
        if len(results) < strategy.popsize:
            break
        strategy.tell(shares, [min(result, FAILED) for result in results])
    return best
