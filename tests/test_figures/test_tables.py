"""Tables of text in Markdown."""

from __future__ import annotations

import re

from hypothesis import given
from hypothesis import strategies as st

from lagbench.figures.tables import escape, escape_prose

ESCAPED = re.compile(r"\\([\\`*_\[\]<>|#&~$])")
SPECIAL = re.compile(r"[`*_\[\]<>|#&~$]")

letters = st.characters(codec="utf-8", exclude_categories=["Cc", "Zl", "Zp"])


@given(st.text(letters))
def test_escaping_only_adds_backslashes(text: str) -> None:
    """Taking the backslashes away gives the text on one line."""
    one_line = " ".join(text.split())
    assert ESCAPED.sub(r"\1", escape(text)) == one_line


@given(st.text(letters))
def test_no_special_character_stands_bare(text: str) -> None:
    """Without what is escaped no character has a meaning for Markdown."""
    bare = re.sub(r"\\.", "", escape(text))
    assert not SPECIAL.search(bare)


@given(st.text(letters))
def test_prose_keeps_names_in_backticks_and_nothing_else(text: str) -> None:
    """Without escaped characters and such names no character has a meaning."""
    prose = escape_prose(text)
    one_line = " ".join(text.split())
    assert ESCAPED.sub(r"\1", prose) == one_line
    bare = re.sub(r"\\.", "", prose)
    bare = re.sub(r"`[A-Za-z0-9_.-]+`", "", bare)
    assert not SPECIAL.search(bare)
