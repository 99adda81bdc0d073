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
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.data.registry import Registry
from lagbench.errors import ChecksFailedError
from lagbench.report.html import join, tag

from .collect import collect
from .entry_file import schema_bytes
from .folder import PAGE, SCHEMA, Folder
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


@dataclass(frozen=True, kw_only=True)
class BuildResult:
    """A page that was drawn."""

    page: Path
    bytes: int
    tabs: int  # splits and sizes on it
    rows: int  # entries on it
    written: tuple[Path, ...]  # files that were missing or had other bytes


def build(
    board: str | Path,
    *,
    check: bool = False,
    registry: Registry | None = None,
) -> BuildResult:
    """Write the page and schema.json of a leaderboard's folder; files that are right stay untouched.

    Args:
        board: the leaderboard's folder.
        check: write nothing, fail where a file would change.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: no leaderboard there.
        UnreadableFileError: an entry or a score file cannot be read.
        ChecksFailedError: an entry does not fit, or with ``check`` a file is stale.
        WorkFailedError: the disk is full or not writable.
    """
    folder, held = Folder(board), collect(board, registry=registry)
    links = {label: path for label, path in LINKS.items() if (folder.path / path).exists()}
    page = folder.path / PAGE
    if check and page.is_file():  # a copy of the folder elsewhere still has the links of where it was drawn
        said = page.read_bytes()
        links = {n: path for n, path in LINKS.items() if str(tag("a", n, href=path)).encode() in said}
    wanted = {page: render(held, links).encode(), folder.path / SCHEMA: schema_bytes()}
    stale = [
        path
        for path, data in wanted.items()
        if path.is_symlink()
        or not path.is_file()
        or path.stat().st_size != len(data)
        or path.read_bytes() != data
    ]
    if stale and check:
        raise ChecksFailedError(
            "the page is not what the submissions give",
            where=", ".join(str(path) for path in stale),
            expected=", ".join(f"{path.name} of {len(wanted[path])} bytes" for path in stale),
            got="another content, or no file",
            fix=f"lagbench leaderboard build --board {board}",
        )
    for path in stale:
        write_atomically(path, wanted[path], option="--board")
    return BuildResult(
        page=page,
        bytes=len(wanted[page]),
        tabs=len(held.tabs),
        rows=sum(len(tab.rows) for tab in held.tabs),
        written=tuple(stale),
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
