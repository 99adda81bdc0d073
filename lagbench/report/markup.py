"""HTML and SVG as text that cannot be broken out of: plain strings are always escaped.

>>> tag("p", "a < b", tag("b", "!"), class_="note")
'<p class="note">a &lt; b<b>!</b></p>'
"""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["Markup", "escaped", "join", "path_data", "tag"]

VOID = frozenset({"br", "col", "hr", "img", "link", "meta"})
"""Elements of HTML without an end tag."""

SHAPES = frozenset({"circle", "line", "path", "rect", "stop", "use"})
"""Elements of SVG that close themselves."""

_ESCAPES = {ord("&"): "&amp;", ord("<"): "&lt;", ord(">"): "&gt;", ord('"'): "&quot;", ord("'"): "&#39;"}
_UNPRINTABLE = dict.fromkeys((*range(9), 11, 12, *range(14, 32), *range(127, 160)), "�")
# marks that turn the direction of the text around them
_TURNING = dict.fromkeys((1564, 8206, 8207, *range(8234, 8239), *range(8294, 8298)), "�")
_TABLE = _ESCAPES | _UNPRINTABLE | _TURNING


class Markup(str):
    """Text that is HTML already; only this module and :func:`tag` make it from strangers' text."""

    __slots__ = ()


def escaped(text: object) -> Markup:
    """Return any text as HTML that shows it.

    Control characters, lone surrogates and marks that turn the text direction become U+FFFD.

    >>> escaped('<script>"&"')
    '&lt;script&gt;&quot;&amp;&quot;'
    """
    if isinstance(text, Markup):
        return text
    whole = str(text).encode("utf-8", "replace").decode("utf-8")
    return Markup(whole.translate(_TABLE))


def join(parts: Iterable[object], separator: object = "") -> Markup:
    """Return parts one after the other, those that are no markup escaped."""
    return Markup(escaped(separator).join(escaped(part) for part in parts))


def tag(name: str, /, *children: object, **attributes: object) -> Markup:
    """Return an element; children and values that are no markup are escaped.

    Args:
        name: name of the element.
        *children: its content.
        **attributes: ``class_`` stands for class, ``aria_label`` for aria-label; None is left
            out, True stands without a value.
    """
    spelled = "".join(_attribute(key, value) for key, value in attributes.items())
    if name in VOID:
        return Markup(f"<{name}{spelled}>")
    if name in SHAPES and not children:
        return Markup(f"<{name}{spelled}/>")
    return Markup(f"<{name}{spelled}>{join(children)}</{name}>")


def _attribute(key: str, value: object) -> str:
    if value is None or value is False:
        return ""
    name = key.rstrip("_").replace("_", "-")
    return f" {name}" if value is True else f' {name}="{escaped(value)}"'


def path_data(points: Iterable[tuple[float, float]]) -> str:
    """Return SVG path data through points; a point that is no number leaves a gap.

    >>> nan = float("nan")
    >>> path_data([(0, 0), (1, 2.25), (nan, 0), (3, 3)])
    'M0 0L1 2.2M3 3h0'
    """
    pieces: list[list[str]] = [[]]
    for x, y in points:
        if x - x == 0.0 and y - y == 0.0:
            pieces[-1].append(f"{_short(x)} {_short(y)}")
        elif pieces[-1]:
            pieces.append([])
    return "".join(
        f"M{piece[0]}h0" if len(piece) == 1 else "M" + "L".join(piece) for piece in pieces if piece
    )


def _short(value: float) -> str:
    text = f"{value:.1f}".removesuffix(".0")
    return "0" if text == "-0" else text
