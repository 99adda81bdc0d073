"""Statistics of a scenario as sums that add, so that chunks and workers combine.

Every (statistic, frame) holds a sum and its weight. Pieces measured apart have disjoint
frames, and adding a zero changes no bit: any chunking, in any order, gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UsageError

from .frame import Floats, FramePair
from .metric import Metric

__all__ = ["Tally", "measure", "tally"]


@dataclass(frozen=True, eq=False)
class Tally:
    """Sums over measurements of the statistics of one scenario."""

    names: tuple[str, ...]  # names of the statistics
    frames: tuple[int, ...]  # absolute frame numbers
    total: Floats  # sum of the defined values, shape [statistic, frame]
    weight: NDArray[np.int64]  # how many defined values that is, shape [statistic, frame]
    undefined: NDArray[np.int64]  # how many values were NaN, shape [statistic, frame]

    @classmethod
    def of(
        cls, names: Sequence[str], frames: Sequence[int], measured: Mapping[int, Mapping[str, float]]
    ) -> Self:
        """Return the tally of values by frame and name; what is missing weighs nothing."""
        row = {name: i for i, name in enumerate(names)}
        column = {frame: i for i, frame in enumerate(frames)}
        values = np.zeros((len(row), len(column)))
        seen = np.zeros(values.shape, np.int64)
        for frame, statistics in measured.items():
            for name, value in statistics.items():
                if name not in row or frame not in column:
                    raise UsageError(f"statistic {name!r} at frame {frame} has no place in the tally")
                values[row[name], column[frame]] = value
                seen[row[name], column[frame]] = 1
        nan = np.isnan(values)
        return cls(tuple(names), tuple(frames), np.where(nan, 0.0, values), seen * ~nan, seen * nan)

    def __add__(self, other: Tally) -> Tally:
        """Combine two pieces of the same scenario."""
        if (self.names, self.frames) != (other.names, other.frames):
            raise UsageError("tallies of different statistics or frames do not add")
        return Tally(
            self.names,
            self.frames,
            self.total + other.total,
            self.weight + other.weight,
            self.undefined + other.undefined,
        )

    def series(self, name: str) -> Floats:
        """Return a statistic per frame, NaN where it has no value, shape [frame]."""
        i = self.names.index(name)
        values = np.full(len(self.frames), np.nan)
        np.divide(self.total[i], self.weight[i], out=values, where=self.weight[i] > 0)
        return values

    def measured(self, name: str) -> NDArray[np.bool_]:
        """Tell at which frames a statistic was measured, defined or not, shape [frame]."""
        i = self.names.index(name)
        return np.asarray(self.weight[i] + self.undefined[i] > 0, np.bool_)


def measure(pair: FramePair, metrics: Iterable[Metric]) -> dict[str, float]:
    """Return the statistics of one frame pair by name, NaN where one is undefined."""
    return {m.name: m.measure(pair) for m in metrics if m.statistic is not None and m.applies(pair)}


def tally(pairs: Iterable[FramePair], metrics: Sequence[Metric], frames: Sequence[int]) -> Tally:
    """Measure consecutive frame pairs, holding one at a time."""
    names = [m.name for m in metrics if m.statistic is not None]
    return Tally.of(names, frames, {pair.frame: measure(pair, metrics) for pair in pairs})
