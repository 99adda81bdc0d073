"""Text of strangers made harmless, and JSON that may stand in HTML."""

from __future__ import annotations

import json
import unicodedata

__all__ = ["clean", "embedded"]

LONGEST = 2000
"""Letters of a text that the page holds."""

_ESCAPED = "<>&\u2028\u2029"
"""What could end an element, start one, or end a line of a script."""

_TURNING = {1564, 8206, 8207, *range(8234, 8239), *range(8294, 8298)}
"""Marks that turn the direction of the text around them."""


def embedded(value: object) -> str:
    r"""Return JSON that may stand in an HTML element, whatever the strings in it hold.

    >>> print(embedded({"name": "</script>"}))
    {"name":"\u003c/script\u003e"}
    """
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    text = text.encode("utf-8", "replace").decode("utf-8")
    for letter in _ESCAPED:
        text = text.replace(letter, f"\\u{ord(letter):04x}")
    return text


def clean(text: str, longest: int = LONGEST) -> str:
    r"""Return text without control characters, lone surrogates and marks that turn it around.

    >>> clean("a\x00b"), clean("abcdef", longest=4)
    ('a�b', 'abc…')
    """
    shown = "".join(letter if _harmless(letter) else "�" for letter in text[:longest])
    return shown if len(text) <= longest else f"{shown[: longest - 1]}…"


def _harmless(letter: str) -> bool:
    return letter in "\t\n" or (
        ord(letter) not in _TURNING and unicodedata.category(letter) not in ("Cc", "Cs")
    )
