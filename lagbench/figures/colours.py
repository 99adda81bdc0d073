"""The colours of all drawings: pictures, films, and pages in a light and a dark scheme.

Materials take hues of Okabe & Ito (2008), which stay apart under every common colour
vision deficiency and in grey. This module needs no plotting library.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

INK = "#1c2330"  # titles and labels
MUTED = "#667085"  # second lines and tick labels
PAPER = "#ffffff"  # background
WALL = "#d5d9e0"  # walls at rest
MOVING = "#d55e00"  # moving walls: vermilion, which jelly has too; no split has both

# liquid, jelly, snow, rope: blue, vermilion, sky blue, orange
MATERIAL_COLOURS = ("#0072b2", "#d55e00", "#56b4e9", "#e69f00")

LIGHT: Mapping[str, str] = {
    "paper": "#fff",
    "card": "#fff",
    "ink": "#1c2330",
    "soft": "#475067",
    "muted": "#667085",
    "rule": "#e4e7ec",
    "faint": "#f5f6f8",
    "accent": "#0072b2",
    "good": "#00795a",
    "warn": "#9a5b00",
    "bad": "#b3401a",
    "moving": "#d55e00",
    # series of a chart
    "c0": "#0072b2",
    "c1": "#d55e00",
    "c2": "#009e73",
    "c3": "#c2659a",
    "c4": "#d18f00",
    "c5": "#3f9fd8",
    # speeds of arrows, slow to fast
    "q0": "#c3d3e3",
    "q1": "#8fb7d6",
    "q2": "#5596c4",
    "q3": "#2672ab",
    "q4": "#174f86",
    "q5": "#0d2b57",
    "wall": "#98a2b3",
}
"""Colours of pages in the light scheme, by CSS variable."""

DARK: Mapping[str, str] = {
    "paper": "#10141b",
    "card": "#161b24",
    "ink": "#e8ebf1",
    "soft": "#bac2d0",
    "muted": "#94a0b4",
    "rule": "#2a3240",
    "faint": "#1b212c",
    "accent": "#5bb3e8",
    "good": "#3fcfa2",
    "warn": "#f0b04a",
    "bad": "#f58a5f",
    "moving": "#f0853a",
    "c0": "#4aa8e0",
    "c1": "#f0853a",
    "c2": "#2cc79a",
    "c3": "#e49ac2",
    "c4": "#f2b93b",
    "c5": "#9ad6f7",
    "q0": "#2b3a50",
    "q1": "#32577f",
    "q2": "#377ab0",
    "q3": "#4d9fd6",
    "q4": "#8cc7ee",
    "q5": "#e6f5ff",
    "wall": "#667085",
}
"""Colours of pages in the dark scheme, by CSS variable."""

PRINT: Mapping[str, str] = {
    **LIGHT,
    "ink": "#111",
    "soft": "#333",
    "muted": "#666",
    "rule": "#ddd",
    "faint": "#f4f4f4",
    "accent": "#111",
}
"""Colours of pages on paper, by CSS variable."""


def parse_rgb(colour: str) -> NDArray[np.uint8]:
    """Return a ``#rrggbb`` colour as three bytes.

    >>> parse_rgb("#ff8000")
    array([255, 128,   0], dtype=uint8)
    """
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8)


PAPER_RGB = parse_rgb(PAPER)
"""Bytes of the background."""

MATERIAL_RGB = tuple(parse_rgb(colour) for colour in MATERIAL_COLOURS)
"""Bytes of each material."""


def format_variables(colours: Mapping[str, str]) -> str:
    """Return declarations of CSS variables.

    >>> format_variables({"ink": "#111", "paper": "#fff"})
    '--ink:#111;--paper:#fff'
    """
    return ";".join(f"--{name}:{colour}" for name, colour in colours.items())


def format_schemes() -> str:
    """Return the CSS rules that choose between light, dark and print."""
    light = f":root{{color-scheme:light dark;{format_variables(LIGHT)}}}"
    dark = f":root{{{format_variables(DARK)}}}"
    on_paper = f":root{{{format_variables(PRINT)}}}"
    return (
        f"{light}\n"
        f"@media (prefers-color-scheme:dark){{{dark}}}\n"
        f"@media print{{{on_paper}}}\n"
    )
