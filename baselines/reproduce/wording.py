"""Numbers and comparisons in words: what a test says, and no more."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np

from lagbench.metrics import Score, compare
from lagbench.metrics.significance import FEWEST_SCENARIOS

__all__ = ["agreement", "interval", "listed", "number", "ordinal", "pair", "told", "wins"]


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many digits, a dash where there is none.

    >>> number(0.00012345), number(None), number(12345678.0)
    ('0.000123', '-', '1.23e+07')
    """
    return "-" if value is None or math.isnan(value) else f"{value:.{digits}g}"


def interval(score: Score) -> str:
    """Return mean and 95 % interval over scenarios, as in "0.12 (0.1 to 0.15)"."""
    low, high = score.interval
    bounds = "" if math.isnan(low) else f" ({number(low)} to {number(high)})"
    return f"{number(score.mean)}{bounds}"


def ordinal(place: int) -> str:
    """Return a place in words.

    >>> [ordinal(place) for place in (1, 2, 3, 4, 11, 12, 21, 22)]
    ['1st', '2nd', '3rd', '4th', '11th', '12th', '21st', '22nd']
    """
    last = 0 if place % 100 in (11, 12, 13) else place % 10
    return f"{place}{ {1: 'st', 2: 'nd', 3: 'rd'}.get(last, 'th') }"


def listed(names: Iterable[str]) -> str:
    """Return names with commas and an "and".

    >>> listed(["a", "b", "c"]), listed(["a"])
    ('a, b and c', 'a')
    """
    *rest, last = names
    return f"{', '.join(rest)} and {last}" if rest else last


def agreement(first: Sequence[str], second: Sequence[str]) -> float:
    """Return Kendall's tau of two orders of the same names: 1 the same, -1 reversed, 0 unrelated.

    >>> agreement("abc", "abc"), agreement("abc", "cba"), round(agreement("abc", "acb"), 3)
    (1.0, -1.0, 0.333)
    """
    pairs = list(combinations(first, 2))
    turned = sum(second.index(a) > second.index(b) for a, b in pairs)
    return 1.0 - 2.0 * turned / len(pairs)


def wins(first: Score, second: Score) -> tuple[int, int]:
    """Return in how many scenarios the first has the smaller loss, and how many both have."""
    loss = first.metric.loss
    pairs = [(loss(a), loss(b)) for a, b in zip(first.values, second.values, strict=True)]
    known = [(a, b) for a, b in pairs if not (math.isnan(a) or math.isnan(b))]
    return sum(a < b for a, b in known), len(known)


def pair(first: Score, second: Score) -> str:
    """Return the two means, the scenarios won, the difference's interval, and p.

    The difference is second minus first in the metric's loss: positive favours the first.
    """
    found, (won, of) = compare(first, second), wins(first, second)
    low, high = (-bound for bound in reversed(found.interval))
    bounds = (
        "" if math.isnan(low) else f", lead {number(-found.difference)} ({number(low)} to {number(high)})"
    )
    p = f"p = {number(found.p, 2)}" if not math.isnan(found.p) else f"{of} scenarios: no p-value"
    return (
        f"{number(first.mean)} against {number(second.mean)}, better in {won} of {of} scenarios{bounds}, {p}"
    )


def told(first: Score, second: Score, names: tuple[str, str]) -> str:
    """Return which of two is better, in a clause that claims no more than the exact test lets it."""
    found = compare(first, second)
    if len(found.scenarios) < FEWEST_SCENARIOS:
        return f"with fewer than {FEWEST_SCENARIOS} scenarios nothing is claimed"
    if not found.significant or np.isnan(found.difference):
        return f"{names[0]} and {names[1]} cannot be told apart at 5 %"
    better, worse = names if found.difference < 0.0 else names[::-1]
    return f"{better} is better than {worse}"
