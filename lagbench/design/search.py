"""Searches for the parameters of a task: random draws, and CMA-ES."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lagbench.errors import require

from .tasks import DesignTask

Objective = Callable[[Sequence[float]], float]
"""From parameters to what is minimised; infinite where a run fails."""

FAILED = 1e6
"""Objective of a run that fails, for searches that need a number."""


def random_search(
    task: DesignTask, objective: Objective, *, runs: int, seed: int
) -> list[float]:
    """Return the best of so many random draws."""
    rng = np.random.default_rng(seed)
    draws = [task.at(rng.random(len(task.parameters))) for _ in range(runs)]
    return min(draws, key=objective)


def cma_search(
    task: DesignTask, objective: Objective, *, runs: int, seed: int
) -> list[float]:
    """Return the best that CMA-ES finds in so many runs (Hansen 2016, library ``cma``).

    A search with fewer runs is the beginning of one with more.

    Raises:
        UsageError: the library is missing.
    """
    cma = require("cma", extra="design")
    options = {
        "bounds": [0.0, 1.0],
        "seed": seed + 1,  # 0 would take the time as the seed
        "verbose": -9,
    }
    strategy = cma.CMAEvolutionStrategy(len(task.parameters) * [0.5], 0.3, options)
    results: list[tuple[float, list[float]]] = []
    while True:
        shares = strategy.ask()[: runs - len(results)]
        generation = []
        for share in shares:
            values = task.at(np.asarray(share))
            generation.append((objective(values), values))
        results += generation
        if len(results) == runs:
            return min(results)[1]
        strategy.tell(shares, [min(result, FAILED) for result, _ in generation])
