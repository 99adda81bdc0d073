"""Which package compiles the solver's kernels: Taichi, or Quadrants, its living fork.

Both make the same bits. Taichi is faster, and has no wheel for Python 3.14.
"""

from __future__ import annotations

import importlib.util
import os

from lagbench.errors import NotInstalledError, UsageError, suggest_name

ENGINES = ("taichi", "quadrants")
"""Packages that compile the kernels, the faster first."""

ENGINE_VARIABLE = "LAGBENCH_ENGINE"
"""Environment variable that chooses one of them where both are installed."""


def find_engine() -> str:
    """Return the engine: the one of ``LAGBENCH_ENGINE``, else the first installed one.

    Nothing is imported: workers will import the engine.

    Raises:
        UsageError: the variable names no engine.
        NotInstalledError: none is installed, or not that of the variable.
    """
    candidates: tuple[str, ...] = ENGINES
    chosen = os.environ.get(ENGINE_VARIABLE)
    if chosen:
        if chosen not in ENGINES:
            hint = suggest_name(chosen, ENGINES)
            raise UsageError(
                f"no such engine: {chosen!a}; {hint}", where=ENGINE_VARIABLE
            )
        candidates = (chosen,)
    for name in candidates:
        if importlib.util.find_spec(name) is not None:
            return name
    raise NotInstalledError(
        f"{' and '.join(candidates)} not installed; pip install 'lagbench[generate]'"
    )
