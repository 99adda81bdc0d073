"""HTML and SVG as text that cannot be broken out of: plain strings are always escaped.

>>> tag("p", "a < b", tag("b", "!"), class_="note")
'<p class="note">a &lt; b<b>!</b></p>'

Numbers and names of metrics as readers like them: few digits, real minus signs, words.
Figures and what stands in them: keys, tables, and panels side by side, in rows of
truth, predictions and differences.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import accumulate
from unicodedata import east_asian_width

from lagbench.metrics.metric import Metric

# elements of HTML without an end tag
VOID = frozenset({"br", "col", "hr", "img", "link", "meta"})
# elements of SVG that close themselves
SHAPES = frozenset({"circle", "line", "path", "rect", "stop", "use"})

_ESCAPES = {
    ord("&"): "&amp;",
    ord("<"): "&lt;",
    ord(">"): "&gt;",
    ord('"'): "&quot;",
    ord("'"): "&#39;",
}
_UNPRINTABLE = dict.fromkeys((*range(9), 11, 12, *range(14, 32), *range(127, 160)), "�")
# marks that turn the direction of the text around them
_TURNING = dict.fromkeys(
    (1564, 8206, 8207, *range(8234, 8239), *range(8294, 8298)), "�"
)
_TABLE = _ESCAPES | _UNPRINTABLE | _TURNING


class Markup(str):
    """Text that is HTML already; only this module and :func:`tag` make it from
    strangers' text.
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
    """Return parts one after the other, those that are no markup escaped."""
    return Markup(escaped(separator).join(escaped(part) for part in parts))


def tag(name: str, /, *children: object, **attributes: object) -> Markup:
    """Return an element; children and values that are no markup are escaped."""
    spelled = ""
    for key, value in attributes.items():
        if value is not None and value is not False:
            label = key.rstrip("_").replace("_", "-")
            spelled += f" {label}" if value is True else f' {label}="{escaped(value)}"'
    if name in VOID:
        return Markup(f"<{name}{spelled}>")
    if name in SHAPES and not children:
        return Markup(f"<{name}{spelled}/>")
    return Markup(f"<{name}{spelled}>{join(children)}</{name}>")


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
        f"M{p[0]}h0" if len(p) == 1 else "M" + "L".join(p) for p in pieces if p
    )


def _short(value: float) -> str:
    text = f"{value:.1f}".removesuffix(".0")
    if text == "-0":
        return "0"
    return text


MISSING = "–"  # what stands where there is no number
DIGITS = 3  # significant digits
PLAIN = (-3, 5)  # powers of ten between which numbers are written out

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def power(exponent: int) -> str:
    """Return a power of ten.

    >>> power(-4)
    '10⁻⁴'
    """
    return f"10{str(exponent).translate(_RAISED)}"


def text(value: float, digits: int = DIGITS) -> str:
    """Return a number with so many significant digits.

    >>> text(0.012345), text(-2.5e-7), text(1200000.0), text(20.0), text(math.nan)
    ('0.0123', '−2.50×10⁻⁷', '1.20×10⁶', '20', '–')
    """
    if not math.isfinite(value):
        if math.isnan(value):
            return MISSING
        return "∞" if value > 0 else "−∞"
    if value == 0.0:
        return "0"
    if value == int(value) and abs(value) < 10.0 ** PLAIN[1]:
        return _minus(str(int(value)))
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    order = int(exponent)
    if PLAIN[0] <= order < PLAIN[1]:
        return _minus(f"{float(f'{mantissa}e{order}'):.{max(0, digits - 1 - order)}f}")
    return f"{_minus(mantissa)}×{power(order)}"


def html(value: float) -> Markup:
    """Return a number as markup that keeps together."""
    return tag("span", text(value), class_="n")


def interval(bounds: tuple[float, float]) -> Markup:
    """Return an interval as markup; nothing where there is none."""
    low, high = bounds
    if math.isnan(low) or math.isnan(high):
        return Markup("")
    return tag("span", f"{text(low)} … {text(high)}", class_="ci")


def decimals(values: Sequence[float], step: float) -> list[str]:
    """Return multiples of a step with just the decimals that the step needs.

    >>> decimals([-0.5, 0.0, 0.5], 0.5)
    ['−0.5', '0', '0.5']
    """
    places = max(0, -math.floor(math.log10(step) + 1e-9))
    while places < 9 and abs(round(step, places) - step) > 1e-9 * step:
        places += 1
    return [
        _minus(f"{value:.{places}f}") if abs(value) > step / 1e6 else "0"
        for value in values
    ]


def _minus(written: str) -> str:
    return written.replace("-", "−")


_CAPITALS = {
    "mse": "MSE",
    "mae": "MAE",
    "rmse": "RMSE",
    "nrmse": "NRMSE",
    "kl": "KL",
    "w1": "W1",
    "w2": "W2",
}
_OTHERS = {
    "pearson": "correlation",
    "avg": "average",
    "hist": "histogram",
    "abs": "magnitudes",
}


