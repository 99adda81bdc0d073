"""Guess why frames or scenarios are not those expected, so that a message can say it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lagbench.data.registry import spell_ids

__all__ = ["guess_frames", "guess_scenarios", "guess_start", "spell_numbers"]

MAX_SPELLED = 60
"""Longest list of numbers in a message [characters]."""


def spell_numbers(numbers: Sequence[int]) -> str:
    """Return numbers as ranges, shortened in the middle where they are many.

    >>> spell_numbers([6, 7, 8, 10])
    '6-8,10'
    """
    text = spell_ids(numbers)
    return text if len(text) <= MAX_SPELLED else f"{text[: MAX_SPELLED - 3]}... ({len(numbers)} numbers)"


def guess_frames(got: Sequence[int], expected: range) -> str:
    """Return what seems to have happened to the frame numbers."""
    given, count = expected.start, len(expected)
    if not got:
        return "there are no frames"
    number, times = Counter(got).most_common(1)[0]
    if times > 1:
        return f"frame {number} stands twice"
    if sorted(got) == list(expected):
        return "seems to hold the right frames in another order: store them ascending"
    steps = {b - a for a, b in pairwise(got)}
    if len(steps) == 1 and (step := steps.pop()) > 1:
        return f"seems to skip: it holds every {_ordinal(step)} frame only"
    return _guess_run(got, given, count)


def _guess_run(got: Sequence[int], given: int, count: int) -> str:
    """Guess about frame numbers that may be one run of consecutive numbers."""
    first, last = got[0], got[-1]
    if any(b - a != 1 for a, b in pairwise(got)):
        missing = sorted(set(range(given, given + count)) - set(got))
        return (
            f"lacks the frames {spell_numbers(missing)}"
            if missing
            else "holds frames that are no predictions"
        )
    if first in (0, 1) and len(got) == count:
        return f"seems to count from the first predicted frame, whose absolute number is {given}"
    if first < given and last == given + count - 1:
        return f"seems to start at the input frames: leave out the frames before {given}"
    if first == given and last < given + count - 1:
        return f"stops too early: the last frame is {given + count - 1}"
    if first == given:
        return f"goes on too long: leave out the frames after {given + count - 1}"
    return f"seems to be shifted by {first - given} frames" if len(got) == count else "holds other frames"


def _ordinal(number: int) -> str:
    if number % 100 in (11, 12, 13):
        return f"{number}th"
    return f"{number}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(number % 10, 'th') }"


def guess_scenarios(got: Sequence[int], subsets: Mapping[str, Sequence[int]]) -> str:
    """Return where unknown scenario ids may come from."""
    for subset, ids in subsets.items():
        if subset != "test" and set(got) <= set(ids):
            return f"these are scenarios of {subset}"
    if list(got) == list(range(len(subsets["test"]))) or list(got) == list(range(1, len(got) + 1)):
        return "seems to count the scenarios: store their ids"
    return "name the scenarios by their ids"


def guess_start(predicted: NDArray[np.floating], given: NDArray[np.floating], limit: float) -> str:
    """Return what seems to be wrong with a first predicted frame far from the last given one.

    Args:
        predicted: positions at the first predicted frame [length], shape [particle, space].
        given: positions at the last given frame [length], shape [particle, space].
        limit: root mean square distance that is too far [length].
    """
    predicted, given = predicted.astype(np.float64), given.astype(np.float64)
    if _distance(np.sort(predicted, axis=0), np.sort(given, axis=0)) <= limit:
        return "the particles seem to stand in another order"
    if _distance(predicted[:, ::-1], given) <= limit:
        return "x and y seem to be swapped"
    if _distance(predicted * given.std(axis=0) + given.mean(axis=0), given) <= limit:
        return "the positions seem to be standardised: undo that before writing"
    if _distance(predicted + given, given) <= limit:
        return "these seem to be displacements: add them up to positions"
    return "the first predicted frame must follow the last given one, particle by particle"


def _distance(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """Return the root mean square distance of particles [length]."""
    square = np.sum((one - other) ** 2, axis=-1)
    return float(np.sqrt(square.mean()))
