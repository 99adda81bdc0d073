"""The page: one HTML file with a table of contents, sections and numbered figures.

Nothing in it is fetched from anywhere: styles, drawings and pictures stand in the file, there
is no script, and a content security policy forbids the browser to ask for more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files

from .markup import Markup, join, tag

__all__ = ["Figure", "Section", "document", "key", "paragraph", "table"]

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"


@dataclass(frozen=True, kw_only=True)
class Figure:
    """One figure.

    Attributes:
        name: identifier, unique on the page.
        title: what it shows, a few words.
        thesis: the figure of the thesis that it corresponds to, as in "Fig. 5.10".
        body: the drawing, with its key.
        caption: what it shows, units, how to read it.
        wide: whether it takes the whole width.
        data: its numbers as a table, where that is cheap.
    """

    name: str
    title: str
    thesis: str
    body: Markup
    caption: Markup
    wide: bool = False
    data: Markup | None = None


@dataclass(frozen=True, kw_only=True)
class Section:
    """A stretch of the page.

    Attributes:
        name: identifier, unique on the page.
        title: its heading.
        lead: what stands before the figures.
        figures: its figures.
    """

    name: str
    title: str
    lead: Markup
    figures: Sequence[Figure] = ()


def document(title: str, head: Markup, sections: Sequence[Section], foot: Markup) -> str:
    """Return the page.

    Args:
        title: title of the window.
        head: top of the page.
        sections: its sections; figures are numbered through all of them.
        foot: last lines.
    """
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
        tag("style", Markup(_style())),
    ]
    whole = tag("html", tag("head", *meta), tag("body", *body), lang="en")
    return f"<!DOCTYPE html>\n{whole}\n"


def _style() -> str:
    """Return the style sheet, which lies beside this module."""
    return files(__package__).joinpath("style.css").read_text("utf-8")


def _section(section: Section, first: int) -> Markup:
    figures = [_figure(figure, first + i) for i, figure in enumerate(section.figures)]
    grid = tag("div", *figures, class_="figures") if figures else Markup("")
    heading = tag("h2", section.title)
    return join([tag("section", heading, section.lead, grid, id=f"part-{section.name}", class_="part"), "\n"])


def _figure(figure: Figure, number: int) -> Markup:
    heading = tag("h3", tag("span", f"Figure {number}", class_="number"), " ", figure.title)
    source = tag("span", f"thesis {figure.thesis}", class_="thesis")
    numbers = tag("details", tag("summary", "Numbers"), figure.data, class_="numbers") if figure.data else ""
    caption = tag("figcaption", tag("p", figure.caption, " ", source))
    kind = "figure wide" if figure.wide else "figure"
    drawn = tag("figure", heading, figure.body, caption, numbers, id=figure.name, class_=kind)
    return join([drawn, "\n"])


def key(items: Sequence[tuple[str, str]], *, kind: str = "line") -> Markup:
    """Return what the marks of a figure mean.

    Args:
        items: classes of the mark and its name.
        kind: class of the marks themselves, "line" or "square".
    """
    return tag(
        "ul", *(tag("li", _swatch(mark, kind), tag("span", name)) for mark, name in items), class_="key"
    )


def _swatch(mark: str, kind: str) -> Markup:
    if kind == "square":
        drawn = tag("rect", x=5, y=0, width=12, height=10, rx=2, class_=f"bar {mark}")
    else:
        drawn = tag("path", d="M1 5H21", class_=f"line {mark}")
    return tag("svg", drawn, viewBox="0 0 22 10", class_="swatch", aria_hidden="true")


def table(
    head: Sequence[object], rows: Sequence[Sequence[object]], *, kind: str = "", label: str = ""
) -> Markup:
    """Return a table in a box of its own that scrolls when it is wider than the page.

    Args:
        head: headings of the columns.
        rows: cells of each row, the first one its heading.
        kind: further classes.
        label: what it holds, for those who do not see it.
    """
    headings = tag("tr", *(tag("th", cell, scope="col") for cell in head))
    body = [tag("tr", tag("th", row[0], scope="row"), *(tag("td", cell) for cell in row[1:])) for row in rows]
    drawn = tag("table", tag("thead", headings), tag("tbody", *body), class_=kind or None)
    return tag("div", drawn, class_="scroll", role="region", aria_label=label or None, tabindex=0)


def paragraph(*parts: object) -> Markup:
    """Return a paragraph."""
    return tag("p", join(parts))
