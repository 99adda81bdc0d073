"""Tables of text, and their Markdown: escaped and aligned."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_SPECIAL = re.compile(r"([\\`*_\[\]<>|#&~$])")
_CODE = re.compile(r"`[A-Za-z0-9_.-]+`")


@dataclass(frozen=True)
class Table:
    """A table of text."""

    title: str  # what it shows
    columns: tuple[str, ...]  # names of the columns, perhaps in lines
    rows: tuple[tuple[str, ...], ...]  # cells, row by row
    keys: int = 1  # number of columns that say what a row is


def escape(text: object) -> str:
    r"""Return text that Markdown shows as it stands, on one line.

    >>> print(escape("a_b | <c>"))
    a\_b \| \<c\>
    """
    return _escape_specials(" ".join(str(text).split()))


def escape_prose(text: object) -> str:
    r"""Return text that Markdown shows as it stands, its names in backticks as code.

    >>> print(escape_prose("a_b: `active_frames` | <c>"))
    a\_b: `active_frames` \| \<c\>
    """
    parts = []
    end = 0
    one_line = " ".join(str(text).split())
    for code in _CODE.finditer(one_line):
        parts.append(_escape_specials(one_line[end : code.start()]))
        parts.append(code[0])
        end = code.end()
    parts.append(_escape_specials(one_line[end:]))
    return "".join(parts)


def _escape_specials(text: str) -> str:
    """Return a text with a backslash before what has a meaning for Markdown."""
    return _SPECIAL.sub(r"\\\1", text)


def markdown(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a table in Markdown, all text escaped.

    Columns of numbers are set flush right. Cells that start and end with a backtick
    are code and stay as they are.
    """
    lines = [_format_line(map(escape, head))]
    rules = []
    for column in range(len(head)):
        rules.append(_format_rule(rows, column))
    lines.append(_format_line(rules))
    for row in rows:
        lines.append(_format_line(map(_format_cell, row)))
    return "\n".join(lines)


def _format_line(cells: Iterable[str]) -> str:
    joined = " | ".join(cells)
    return f"| {joined} |"


def _format_rule(rows: Sequence[Sequence[object]], column: int) -> str:
    """Return the rule below a heading, which says where the column is set flush."""
    is_numeric = all(isinstance(row[column], int | float) for row in rows)
    if rows and is_numeric:
        return "---:"
    return "---"


def _format_cell(value: object) -> str:
    if isinstance(value, bool):
        if value:
            return "yes"
        return "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.9g}"
    text = str(value)
    is_quoted = len(text) > 2 and text.startswith("`") and text.endswith("`")
    if is_quoted and "`" not in text[1:-1]:
        return text.replace("|", "\\|")
    return escape(text)
