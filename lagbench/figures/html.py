"""HTML and SVG as text that cannot be broken out of: plain strings are always escaped.

>>> tag("p", "a < b", tag("b", "!"), class_="note")
'<p class="note">a &lt; b<b>!</b></p>'

Numbers and names of metrics are written as readers like them: few digits, real minus
signs, words. Figures consist of keys, tables, and panels side by side.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from importlib.resources import files
from unicodedata import east_asian_width

from .colours import format_schemes
from .numbers import _format_minus, text

# elements of HTML without an end tag
VOID = frozenset({"br", "col", "hr", "img", "link", "meta"})
# elements of SVG that close themselves
SHAPES = frozenset({"circle", "line", "path", "rect", "stop", "use"})

REPLACEMENT = "\ufffd"  # stands for characters that cannot be shown

_ESCAPES = {
    ord("&"): "&amp;",
    ord("<"): "&lt;",
    ord(">"): "&gt;",
    ord('"'): "&quot;",
    ord("'"): "&#39;",
}
_CONTROLS = (*range(9), 11, 12, *range(14, 32), *range(127, 160))
# marks that turn the direction of the text around them
_TURNING = (1564, 8206, 8207, *range(8234, 8239), *range(8294, 8298))
_TABLE = _ESCAPES | dict.fromkeys((*_CONTROLS, *_TURNING), REPLACEMENT)


class Markup(str):
    """Text that is HTML already.

    Only this module makes it from the text of strangers.
    """

    __slots__ = ()


def escaped(text: object) -> Markup:
    """Return any text as HTML that shows it.

    Control characters, lone surrogates and marks that turn the text direction become
    U+FFFD.

    >>> escaped('<script>"&"')
    '&lt;script&gt;&quot;&amp;&quot;'
    """
    if isinstance(text, Markup):
        return text
    whole = str(text).encode("utf-8", "replace").decode("utf-8")
    return Markup(whole.translate(_TABLE))


def join(parts: Iterable[object], separator: object = "") -> Markup:
    """Return parts one after the other; plain strings are escaped."""
    return Markup(escaped(separator).join(escaped(part) for part in parts))


def tag(name: str, /, *children: object, **attributes: object) -> Markup:
    """Return an element; children and values that are plain strings are escaped.

    An attribute that is None or False is left out, and True stands without a value.
    """
    attribute_text = ""
    for key, value in attributes.items():
        if value is None or value is False:
            continue
        label = key.rstrip("_").replace("_", "-")
        if value is True:
            attribute_text += f" {label}"
        else:
            attribute_text += f' {label}="{escaped(value)}"'
    if name in VOID:
        return Markup(f"<{name}{attribute_text}>")
    if name in SHAPES and not children:
        return Markup(f"<{name}{attribute_text}/>")
    return Markup(f"<{name}{attribute_text}>{join(children)}</{name}>")


def path_data(points: Iterable[Iterable[float]]) -> str:
    """Return SVG path data through points; a point that is no number leaves a gap.

    >>> nan = float("nan")
    >>> path_data([(0, 0), (1, 2.25), (nan, 0), (3, 3)])
    'M0 0L1 2.2M3 3h0'
    """
    pieces: list[list[str]] = [[]]
    for x, y in points:
        if math.isfinite(x) and math.isfinite(y):
            pieces[-1].append(f"{_format_place(x)} {_format_place(y)}")
        elif pieces[-1]:
            pieces.append([])

    data = ""
    for piece in pieces:
        if len(piece) == 1:
            data += f"M{piece[0]}h0"
        elif piece:
            data += "M" + "L".join(piece)
    return data


def _format_place(value: float) -> str:
    text = f"{value:.1f}".removesuffix(".0")
    if text == "-0":
        return "0"
    return text


def load_style_sheet() -> str:
    """Return the style sheet of pages, with its light and its dark scheme."""
    rules = files(__package__).joinpath("style.css").read_text("utf-8")
    return format_schemes() + rules


def wrap_number(value: float) -> Markup:
    """Return a number as markup that keeps together."""
    return tag("span", text(value), class_="n")


def interval(bounds: tuple[float, float]) -> Markup:
    """Return an interval as markup; nothing where there is none."""
    low, high = bounds
    if math.isnan(low) or math.isnan(high):
        return Markup("")
    return tag("span", f"{text(low)} … {text(high)}", class_="ci")


def format_multiples(values: Sequence[float], step: float) -> list[str]:
    """Return multiples of a step with just the decimals that the step needs.

    >>> format_multiples([-0.5, 0.0, 0.5], 0.5)
    ['−0.5', '0', '0.5']
    """
    places = max(0, -math.floor(math.log10(step) + 1e-9))
    while places < 9 and abs(round(step, places) - step) > 1e-9 * step:
        places += 1
    labels = []
    for value in values:
        is_zero = abs(value) <= step / 1e6
        if is_zero:
            labels.append("0")
        else:
            labels.append(_format_minus(f"{value:.{places}f}"))
    return labels


def clipped(name: str, room: int = 34) -> str:
    """Return a name that takes no more room than so many narrow letters.

    >>> clipped("SuperGAT with a loss of six terms", room=12)
    'SuperGAT wi…'
    """
    width = 0
    fitting = 0  # letters that leave room for the ellipsis
    for letter in name:
        if east_asian_width(letter) in "WF":
            width += 2
        else:
            width += 1
        if width < room:
            fitting += 1
    if width <= room:
        return name
    return f"{name[:fitting]}…"


def draw_table(
    head: Sequence[object],
    rows: Sequence[Sequence[object]],
    *,
    kind: str = "",
    label: str = "",
) -> Markup:
    """Return a table in a box that scrolls when it is wider than the page."""
    headings = []
    for cell in head:
        headings.append(tag("th", cell, scope="col"))
    lines = []
    for first, *others in rows:
        cells = [tag("th", first, scope="row")]
        for cell in others:
            cells.append(tag("td", cell))
        lines.append(tag("tr", *cells))
    drawn = tag(
        "table",
        tag("thead", tag("tr", *headings)),
        tag("tbody", *lines),
        class_=kind or None,
    )
    return tag(
        "div",
        drawn,
        class_="scroll",
        role="region",
        aria_label=label or None,
        tabindex=0,
    )


def paragraph(*parts: object) -> Markup:
    """Return a paragraph."""
    return tag("p", join(parts))
