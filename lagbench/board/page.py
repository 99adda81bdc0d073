"""The page of the leaderboard: one HTML file that asks nothing of the network.

All text and every number of the tables is plain HTML; a script of our own sorts, filters and
draws. A content security policy lets only that script and style sheet run, by their hashes, so
that text of strangers could do nothing even if it were not escaped. Equal boards give equal bytes.
"""

from __future__ import annotations

import base64
import bisect
import functools
import hashlib
import re
from collections.abc import Mapping
from importlib.resources import files

from lagbench.report.html import join, tag

from .model import Board
from .payload import FINENESS, Fineness, embedded, payload
from .sections import empty, lede, navigation, overview, section, stage

BUDGET = 40_000  # bytes that an entry shall take, all in all; more only where its coarsest data need them
FEWEST = 50  # fewer entries than these share what so many may take, 2 MB

SCRIPTS = (
    *("codec", "text", "scale", "chart", "state", "table"),
    *("overview", "maps", "film", "stage", "detail", "main"),
)
"""Parts of the script, in this order."""

LINKS: Mapping[str, str] = {
    "Repository": "../README.md",
    "Documentation": "../docs/index.md",
    "How to submit": "../docs/submitting.md",
    "Citation": "../CITATION.cff",
}
"""What the page leads to, from the leaderboard's folder; what is not there is left out."""

FOOT = (
    "Velocity and vorticity are per frame; lengths are in units of the box. Times are of each entry's own"
    " machine.",
    "This page is one file, built by lagbench leaderboard build from the score files, and asks nothing of the"
    " network. How to cite a data set: lagbench cite.",
)


def render(board: Board, links: Mapping[str, str] = LINKS) -> str:
    """Return the page."""
    theme, parts = _part("theme.js"), "\n".join(_part(f"{name}.js") for name in SCRIPTS)
    script = f'(() => {{\n"use strict";\n{parts}}})();\n'
    report = files("lagbench.report").joinpath("style.css").read_text("utf-8")
    # colours by choice of the reader are those of the report's style sheet once more
    light, dark = re.findall(r":root\{([^}]*)\}", report)[:2]
    light = light.replace("color-scheme:light dark", "color-scheme:light")
    dark = f"color-scheme:dark;{dark.strip()}"
    chosen = f":root[data-theme=light]{{{light}}}\n:root[data-theme=dark]{{{dark}}}\n"
    style = report + chosen + _part("page.css")
    allowed = " ".join(_source(one) for one in (theme, script))
    held = {
        "policy": f"default-src 'none'; script-src {allowed}; style-src {_source(style)}; img-src data:;"
        " base-uri 'none'; form-action 'none'",
        "style": style,
        "theme": theme,
        "script": script,
        "links": join(tag("a", label, href=address) for label, address in links.items()),
        "lede": lede(board),
        "stage": stage(board),
        "navigation": navigation(board),
        "sections": join([overview(board), *(section(tab, board.metrics) for tab in board.tabs)], "\n"),
        "empty": empty(board),
        "foot": join(tag("p", line) for line in FOOT),
    }
    entries = sum(len(tab.rows) for tab in board.tabs)
    room = BUDGET * max(FEWEST, entries) - sum(len(one.encode()) for one in held.values())

    @functools.cache
    def drawn(fineness: Fineness) -> str:
        return embedded(payload(board, fineness))

    def fits(fineness: Fineness) -> bool:
        return len(drawn(fineness).encode()) <= room

    # the finest data that take no more room, else the coarsest; mostly it is the finest of all
    first = 0 if fits(FINENESS[0]) else 1 + bisect.bisect_left(FINENESS[1:-1], True, key=fits)
    held["payload"] = drawn(FINENESS[first])
    # one pass: what is filled in is not looked at again
    return re.sub(r"\{\{([a-z]+)\}\}", lambda found: held[found[1]], _part("page.html"))


@functools.cache
def _part(name: str) -> str:
    return files(__package__).joinpath("page", name).read_text("utf-8")


def _source(said: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(said.encode()).digest()).decode()}'"
