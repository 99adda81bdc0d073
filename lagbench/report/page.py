"""The page: one HTML file with a table of contents, sections and numbered figures.

Nothing in it is fetched from anywhere: styles, drawings and pictures stand in the file, there
is no script, and a content security policy forbids the browser to ask for more.

Panels side by side: rows of truth, predictions and differences, columns of frames.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

from .html import Markup, join, tag, text
from .subject import Walls

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One figure."""

    name: str  # identifier, unique on the page
    title: str  # what it shows, a few words
    thesis: str  # the figure of the thesis that it corresponds to, as in "Fig. 5.10"
    body: Markup  # the drawing, with its key
    caption: Markup  # what it shows, units, how to read it
    wide: bool = False  # whether it takes the whole width
    data: Markup | None = None  # its numbers as a table, where that is cheap


@dataclass(frozen=True)
class Section:
    """A stretch of the page."""

    name: str  # identifier, unique on the page
    title: str  # its heading
    lead: Markup  # what stands before the figures
    figures: Sequence[Figure] = ()


def document(title: str, head: Markup, sections: Sequence[Section], foot: Markup) -> str:
    """Return the page."""
    links = [tag("li", tag("a", section.title, href=f"#part-{section.name}")) for section in sections]
    contents = tag("nav", tag("ol", *links), class_="contents", aria_label="Contents")
    first = 1
    written = []
    for section in sections:
        written.append(_section(section, first))
        first += len(section.figures)
    body = [
        tag("header", head),
        tag("div", contents, tag("main", *written), class_="columns"),
        tag("footer", foot),
    ]
    meta = [
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=POLICY),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("meta", name="referrer", content="no-referrer"),
        tag("title", title),
        tag("link", rel="icon", href="data:,"),
        tag("style", Markup(files(__package__).joinpath("style.css").read_text("utf-8"))),
    ]
    whole = tag("html", tag("head", *meta), tag("body", *body), lang="en")
    return f"<!DOCTYPE html>\n{whole}\n"


def _section(section: Section, first: int) -> Markup:
    figures = []
    for number, figure in enumerate(section.figures, first):
        heading = tag("h3", tag("span", f"Figure {number}", class_="number"), " ", figure.title)
        source = tag("span", f"thesis {figure.thesis}", class_="thesis")
        numbers = tag("details", tag("summary", "Numbers"), figure.data, class_="numbers")
        parts = [heading, figure.body, tag("figcaption", tag("p", figure.caption, " ", source))]
        kind = "figure wide" if figure.wide else "figure"
        drawn = tag("figure", *parts, numbers if figure.data else "", id=figure.name, class_=kind)
        figures.append(join([drawn, "\n"]))
    grid = tag("div", *figures, class_="figures") if figures else ""
    heading = tag("h2", section.title)
    return join([tag("section", heading, section.lead, grid, id=f"part-{section.name}", class_="part"), "\n"])


def key(items: Sequence[tuple[str, str]], *, kind: str = "line") -> Markup:
    """Return what the marks of a figure mean."""
    drawn = []
    for mark, name in items:
        swatch = tag("path", d="M1 5H21", class_=f"line {mark}")
        if kind == "square":
            swatch = tag("rect", x=5, y=0, width=12, height=10, rx=2, class_=f"bar {mark}")
        shown = tag("svg", swatch, viewBox="0 0 22 10", class_="swatch", aria_hidden="true")
        drawn.append(tag("li", shown, tag("span", name)))
    return tag("ul", *drawn, class_="key")


def table(
    head: Sequence[object], rows: Sequence[Sequence[object]], *, kind: str = "", label: str = ""
) -> Markup:
    """Return a table in a box of its own that scrolls when it is wider than the page."""
    headings = tag("tr", *(tag("th", cell, scope="col") for cell in head))
    body = [tag("tr", tag("th", row[0], scope="row"), *(tag("td", cell) for cell in row[1:])) for row in rows]
    drawn = tag("table", tag("thead", headings), tag("tbody", *body), class_=kind or None)
    return tag("div", drawn, class_="scroll", role="region", aria_label=label or None, tabindex=0)


def paragraph(*parts: object) -> Markup:
    """Return a paragraph."""
    return tag("p", join(parts))


SIDE = 200  # side of the coordinates of a vector panel


def grid(
    columns: Sequence[object], rows: Sequence[tuple[str, Sequence[Markup]]], *, width: float = 6.6
) -> Markup:
    """Return panels in a grid that scrolls sideways on narrow screens."""
    cells = [tag("span"), *(tag("span", column, class_="time") for column in columns)]
    for name, panels in rows:
        cells += [tag("span", name, class_="side"), *panels]
    tracks = f"grid-template-columns:minmax(5.2rem,6.5rem) repeat({len(columns)},minmax({width}rem,1fr))"
    return tag("div", tag("div", *cells, class_="panels", style=tracks), class_="scroll", tabindex=0)


def image(png: bytes, walls: Walls, alt: str, *, smooth: bool = False) -> Markup:
    """Return a panel that shows a picture of the inside of the box."""
    source = "data:image/png;base64," + base64.b64encode(png).decode("ascii")
    shown = tag("img", src=source, alt=alt, class_="smooth" if smooth else None)
    return tag("span", shown, class_=_classes(walls))


def vector(drawn: Markup, walls: Walls, alt: str) -> Markup:
    """Return a panel of lines in coordinates from 0 to 200."""
    svg = tag("svg", tag("title", alt), drawn, viewBox=f"0 0 {SIDE} {SIDE}", class_="flow", role="img")
    return tag("span", svg, class_=_classes(walls))


def _classes(walls: Walls) -> str:
    return f"panel {walls.classes}".strip()


def ramp(kind: str, limit: float, unit: str, *, signed: bool = False) -> Markup:
    """Return the key of a colour scale."""
    low = f"−{text(limit)}" if signed else "0"
    bar = tag("span", class_=f"ramp {kind}")
    return tag("p", join([low, bar, text(limit)], " "), tag("span", unit, class_="muted"), class_="scale")
