"""The page of the leaderboard: one HTML file that asks nothing of the network.

Jinja2 escapes all text, that of strangers too. All numbers of the tables are plain
HTML; a small script sorts, filters and shows one data set at a time. The charts are
Vega-Lite specifications that Vega draws, whose code stands in the page.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from lagbench.addresses import DOCUMENTATION
from lagbench.atomic import write_atomically
from lagbench.data.registry import Registry
from lagbench.errors import ChecksFailedError, check_installed
from lagbench.metrics.table import METRICS

from .columns import SHOWN_METRICS, best_of, columns_of, format_number
from .entry import schema_bytes
from .folder import PAGE, SCHEMA, Folder
from .rows import Board, Tab, collect, conclude

VEGA_EMBED = "window.vegaEmbed = vegaEmbed;"
"""What the bundle of Vega gives to the script of the page."""


@dataclass(frozen=True, kw_only=True)
class BuildResult:
    """A page that was drawn."""

    page: Path
    bytes: int
    tabs: int  # splits and sizes on it
    rows: int  # entries on it
    written: tuple[Path, ...]  # files that were missing or had another content


def build(
    board: str | Path,
    *,
    check: bool = False,
    registry: Registry | None = None,
    documentation: str = DOCUMENTATION,
) -> BuildResult:
    """Write page and schema.json where they are stale.

    Args:
        board: the leaderboard's folder.
        check: whether to write nothing; stale files are an error then.
        registry: where splits are described; ours when None.
        documentation: address of the documentation's site; empty where it has none.

    Raises:
        ChecksFailedError: with ``check``, a file is stale; else see
            :func:`.rows.collect`.
        UsageError: no leaderboard, or the extra ``plots`` is not installed.
        UnreadableFileError, DataError: see :func:`.rows.collect`.
    """
    check_installed("vl_convert", extra="plots")
    folder = Folder(board)
    content = collect(board, registry=registry, metrics=SHOWN_METRICS)
    files = {
        folder.path / PAGE: render(content, documentation).encode(),
        folder.path / SCHEMA: schema_bytes(),
    }
    stale = []
    for path, data in files.items():
        if not path.is_file() or path.read_bytes() != data:
            stale.append(path)
    if stale and check:
        names = ", ".join(map(str, stale))
        raise ChecksFailedError(f"{names}: out of date; lagbench leaderboard build")
    for path in stale:
        write_atomically(path, files[path], option="--board")
    page = folder.path / PAGE
    entries = 0
    for tab in content.tabs:
        entries += sum(row.entry is not None for row in tab.rows)
    return BuildResult(
        page=page,
        bytes=page.stat().st_size,
        tabs=len(content.tabs),
        rows=entries,
        written=tuple(stale),
    )


def render(board: Board, documentation: str = "") -> str:
    """Return the page of a board."""
    import jinja2
    import vl_convert

    from .charts import COLOURS, cost_chart, curve_chart, with_config

    files = resources.files(__package__) / "page"
    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["number"] = format_number
    charts: dict[str, Any] = {}
    tables = []
    for tab in board.tabs:
        charts[f"panel-{tab.id}"] = with_config(cost_chart(tab, is_large=False))
        charts[f"cost-{tab.id}"] = with_config(cost_chart(tab, is_large=True))
        curves = curve_chart(tab)
        if curves is not None:
            charts[f"curves-{tab.id}"] = with_config(curves)
        tables.append(_table_of(tab))
    sizes: dict[str, list[Tab]] = {}
    for tab in sorted(board.tabs, key=lambda tab: tab.size.name == "full"):
        sizes.setdefault(tab.size.name, []).append(tab)
    template = environment.from_string((files / "page.html").read_text("utf-8"))
    return template.render(
        board=board,
        sizes=sizes,
        tables=tables,
        conclusion=conclude(board),
        goal=describe_goal,
        colours=COLOURS,
        metrics=METRICS,
        documentation=documentation,
        style=(files / "page.css").read_text("utf-8"),
        script=(files / "page.js").read_text("utf-8"),
        vega=vl_convert.javascript_bundle(VEGA_EMBED),
        # "<" would let a text of strangers end the element that holds the JSON
        charts=json.dumps(charts).replace("<", "\\u003c"),
    )


def _table_of(tab: Tab) -> dict[str, Any]:
    """Return what the template needs of the table of a tab."""
    columns = columns_of(tab.rows)
    best = {column.key: best_of(column, tab.rows) for column in columns}
    lines = []
    for row in tab.rows:
        cells = []
        for column in columns:
            cell = column.read(row)
            order = "" if math.isnan(cell.order) else repr(cell.order)
            cells.append((column, cell, order, row.id in best[column.key]))
        lines.append((row, cells))
    groups = dict.fromkeys(column.group for column in columns if column.group)
    return {"tab": tab, "columns": columns, "lines": lines, "groups": list(groups)}


def describe_goal(tab: Tab) -> str:
    """Return the corners of the classical side: a network pays below one of them."""
    corners = []
    for row in tab.hull:
        milliseconds = format_number(1e3 * row.seconds)
        corners.append(f"{format_number(row.error)} in {milliseconds} ms")
    return ", ".join(corners)
