"""Panels side by side: rows of truth, predictions and differences, columns of frames."""

from __future__ import annotations

from collections.abc import Sequence

from .gallery import Walls
from .markup import Markup, join, tag
from .numbers import text
from .png import data_uri

__all__ = ["grid", "image", "ramp", "vector"]

SIDE = 200
"""Side of the coordinates of a vector panel."""


def grid(
    columns: Sequence[object], rows: Sequence[tuple[str, Sequence[Markup]]], *, width: float = 6.6
) -> Markup:
    """Return panels in a grid that scrolls sideways on narrow screens.

    Args:
        columns: what stands above each column.
        rows: name of each row and its panels.
        width: least width of a panel [rem].
    """
    cells = [tag("span"), *(tag("span", column, class_="time") for column in columns)]
    for name, panels in rows:
        cells += [tag("span", name, class_="side"), *panels]
    tracks = f"grid-template-columns:minmax(5.2rem,6.5rem) repeat({len(columns)},minmax({width}rem,1fr))"
    return tag("div", tag("div", *cells, class_="panels", style=tracks), class_="scroll", tabindex=0)


def image(png: bytes, walls: Walls, alt: str, *, smooth: bool = False) -> Markup:
    """Return a panel that shows a picture of the inside of the box."""
    kind = "smooth" if smooth else None
    return tag("span", tag("img", src=data_uri(png), alt=alt, class_=kind), class_=_classes(walls))


def vector(drawn: Markup, walls: Walls, alt: str) -> Markup:
    """Return a panel of lines in coordinates from 0 to 200."""
    svg = tag("svg", tag("title", alt), drawn, viewBox=f"0 0 {SIDE} {SIDE}", class_="flow", role="img")
    return tag("span", svg, class_=_classes(walls))


def _classes(walls: Walls) -> str:
    return f"panel {walls.classes}".strip()


def ramp(kind: str, limit: float, unit: str, *, signed: bool = False) -> Markup:
    """Return the key of a colour scale.

    Args:
        kind: "diverging", "sequential" or "flow".
        limit: value of full colour.
        unit: quantity and unit.
        signed: whether the scale starts at minus the limit.
    """
    low = f"−{text(limit)}" if signed else "0"
    bar = tag("span", class_=f"ramp {kind}")
    return tag("p", join([low, bar, text(limit)], " "), tag("span", unit, class_="muted"), class_="scale")
