"""Names of methods that stand beside each other."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

__all__ = ["told_apart"]


def told_apart(methods: Sequence[str], taken: Collection[str] = ()) -> list[str]:
    """Return the methods; those that occur twice, or have a taken name, with a number.

    Args:
        methods: what the submissions call themselves.
        taken: names that are not theirs to use, as those of floors.

    >>> told_apart(["gns", "gat", "gns"])
    ['gns (1)', 'gat', 'gns (2)']
    """
    count, seen = Counter([*methods, *taken]), Counter[str]()
    names = []
    for method in methods:
        seen[method] += 1
        names.append(f"{method} ({seen[method]})" if count[method] > 1 else method)
    return names
