"""Which test scenario of ours stands for which of the thesis.

At size ``full`` the ids are the thesis's own. Other sizes have other ids: the first test scenario
of the same family (fluid: id % 4) or pair (multimaterial: id % 6) stands in.
"""

from __future__ import annotations

from collections.abc import Iterable

from lagbench.data.registry import Size

from .thesis import TABLE_4_8, Rollout

__all__ = ["after_given", "predicted", "rollouts", "stand_in", "case_id"]

FAMILIES = {"fluid": 4, "multimaterial": 6}


def rollouts(split: str) -> tuple[Rollout, ...]:
    """Return the rows of Table 4.8 that belong to a split."""
    return tuple(row for row in TABLE_4_8 if (row.scenario < 54) == (split == "fluid"))


def stand_in(size: Size, scenario: int) -> int | None:
    """Return the test scenario that stands for one of the thesis; None where there is none alike."""
    test = sorted(size.subsets["test"])
    if scenario in test and size.name == "full":
        return scenario
    families = FAMILIES[size.split]
    return next((i for i in test if i % families == scenario % families), None)


def case_id(size: Size, number: int) -> int | None:
    """Return the id of the thesis's test case T0, T1, ...: ours in ascending order; None beyond them."""
    test = sorted(size.subsets["test"])
    return test[number] if number < len(test) else None


def after_given(size: Size, counts: Iterable[int]) -> tuple[int, ...]:
    """Return the absolute frames so many after the last given one, those that are predicted.

    >>> from lagbench.data.registry import load
    >>> after_given(load().size("curl-noise", "full"), (1, 5, 35, 500))
    (6, 10, 40)
    """
    return predicted(size, [size.task.input_frames - 1 + count for count in counts])


def predicted(size: Size, frames: Iterable[int]) -> tuple[int, ...]:
    """Return those absolute frames that are predicted; the last predicted one if none is."""
    first, last = size.task.input_frames, size.task.input_frames + size.task.horizon - 1
    return tuple(frame for frame in frames if first <= frame <= last) or (last,)
