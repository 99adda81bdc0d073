"""Rows of the design track: the goal that a search reached, and the time that it took.

An entry of the track is a judged file ``design/<name>.json``. The rows of a method are
the means over its seeds and the tasks of one family.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lagbench.design.judge import DesignEntry, read_entry, scale_error
from lagbench.design.tasks import FAMILIES
from lagbench.metrics.aggregate import bootstrap_interval

from .folder import Folder

COARSE = "cma-coarse"
"""The method on the cheapest useful simulator, with which surrogates are compared."""

SURROGATE = "neuralmpm"
"""Part of the names of methods that search with a trained network."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DesignRow:
    """A method with one budget on the tasks of one family."""

    family: str
    method: str
    budget: int  # of a search [simulator runs' worth of processor time]
    tasks: tuple[str, ...]  # names
    scores: NDArray[np.float64]  # NaN where not searched, shape [seed, task]
    seconds: float  # processor time of a search, mean over tasks and seeds [s]

    @property
    def score(self) -> float:
        """Mean score: 0 for the best of 64 random draws, 1 for the best known."""
        return float(np.nanmean(self.scores))

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the mean; NaN with fewer than four tasks."""
        return bootstrap_interval(self.scores)

    def difference(self, other: DesignRow) -> tuple[float, float, float, int]:
        """Return the mean difference of scores to another row, its 95 % interval, and
        the number of tasks that both have.
        """
        common = [name for name in self.tasks if name in other.tasks]
        own = self.scores[:, [self.tasks.index(name) for name in common]]
        others = other.scores[:, [other.tasks.index(name) for name in common]]
        mean = float(np.nanmean(own) - np.nanmean(others))
        return mean, *bootstrap_interval(own, others), len(common)


def read_design(folder: Folder) -> tuple[DesignRow, ...]:
    """Return the rows of a board, by family, budget and method.

    Raises:
        UnreadableFileError, UsageError: see :func:`lagbench.design.read_entry`.
    """
    entries: dict[tuple[str, int], list[DesignEntry]] = defaultdict(list)
    for path in folder.design_files():
        entry = read_entry(folder.path / path)
        if entry.budget is not None:
            entries[entry.method, entry.budget].append(entry)
    rows = []
    for family in FAMILIES:
        for (method, budget), seeds in sorted(entries.items()):
            tasks = set()
            for entry in seeds:
                for name, verdict in entry.verdicts.items():
                    is_scored = scale_error(name, verdict.error) is not None
                    if name.startswith(family) and is_scored:
                        tasks.add(name)
            if not tasks:
                continue
            names = sorted(tasks)
            scores = np.full((len(seeds), len(names)), np.nan)
            seconds = []
            for seed, entry in enumerate(seeds):
                for number, name in enumerate(names):
                    if name in entry.verdicts:
                        error = entry.verdicts[name].error
                        scores[seed, number] = scale_error(name, error)
                        seconds.append(entry.seconds[name])
            rows.append(
                DesignRow(
                    family=family,
                    method=method,
                    budget=budget,
                    tasks=tuple(names),
                    scores=scores,
                    seconds=float(np.mean(seconds)),
                )
            )
    return tuple(
        sorted(rows, key=lambda row: (list(FAMILIES).index(row.family), row.budget))
    )


def conclude_design(rows: Sequence[DesignRow]) -> list[str]:
    """Return sentences: where a surrogate finds better parameters in the same time.

    Networks are compared with CMA-ES on the coarse simulator, which is compared with
    CMA-ES on the judge's.
    """
    by_place = {(row.family, row.budget, row.method): row for row in rows}
    sentences = []
    better = 0
    compared = 0
    for row in rows:
        is_network = SURROGATE in row.method
        if not is_network and row.method != COARSE:
            continue
        reference = COARSE if is_network else "cma"
        other = by_place.get((row.family, row.budget, reference))
        if other is None:
            continue
        mean, low, high, count = row.difference(other)
        if is_network:
            compared += 1
            better += low > 0.0
        if not math.isnan(low):
            sentences.append(
                f"{row.family}, {row.budget} runs' worth of time: {row.method} scores "
                f"{mean:+.2f} against {reference} (95 % interval {low:+.2f} to "
                f"{high:+.2f}, {count} tasks)."
            )
    head = "No trained surrogate has been searched with yet."
    if compared:
        head = (
            "A surrogate finds better parameters than CMA-ES on the coarse simulator "
            f"in the same time in {better} of {compared} comparisons."
        )
    return [head, *sentences]
