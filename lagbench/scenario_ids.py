"""Scenario ids as text: ``0,3-5`` means 0, 3, 4 and 5."""

from __future__ import annotations

import re
from collections.abc import Iterable

from .errors import UsageError

__all__ = ["MAX_ID", "parse_ids", "spell_ids"]

MAX_ID = 9999
"""Largest scenario id: file names have four digits."""

_PART = re.compile(r"(\d{1,4})(?:-(\d{1,4}))?")


def parse_ids(text: str | int) -> tuple[int, ...]:
    """Return the scenario ids that a text names, in its order.

    Args:
        text: comma-separated ids and inclusive ranges; an int stands for itself.

    Raises:
        UsageError: the text is no list of ids, a range runs backwards, or an id stands twice.

    >>> parse_ids("0,3-5")
    (0, 3, 4, 5)
    """
    ids: list[int] = []
    for part in str(text).replace(" ", "").split(","):
        match = _PART.fullmatch(part)
        if match is None:
            raise _bad(text, f"{part!r} is no id and no range")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise _bad(text, f"{part!r} runs backwards")
        ids.extend(range(first, last + 1))
    if len(set(ids)) != len(ids):
        raise _bad(text, "an id stands twice")
    return tuple(ids)


def spell_ids(ids: Iterable[int]) -> str:
    """Return the shortest text that :func:`parse_ids` reads as these ids.

    >>> spell_ids([0, 3, 4, 5])
    '0,3-5'
    """
    runs: list[list[int]] = []
    for i in ids:
        if runs and i == runs[-1][-1] + 1:
            runs[-1].append(i)
        else:
            runs.append([i])
    return ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)


def _bad(text: str | int, got: str) -> UsageError:
    return UsageError(
        f"bad scenario list {text!r}",
        where="--scenarios",
        expected=f"ids and ranges from 0 to {MAX_ID}, as in 0,3-5",
        got=got,
    )
