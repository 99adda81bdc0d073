"""The page of the leaderboard: one HTML file that asks nothing of the network.

Jinja2 escapes all text, that of strangers too. All numbers of the tables are plain
HTML; a small script sorts, filters and shows one data set at a time. The charts are
Vega-Lite specifications (https://vega.github.io): Vega draws them in the page, which
has its code, and vl-convert writes them to files.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from lagbench.addresses import DOCUMENTATION
from lagbench.atomic import write_atomically
from lagbench.data.registry import Registry
from lagbench.design.tasks import FAMILIES
from lagbench.errors import ChecksFailedError, check_installed
from lagbench.metrics.table import METRICS

from .collect import collect
from .columns import SHOWN_METRICS, best_of, columns_of, format_number
from .design import DesignRow, conclude_design, read_design
from .entry import schema_bytes
from .folder import PAGE, SCHEMA, Folder
from .rows import Board, Tab, conclude

Spec = dict[str, Any]

VEGA_LITE = "https://vega.github.io/schema/vega-lite/v5.json"

COLOURS = {
    "learned": "#2a6fdb",
    "hybrid": "#8e4ec6",
    "calibrated": "#d9730d",
    "classical": "#6b7684",
    "naive": "#b4bac2",
}
"""Colour of each kind of row."""

TRUTH_COLOUR = "#c2255c"

SMALL = {"width": 190, "height": 130}  # a panel of the first picture [pixel]
LARGE = {"width": "container", "height": 320}

NAMED_ENTRIES = 3
"""Entries that have their names beside their dots, best first."""

CURVES = 5
"""Entries that have a curve over frames, best first."""

PANELS_IN_LINE = 4

CONFIG = {
    "view": {"stroke": None},
    "axis": {"domain": False, "labelFontSize": 11, "titleFontSize": 12},
    "title": {"fontSize": 12, "anchor": "start", "offset": 6},
    "font": "system-ui, sans-serif",
}

KIND_COLOUR = {
    "field": "kind",
    "type": "nominal",
    "legend": None,
    "scale": {"domain": list(COLOURS), "range": list(COLOURS.values())},
}

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
            :func:`.collect.collect`.
        UsageError: no leaderboard, or the extra ``plots`` is not installed.
        UnreadableFileError, DataError: see :func:`.collect.collect`.
    """
    check_installed("vl_convert", extra="plots")
    folder = Folder(board)
    content = collect(board, registry=registry, metrics=SHOWN_METRICS)
    files = {
        folder.path / PAGE: render(
            content, documentation, read_design(folder)
        ).encode(),
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
    rows = [row for tab in content.tabs for row in tab.rows]
    return BuildResult(
        page=folder.path / PAGE,
        bytes=(folder.path / PAGE).stat().st_size,
        tabs=len(content.tabs),
        rows=sum(row.entry is not None for row in rows),
        written=tuple(stale),
    )


def render(
    board: Board, documentation: str = "", design: Sequence[DesignRow] = ()
) -> str:
    """Return the page of a board, and of the rows of the design track."""
    import jinja2
    import vl_convert

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
        groups = list(dict.fromkeys(one.group for one in columns if one.group))
        tables.append(
            {"tab": tab, "columns": columns, "lines": lines, "groups": groups}
        )
    for family in FAMILIES:
        design_rows = [row for row in design if row.family == family]
        if design_rows:
            charts[f"design-{family}"] = with_config(design_chart(design_rows))
    sizes: dict[str, list[Tab]] = {}
    for tab in sorted(board.tabs, key=lambda tab: tab.size.name == "full"):
        sizes.setdefault(tab.size.name, []).append(tab)
    template = environment.from_string((files / "page.html").read_text("utf-8"))
    return template.render(
        board=board,
        sizes=sizes,
        tables=tables,
        conclusion=conclude(board),
        design_conclusion=conclude_design(design),
        design=design,
        families=FAMILIES,
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


def describe_goal(tab: Tab) -> str:
    """Return the corners of the classical side: the cheapest first."""
    corners = []
    for row in tab.hull:
        milliseconds = format_number(1e3 * row.seconds)
        corners.append(f"{format_number(row.error)} in {milliseconds} ms")
    return ", ".join(corners)


def cost_chart(tab: Tab, *, is_large: bool) -> Spec:
    """Return error against cost: a dot per row, the hull of the classical side.

    A dashed line shows the truth error: differences below it mean nothing.

    Args:
        tab: the data set.
        is_large: whether axes have titles, and rows their names.
    """
    rows = []
    for row in tab.rows:
        if row.seconds and 0.0 < row.score.mean < math.inf:  # axes are logarithmic
            rows.append(row)
    entries = [row.id for row in rows if row.entry is not None]
    named = {corner.name for corner in tab.hull} | set(entries[:NAMED_ENTRIES])
    points: list[dict[str, Any]] = []
    for row in rows:
        point: dict[str, Any] = {
            "method": row.name,
            "kind": str(row.kind),
            "ms": 1e3 * float(row.seconds or 0.0),
            "error": float(f"{row.score.mean:.6g}"),
            "label": row.name if row.id in named else "",
        }
        if row.speedup is not None:
            point["speedup"] = str(row.speedup)
        points.append(point)
    costs = [point["ms"] for point in points]
    errors = [point["error"] for point in points]
    if tab.truth_error:
        errors.append(tab.truth_error)

    ticks = 5 if is_large else 3
    x = _log_axis("ms", costs, ticks=ticks, room=4.0 if is_large else 1.5)
    y = _log_axis("error", errors, ticks=ticks, room=1.2)
    if is_large:
        x["title"] = "processor time of a frame [ms]"
        y["title"] = f"error ({tab.ranking.replace('_', ' ')})"
    layers: list[Spec] = []
    if tab.truth_error:
        layers.append(
            {
                "data": {"values": [{"error": tab.truth_error}]},
                "mark": {"type": "rule", "color": TRUTH_COLOUR, "strokeDash": [4, 3]},
                "encoding": {"y": y},
            }
        )
    if tab.hull:
        # upright above its first corner, level beyond its last
        corners = [(1e3 * row.seconds, row.error) for row in tab.hull]
        corners.insert(0, (corners[0][0], 2.0 * max(errors)))
        corners.append((100.0 * max(costs), corners[-1][1]))
        line = [
            {"ms": milliseconds, "error": error, "order": order}
            for order, (milliseconds, error) in enumerate(corners)
        ]
        layers.append(
            {
                "data": {"values": line},
                "mark": {"type": "line", "color": COLOURS["classical"], "clip": True},
                "encoding": {"x": x, "y": y, "order": {"field": "order"}},
            }
        )
    tooltip = [{"field": name} for name in ("method", "kind", "error", "ms", "speedup")]
    layers.append(
        {
            "mark": {
                "type": "circle",
                "opacity": 1,
                "size": 80 if is_large else 36,
                "stroke": "white",
                "strokeWidth": 0.6,
            },
            "encoding": {"x": x, "y": y, "color": KIND_COLOUR, "tooltip": tooltip},
        }
    )
    if is_large:
        layers.append(
            {
                "mark": {"type": "text", "align": "left", "dx": 6, "dy": -7},
                "encoding": {"x": x, "y": y, "text": {"field": "label"}},
            }
        )
    chart: Spec = {"data": {"values": points}, "layer": layers}
    if is_large:
        return chart | LARGE
    return chart | SMALL | {"title": tab.name}


def _log_axis(name: str, values: Sequence[float], *, ticks: int, room: float) -> Spec:
    """Return the encoding of a logarithmic axis with some room beyond the values."""
    domain = [0.1, 1.0]
    if values:
        domain = [min(values) / 1.3, max(values) * 1.3 * room]
    return {
        "field": name,
        "type": "quantitative",
        "title": None,
        "scale": {"type": "log", "domain": domain, "nice": False},
        "axis": {"tickCount": ticks, "format": "~g"},
    }


def curve_chart(tab: Tab) -> Spec | None:
    """Return the ranking metric over frames; None where it has no value per frame.

    It has the first entries, the best classical and the best naive row.
    """
    chosen = [row for row in tab.rows if row.entry is not None][:CURVES]
    for is_classical in (True, False):
        for row in tab.rows:
            if row.entry is None and row.kind.is_on_classical_side is is_classical:
                chosen.append(row)
                break
    points: list[dict[str, Any]] = []
    names = []
    for row in chosen:
        if row.curve is None:
            continue
        names.append(row.name)
        for frame, value in zip(row.curve.frames, row.curve.mean.tolist(), strict=True):
            if value > 0.0:
                error = float(f"{value:.4g}")
                points.append({"frame": frame, "error": error, "method": row.name})
    if not points:
        return None
    y = _log_axis("error", [point["error"] for point in points], ticks=5, room=1.0)
    return LARGE | {
        "data": {"values": points},
        "mark": {"type": "line", "strokeWidth": 1.8},
        "encoding": {
            "x": {"field": "frame", "type": "quantitative", "scale": {"zero": False}},
            "y": y | {"title": tab.ranking.replace("_", " ")},
            "color": {
                "field": "method",
                "type": "nominal",
                "sort": names,
                "legend": {"orient": "bottom", "columns": 2, "title": None},
            },
            "tooltip": [{"field": name} for name in ("method", "frame", "error")],
        },
    }


def design_chart(rows: Sequence[DesignRow]) -> Spec:
    """Return the score that searches reach against their time, with intervals."""
    points: list[dict[str, Any]] = []
    for row in rows:
        low, high = row.interval
        point = {"method": row.method, "runs": row.budget, "score": row.score}
        if not math.isnan(low):
            point |= {"low": low, "high": high}
        points.append(point)
    x = {
        "field": "runs",
        "type": "quantitative",
        "title": "time of the search [simulator runs]",
        "scale": {"type": "log"},
        "axis": {"values": sorted({row.budget for row in rows})},
    }
    colour = {
        "field": "method",
        "type": "nominal",
        "legend": {"orient": "bottom", "columns": 2, "title": None},
    }
    y = {"field": "score", "type": "quantitative", "title": "score"}
    bar = {
        "x": x,
        "y": {"field": "low", "type": "quantitative"},
        "y2": {"field": "high"},
    }
    return LARGE | {
        "data": {"values": points},
        "layer": [
            {"mark": "rule", "encoding": bar | {"color": colour}},
            {
                "mark": {"type": "line", "point": True},
                "encoding": {"x": x, "y": y, "color": colour},
            },
        ],
    }


def with_config(chart: Mapping[str, Any]) -> Spec:
    """Return a whole specification, which Vega-Lite draws on the colour behind it."""
    return {"$schema": VEGA_LITE, "background": None, "config": CONFIG, **chart}


def write_picture(board: Board, path: Path) -> None:
    """Write the first picture of the page: a small panel for each data set.

    Args:
        board: the board.
        path: the file to write, which ends in .svg or .png.
    """
    import vl_convert

    panels: list[Spec] = [cost_chart(tab, is_large=False) for tab in board.tabs]
    kinds = [{"kind": name} for name in COLOURS]
    key = {
        "title": "kinds",
        "data": {"values": kinds},
        "mark": {"type": "circle", "size": 60, "opacity": 1},
        "encoding": {
            "y": {"field": "kind", "title": None, "sort": list(COLOURS)},
            "color": KIND_COLOUR,
        },
    }
    picture = with_config(
        {
            "title": "error against processor time of a frame [ms]; the line is the "
            "classical side",
            "concat": [*panels, key],
            "columns": PANELS_IN_LINE,
            "background": "white",
        }
    )
    text = json.dumps(picture)
    if path.suffix.lower() == ".png":
        data = vl_convert.vegalite_to_png(text, scale=2)
    else:
        data = vl_convert.vegalite_to_svg(text).encode()
    write_atomically(path, data, option="--output")
