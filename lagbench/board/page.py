"""The page of the leaderboard: one HTML file that asks nothing of the network.

Tables of the main scores are plain HTML; a script of our own sorts, filters and draws. A
content security policy lets only that script and style sheet run, by their hashes, so that
text of strangers could do nothing even if it were not escaped. Equal boards give equal bytes.
"""

from __future__ import annotations

import base64
import bisect
import functools
import hashlib
import re
from importlib.resources import files

from lagbench.report.html import tag

from .embedding import embedded
from .listing import EXPLAINED, lede, navigation, sections
from .model import Board
from .payload import FINENESS, Fineness, payload

__all__ = ["BUDGET", "FEWEST", "render"]

BUDGET = 39_000
"""Most bytes an entry may take, all in all: 50 of them make a page of less than 2 MB."""

FEWEST = 50
"""Fewer entries than these share what so many may take."""

SCRIPTS = (
    *("codec", "text", "scale", "chart", "state", "table", "csv"),
    *("overview", "maps", "film", "origin", "detail", "main"),
)
"""Parts of the script, in this order."""

FOOT = (
    "Velocity and vorticity are per frame; lengths are in units of the box. Times are of each entry's own"
    " machine.",
    "This page is one file, built by lagbench leaderboard build from the score files, and asks nothing of the"
    " network.",
)


def render(board: Board) -> str:
    """Return the page."""
    style, theme, script = _style(), _part("theme.js"), _script()
    held = {
        "policy": _policy(style, theme, script),
        "style": style,
        "theme": theme,
        "script": script,
        "lede": lede(board),
        "navigation": navigation(board),
        "sections": sections(board),
        "foot": "".join(tag("p", line) for line in FOOT),
    }
    entries = sum(not row.floor for tab in board.tabs for row in tab.rows)
    room = BUDGET * max(FEWEST, entries) - sum(len(text.encode()) for text in held.values())
    return _filled(_part("page.html"), {**held, "payload": _fitting(board, room)})


def _fitting(board: Board, room: int) -> str:
    """Return the finest data that take no more bytes, else the coarsest."""
    data = _data(board, FINENESS[0])
    if len(data) > room:
        found = bisect.bisect_left(FINENESS[1:-1], True, key=lambda one: len(_data(board, one)) <= room)
        data = _data(board, FINENESS[1 + found])
    return data.decode()


def _data(board: Board, fineness: Fineness) -> bytes:
    return embedded({**payload(board, fineness), "explained": dict(EXPLAINED)}).encode()


def _filled(template: str, held: dict[str, str]) -> str:
    # one pass: what is filled in is not looked at again
    return re.sub(r"\{\{([a-z]+)\}\}", lambda found: held[found[1]], template)


@functools.cache
def _part(name: str) -> str:
    return files(__package__).joinpath("page", name).read_text("utf-8")


@functools.cache
def _script() -> str:
    parts = "\n".join(_part(f"{name}.js") for name in SCRIPTS)
    return f'(() => {{\n"use strict";\n{parts}}})();\n'


@functools.cache
def _style() -> str:
    """Return the report's style sheet, its colours by choice of the reader, then our own."""
    report = files("lagbench.report").joinpath("style.css").read_text("utf-8")
    light, dark = re.findall(r":root\{([^}]*)\}", report)[:2]
    light = light.replace("color-scheme:light dark", "color-scheme:light")
    chosen = (
        f":root[data-theme=light]{{{light}}}\n:root[data-theme=dark]{{color-scheme:dark;{dark.strip()}}}\n"
    )
    return report + chosen + _part("page.css")


def _policy(style: str, *scripts: str) -> str:
    allowed = " ".join(_source(script) for script in scripts)
    return (
        f"default-src 'none'; script-src {allowed}; style-src {_source(style)}; img-src data:;"
        " base-uri 'none'; form-action 'none'"
    )


def _source(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
