"""Tables of text, and how Markdown spells them: escaped and aligned."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

_SPECIAL = re.compile(r"([\\`*_\[\]<>|#&~$])")


@dataclass(frozen=True)
class Table:
    """A table of text."""

    title: str  # what it shows
    columns: tuple[str, ...]  # names of the columns, perhaps in lines
    rows: tuple[tuple[str, ...], ...]  # cells, row by row
    keys: int = 1  # how many columns say what a row is


def escape(text: object) -> str:
    r"""Return text that Markdown shows as it stands, on one line.

    >>> print(escape("a_b | <c>"))
    a\_b \| \<c\>
    """
    return _SPECIAL.sub(r"\\\1", " ".join(str(text).split()))


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table in Markdown; numbers are set flush right, everything is escaped.

    Cells that start and end with a backtick are code and stay as they are.
    """
    numeric = [
        all(isinstance(row[i], int | float) for row in rows) and bool(rows)
        for i in range(len(head))
    ]
    lines = [map(escape, head), ("---:" if right else "---" for right in numeric)]
    lines += [map(_cell, row) for row in rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def _cell(value: object) -> str:
    if isinstance(value, bool):
        if value:
            return "yes"
        return "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.9g}"
    text = str(value)
    is_code = (
        len(text) > 2
        and text.startswith("`")
        and text.endswith("`")
        and "`" not in text[1:-1]
    )
    if is_code:
        return text.replace("|", "\\|")
    return escape(text)