def words(name: str, *, capital: bool = False) -> str:
    """Return the name of a metric as words.

    >>> words("vorticity_rmse"), words("mse_avg", capital=True), words("energy_error", capital=True)
    ('vorticity RMSE', 'MSE average', 'Energy error')
    """
    written = " ".join(
        _CAPITALS.get(part) or _OTHERS.get(part, part) for part in name.split("_")
    )
    if capital:
        return written[0].upper() + written[1:]
    return written


def clipped(name: str, room: int = 34) -> str:
    """Return a name that takes no more room than so many narrow letters.

    >>> clipped("SuperGAT with a loss of six terms", room=12)
    'SuperGAT wi…'
    """
    ends = list(
        accumulate(2 if east_asian_width(letter) in "WF" else 1 for letter in name)
    )
    if not ends or ends[-1] <= room:
        return name
    return f"{name[: sum(end < room for end in ends)]}…"


def unit(metric: Metric) -> str:
    """Return the unit in brackets with a space before it, nothing for pure numbers."""
    if metric.unit == "1":
        return ""
    return f" [{metric.unit.replace('^2', '²')}]"


def quantity(metric: Metric) -> str:
    """Return what an axis shows: name and unit."""
    return words(metric.name) + unit(metric)


def sentence(metric: Metric) -> str:
    """Return what a metric says, its unit and where it is defined, as one sentence."""
    return f"{metric.summary[0].upper()}{metric.summary[1:]}{unit(metric)} ({metric.source})."


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One figure."""

    name: str  # identifier, unique on the page
    title: str  # what it shows, a few words
    thesis: str  # the figure of the thesis that it corresponds to, as in "Fig. 5.10"
    body: Markup  # the drawing, with its key
    caption: str  # what it shows, units, how to read it
    wide: bool = False  # whether it takes the whole width
    data: Markup | None = None  # its numbers as a table, where that is cheap


def key(items: Sequence[tuple[str, str]], *, kind: str = "line") -> Markup:
    """Return what the marks of a figure mean."""
    drawn = []
    for mark, name in items:
        swatch = tag("path", d="M1 5H21", class_=f"line {mark}")
        if kind == "square":
            swatch = tag(
                "rect", x=5, y=0, width=12, height=10, rx=2, class_=f"bar {mark}"
            )
        shown = tag(
            "svg", swatch, viewBox="0 0 22 10", class_="swatch", aria_hidden="true"
        )
        drawn.append(tag("li", shown, tag("span", name)))
    return tag("ul", *drawn, class_="key")


def table(
    head: Sequence[object],
    rows: Sequence[Sequence[object]],
    *,
    kind: str = "",
    label: str = "",
) -> Markup:
    """Return a table in a box of its own that scrolls when it is wider than the
    page.
    """
    headings = tag("tr", *(tag("th", cell, scope="col") for cell in head))
    body = [
        tag(
            "tr", tag("th", row[0], scope="row"), *(tag("td", cell) for cell in row[1:])
        )
        for row in rows
    ]
    drawn = tag(
        "table", tag("thead", headings), tag("tbody", *body), class_=kind or None
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


SIDE = 200  # side of the coordinates of a vector panel


def grid(
    columns: Sequence[object],
    rows: Sequence[tuple[str, Sequence[Markup]]],
    *,
    width: float = 6.6,
) -> Markup:
    """Return panels in a grid that scrolls sideways on narrow screens."""
    cells = [tag("span"), *(tag("span", column, class_="time") for column in columns)]
    for name, panels in rows:
        cells += [tag("span", name, class_="side"), *panels]
    tracks = f"grid-template-columns:minmax(5.2rem,6.5rem) repeat({len(columns)},minmax({width}rem,1fr))"
    return tag(
        "div",
        tag("div", *cells, class_="panels", style=tracks),
        class_="scroll",
        tabindex=0,
    )


def image(png: bytes, kind: str, alt: str, *, smooth: bool = False) -> Markup:
    """Return a panel, of classes that tell moving walls, that shows a picture of the
    inside of the box.
    """
    source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
    return tag(
        "span",
        tag("img", src=source, alt=alt, class_="smooth" if smooth else None),
        class_=kind,
    )


def vector(drawn: Markup, kind: str, alt: str) -> Markup:
    """Return a panel of lines in coordinates from 0 to 200."""
    svg = tag(
        "svg",
        tag("title", alt),
        drawn,
        viewBox=f"0 0 {SIDE} {SIDE}",
        class_="flow",
        role="img",
    )
    return tag("span", svg, class_=kind)


def ramp(kind: str, limit: float, unit: str, *, signed: bool = False) -> Markup:
    """Return the key of a colour scale."""
    if signed:
        low = f"−{text(limit)}"
    else:
        low = "0"
    bar = tag("span", class_=f"ramp {kind}")
    return tag(
        "p",
        join([low, bar, text(limit)], " "),
        tag("span", unit, class_="muted"),
        class_="scale",
    )
