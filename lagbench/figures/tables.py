"""Tables of text, and their Markdown: escaped and aligned."""

from __future__ import annotations

import re
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
