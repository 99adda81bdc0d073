"""Several charts in one SVG file."""

from __future__ import annotations

from collections.abc import Sequence

from lagbench.figures.chart import HEIGHT, WIDTH
from lagbench.figures.html import Markup, tag

STYLE = """
text{font-family:system-ui,sans-serif}
.chart text{font-size:12px;fill:#1c2330}
.chart .tick,.chart .note{fill:#667085;font-size:11.5px}
.grid{stroke:#e4e7ec}
.axis,.mark{stroke:#98a2b3}
.level{stroke:#98a2b3;stroke-dasharray:5 4}
.end{text-anchor:end}
.middle{text-anchor:middle}
.line{fill:none;stroke:var(--c);stroke-width:2}
.line.thin{stroke-width:1;opacity:.5}
.dot circle{fill:#fff;stroke:var(--c);stroke-width:1.8}
.dot .reach{fill:none;stroke:none}
.chart .name{fill:var(--c);paint-order:stroke;stroke:#fff;stroke-width:4px}
.naive{--c:#667085}
.classical{--c:#1c2330}
.learned{--c:#2458d3}
.hybrid{--c:#d55e00}
.s0{--c:#2458d3}
.s1{--c:#d55e00}
.s2{--c:#009e73}
.s3{--c:#b8860b}
.s4{--c:#8e44ad}
.s5{--c:#56b4e9}
"""
"""Colours of a picture on its own, by kind of method or by series."""

GAP = 14  # between two charts [pixel]


def join_charts(
    charts: Sequence[Markup], *, columns: int = 2, height: int = HEIGHT
) -> str:
    """Return charts of one height side by side, row by row, as an SVG file."""
    places = []
    for number, chart in enumerate(charts):
        row, column = divmod(number, columns)
        places.append(
            tag(
                "svg",
                chart,
                x=column * (WIDTH + GAP),
                y=row * (height + GAP),
                width=WIDTH,
                height=height,
            )
        )
    rows = -(-len(charts) // columns)
    whole_width = columns * (WIDTH + GAP)
    whole_height = rows * (height + GAP)
    background = tag("rect", width=whole_width, height=whole_height, fill="#fff")
    svg = tag(
        "svg",
        tag("style", STYLE),
        background,
        *places,
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {whole_width} {whole_height}",
        width=whole_width,
        height=whole_height,
    )
    return f"{svg}\n"
