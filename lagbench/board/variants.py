"""Which entries of a data set are variants of another one.

A variant's name continues that of a method by the same authors with a comma or a word:
``GNS, six terms`` and ``GNS without vorticity loss`` are variants of ``GNS``; ``GNS2``
and ``LSTM + MLP`` are methods of their own.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from .entry import Entry

CONTINUATION = re.compile(r",|\s+\w")
"""What follows the method in the name of a variant."""


def find_variants(
    entries: Sequence[Entry], methods: Sequence[Entry]
) -> Mapping[str, str]:
    """Return the method that each variant belongs to, by the id of the variant.

    Args:
        entries: the entries of a data set.
        methods: those among them that others may be variants of.
    """
    by_length = sorted(methods, key=lambda entry: (len(entry.name), entry.method))
    variants = {}
    for entry in entries:
        for method in by_length:
            if is_variant(entry, method):
                variants[entry.method] = method.method
                break
    return variants


def is_variant(entry: Entry, method: Entry) -> bool:
    """Tell whether an entry is a variant of a method."""
    if entry.authors != method.authors or not entry.name.startswith(method.name):
        return False
    rest = entry.name[len(method.name) :]
    return CONTINUATION.match(rest) is not None
