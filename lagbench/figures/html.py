"""HTML and SVG as text that cannot be broken out of: plain strings are always escaped.

>>> tag("p", "a < b", tag("b", "!"), class_="note")
'<p class="note">a &lt; b<b>!</b></p>'

Numbers and names of metrics are written as readers like them: few digits, real minus
signs, words. Figures consist of keys, tables, and panels side by side.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from unicodedata import east_asian_width

from lagbench.metrics.metric import Metric

from .colours import format_schemes

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


MISSING = "–"  # stands where there is no number
DIGITS = 3  # significant digits
PLAIN_POWERS = range(-3, 5)  # powers of ten of numbers that are written out

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def format_power(exponent: int) -> str:
    """Return a power of ten.

    >>> format_power(-4)
    '10⁻⁴'
    """
    return f"10{str(exponent).translate(_RAISED)}"


def text(value: float, digits: int = DIGITS) -> str:
    """Return a number with so many significant digits.

    >>> text(0.012345), text(-2.5e-7), text(1200000.0), text(20.0), text(math.nan)
    ('0.0123', '−2.50×10⁻⁷', '1.20×10⁶', '20', '–')
    """
    if math.isnan(value):
        return MISSING
    if math.isinf(value):
        return _format_minus(f"{value}".replace("inf", "∞"))
    if value == 0.0:
        return "0"
    if value == int(value) and abs(value) < 10.0**PLAIN_POWERS.stop:
        return _format_minus(str(int(value)))
    # rounding may raise the power: 0.99999 is 1.00
    mantissa, _, exponent = f"{value:.{digits - 1}e}".partition("e")
    order = int(exponent)
    if order in PLAIN_POWERS:
        rounded = float(f"{mantissa}e{order}")
        return _format_minus(f"{rounded:.{max(0, digits - 1 - order)}f}")
    return f"{_format_minus(mantissa)}×{format_power(order)}"


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


def _format_minus(number: str) -> str:
    return number.replace("-", "−")


_PARTS_OF_NAMES = {
    "mse": "MSE",
    "mae": "MAE",
    "rmse": "RMSE",
    "nrmse": "NRMSE",
    "kl": "KL",
    "w1": "W1",
    "w2": "W2",
    "pearson": "correlation",
    "avg": "average",
    "hist": "histogram",
    "abs": "magnitudes",
}


def words(name: str, *, capital: bool = False) -> str:
    """Return the name of a metric as words.

    >>> words("vorticity_rmse"), words("mse_avg"), words("energy_error", capital=True)
    ('vorticity RMSE', 'MSE average', 'Energy error')
    """
    parts = [_PARTS_OF_NAMES.get(part, part) for part in name.split("_")]
    phrase = " ".join(parts)
    if capital:
        return phrase[0].upper() + phrase[1:]
    return phrase


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


def format_unit(metric: Metric) -> str:
    """Return the unit in brackets with a space before it, nothing for pure numbers."""
    if metric.unit == "1":
        return ""
    return f" [{metric.unit.replace('^2', '²')}]"


def format_quantity(metric: Metric) -> str:
    """Return the label of an axis: name and unit."""
    return words(metric.name) + format_unit(metric)


def sentence(metric: Metric) -> str:
    """Return a metric's summary, unit and source as one sentence."""
    summary = metric.summary[0].upper() + metric.summary[1:]
    return f"{summary}{format_unit(metric)} ({metric.source})."


@dataclass(frozen=True, kw_only=True)
class ReportFigure:
    """One figure of a page."""

    name: str  # identifier, unique on the page
    title: str  # what it shows, a few words
    thesis: str  # the figure of the thesis that it corresponds to, as in "Fig. 5.10"
    body: Markup  # the drawing, with its key
    caption: str  # what it shows, units, how to read it
    wide: bool = False  # whether it takes the whole width
    data: Markup | None = None  # its numbers as a table, where that is cheap


def draw_key(items: Sequence[tuple[str, str]], *, kind: str = "line") -> Markup:
    """Return the key of a figure.

    Args:
        items: classes of each mark, and its meaning.
        kind: "line" or "square", the shape of the marks.
    """
    drawn = []
    for mark, name in items:
        swatch = _draw_swatch(mark, kind)
        drawn.append(tag("li", swatch, tag("span", name)))
    return tag("ul", *drawn, class_="key")


def _draw_swatch(mark: str, kind: str) -> Markup:
    if kind == "square":
        shape = tag(
            "rect",
            x=5,
            y=0,
            width=12,
            height=10,
            rx=2,
            class_=f"bar {mark}",
        )
    else:
        shape = tag("path", d="M1 5H21", class_=f"line {mark}")
    return tag(
        "svg",
        shape,
        viewBox="0 0 22 10",
        class_="swatch",
        aria_hidden="true",
    )


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


SIDE = 200  # side of the coordinates of a panel of lines


def draw_panel_grid(
    columns: Sequence[object],
    rows: Sequence[tuple[str, Sequence[Markup]]],
    *,
    width: float = 6.6,
) -> Markup:
    """Return named rows of panels in a grid that scrolls sideways on narrow screens.

    The width is that of the narrowest panel [rem].
    """
    cells = [tag("span")]
    for column in columns:
        cells.append(tag("span", column, class_="time"))
    for name, panels in rows:
        cells.append(tag("span", name, class_="side"))
        cells += panels
    tracks = f"minmax(5.2rem,6.5rem) repeat({len(columns)},minmax({width}rem,1fr))"
    style = f"grid-template-columns:{tracks}"
    drawn = tag("div", *cells, class_="panels", style=style)
    return tag("div", drawn, class_="scroll", tabindex=0)


def draw_image_panel(
    png: bytes, kind: str, alt: str, *, smooth: bool = False, aspect: float = 1.0
) -> Markup:
    """Return a panel that shows a picture of the inside of the box.

    Args:
        png: the picture.
        kind: classes of the panel, which tell the walls that move.
        alt: the picture in words.
        smooth: whether browsers may blur it when they enlarge it.
        aspect: width over height of the box.
    """
    source = f"data:image/png;base64,{base64.b64encode(png).decode()}"
    image_kind = None
    if smooth:
        image_kind = "smooth"
    drawn = tag("img", src=source, alt=alt, class_=image_kind)
    return tag("span", drawn, class_=kind, style=_aspect_style(aspect))


def draw_line_panel(
    drawn: Markup, kind: str, alt: str, *, aspect: float = 1.0
) -> Markup:
    """Return a panel of lines in coordinates from 0 to :data:`SIDE`, left to right.

    The aspect is width over height of the box.
    """
    box = f"0 0 {SIDE} {SIDE / aspect:g}"
    title = tag("title", alt)
    svg = tag("svg", title, drawn, viewBox=box, class_="flow", role="img")
    return tag("span", svg, class_=kind, style=_aspect_style(aspect))


def _aspect_style(aspect: float) -> str | None:
    """Return the style of a panel of a box that is no square; None for a square."""
    if aspect == 1.0:
        return None
    return f"aspect-ratio:{aspect:.4g}"


def draw_ramp(kind: str, limit: float, unit: str, *, signed: bool = False) -> Markup:
    """Return the key of a colour scale."""
    if signed:
        low = f"−{text(limit)}"
    else:
        low = "0"
    bar = tag("span", class_=f"ramp {kind}")
    scale = join([low, bar, text(limit)], " ")
    unit_label = tag("span", unit, class_="muted")
    return tag("p", scale, unit_label, class_="scale")
