"""Compare two score files: which statistics and pictures differ by more than the storage rounds.

Those of the same predictions must be alike as a whole. Those of one data set must be alike in
what depends on the truth alone, whatever was predicted.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from lagbench.metrics import Tally
from lagbench.scoring.scenario import LONG_BITS, LONG_ROLLOUT, Preview
from lagbench.scoring.score_file import FILM_RANGE, LEVELS, StoredScores

from .pictures import PREDICTION, TRUTH
from .stored import Stored

__all__ = ["OF_PREDICTIONS", "TRUE_STATISTICS", "TOLERANCE", "other_statistics", "unlike", "untrue"]

TOLERANCE = 1e-6
"""Relative difference up to which two numbers are equal; NumPy versions may differ in the last bits."""

TRUE_STATISTICS = frozenset(
    {
        *("energy_true", "energy_retention_true", "momentum_scale", "angular_momentum_scale"),
        *("divergence_rms_true", "connectivity_true", "connectivity_true_jelly", "connectivity_true_rope"),
    }
)
"""Statistics of the truth: equal in all score files of a data set."""

OF_PREDICTIONS = frozenset({"vorticity_pearson"})
"""Statistics that predictions can leave undefined; of others the truth alone says at which frames."""

FILM_STEP = (FILM_RANGE[1] - FILM_RANGE[0]) / LEVELS
"""Step of packed film positions [length]."""

SHARES = 5e-3
"""Difference up to which shares of a histogram are equal: an edge may fall to either bin."""


def unlike(ours: Stored, theirs: Stored) -> Iterator[str]:
    """Yield what differs between two score files of the same predictions."""
    if not _same_frames(ours.scores, theirs.scores):
        yield "scenarios or frames"
        return
    names = dict.fromkeys((*_names(ours.scores), *_names(theirs.scores)))
    yield from other_statistics(ours.scores, theirs.scores, names)
    yield from _pictures(ours, theirs, (TRUTH, PREDICTION))


def untrue(one: Stored, other: Stored) -> Iterator[str]:
    """Yield what differs between two score files of a data set although the truth alone decides it."""
    if not _same_frames(one.scores, other.scores):
        yield "scenarios or frames"
        return
    common = [name for name in _names(one.scores) if name in _names(other.scores)]
    yield from other_statistics(one.scores, other.scores, [n for n in common if n in TRUE_STATISTICS])
    yield from (f"frames of {name}" for name in common if not _same_gaps(name, one.scores, other.scores))
    yield from _pictures(one, other, (TRUTH,))


def other_statistics(ours: StoredScores, theirs: StoredScores, names: Collection[str]) -> list[str]:
    """Return the names of statistics that differ, or that one of two score files lacks."""
    return [name for name in names if not _same(name, ours, theirs)]


def _names(scores: StoredScores) -> tuple[str, ...]:
    return next(iter(scores.tallies.values())).names


def _same_frames(one: StoredScores, other: StoredScores) -> bool:
    frames = {tally.frames for scores in (one, other) for tally in scores.tallies.values()}
    return set(one.tallies) == set(other.tallies) and len(frames) == 1


def _same(name: str, ours: StoredScores, theirs: StoredScores) -> bool:
    """Tell whether a statistic is the same in all scenarios and frames."""
    if name not in _names(ours) or name not in _names(theirs):
        return False
    return all(_close(tally, theirs.tallies[i], name) for i, tally in ours.tallies.items())


def _close(one: Tally, other: Tally, name: str) -> bool:
    # of a long rollout the last bits may have pushed a value over to the next step of its rounding
    room = 2.0 ** (1 - LONG_BITS) if len(one.frames) > LONG_ROLLOUT else TOLERANCE
    same = np.allclose(one.series(name), other.series(name), rtol=room, atol=0.0, equal_nan=True)
    return bool(same) and np.array_equal(one.measured(name), other.measured(name))


def _same_gaps(name: str, one: StoredScores, other: StoredScores) -> bool:
    """Tell whether a statistic is measured, and defined, at the same frames."""
    for i, tally in one.tallies.items():
        second = other.tallies[i]
        if not np.array_equal(tally.measured(name), second.measured(name)):
            return False
        gaps = np.isnan(tally.series(name)), np.isnan(second.series(name))
        if name not in OF_PREDICTIONS and not np.array_equal(*gaps):
            return False
    return True


def _pictures(one: Stored, other: Stored, sides: Collection[int]) -> Iterator[str]:
    """Yield which pictures differ by more than the steps in which they are packed."""
    first, second, shown = one.preview, other.preview, list(sides)
    if not _same_choice(first, second):
        yield "what is pictured"
        return
    step = max(one.precision, other.precision)
    if not _near(first.vorticity[shown], second.vorticity[shown], 1.01 * step):
        yield "vorticity maps"
    if not _near(first.histogram[shown], second.histogram[shown], SHARES):
        yield "vorticity histograms"
    if not _near(first.film[shown], second.film[shown], 1.01 * FILM_STEP):
        yield "the film"


def _same_choice(first: Preview, second: Preview) -> bool:
    """Tell whether two previews show the same scenario, frames, particles and range."""
    names = ("scenario", "map_frames", "film_frames", "particles")
    shapes = [(p.vorticity.shape, p.film.shape, p.material.tolist()) for p in (first, second)]
    return (
        all(getattr(first, name) == getattr(second, name) for name in names)
        and shapes[0] == shapes[1]
        and _near(first.histogram_range, second.histogram_range, 0.0)
    )


def _near(one: NDArray[np.float32], other: NDArray[np.float32], room: float) -> bool:
    a, b = one.astype(np.float64), other.astype(np.float64)
    return bool(np.allclose(a, b, rtol=1e-5, atol=room, equal_nan=True))
