"""What the page holds as plain HTML: tabs, facts, tables of the main scores, notes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from types import MappingProxyType

from lagbench.metrics import Direction, Metric
from lagbench.report.html import Markup, escaped, interval, join, tag, text, words

from .columns import COSTS, Column, metric_column, presets_of, value_of, written
from .embedding import clean
from .model import Board, Row, Tab
from .packing import rounded
from .payload import MEAN_DIGITS, tab_id

__all__ = ["EXPLAINED", "lede", "navigation", "sections"]

EXPLAINED: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "copy_suspect": (
            "copy suspected",
            "The error moves from frame to frame as that of no rollout does.",
        ),
        "below_twin_floor": (
            "closer than a twin",
            "Closer to the truth than the solver itself after a nudge of 2⁻²⁰.",
        ),
        "physics": ("unphysical", "Kinetic energy or filled area are far from the truth's."),
        "in_domain": (
            "leaves the box",
            "Predicted particles lie outside the box; there they carry no weight on the grid.",
        ),
        "max_displacement": (
            "jumps",
            "Predicted particles move farther in a frame than any of the truth.",
        ),
    }
)
"""What flags and warnings are called on the page, which shows what is wrong, and what they mean."""

ARROWS = {Direction.LOWER: "↓", Direction.HIGHER: "↑", Direction.TARGET: "◎", Direction.NONE: ""}


REPORTED_MARK = "self\u2011reported"
"""Stands in the heading of what nothing can compute again."""


def lede(board: Board) -> Markup:
    """Return the sentence under the title."""
    entries = sum(not row.floor for tab in board.tabs for row in tab.rows)
    return escaped(
        "Neural surrogates of Lagrangian continuum simulators on data that anyone regenerates bit for bit:"
        f" {_counted(entries, 'entry', 'entries')} on {_counted(len(board.tabs), 'data set', 'data sets')}."
        " Every score follows from a score file; costs are self-reported."
    )


def _counted(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


def navigation(board: Board) -> Markup:
    """Return links to the tabs, grouped by split."""
    groups = []
    for split, tabs in groupby(board.tabs, key=lambda tab: tab.split):
        links = [_link(tab) for tab in tabs]
        groups.append(tag("div", tag("span", split, class_="split"), *links, class_="group"))
    return tag("nav", *groups, class_="tabs", aria_label="Data sets") if groups else Markup("")


def _link(tab: Tab) -> Markup:
    name = tab_id(tab)
    return tag(
        "a",
        tab.size,
        href=f"#{name}",
        data_tab=name,
        aria_label=f"{tab.split} {tab.size}",
    )


def sections(board: Board) -> Markup:
    """Return one section per tab."""
    if not board.tabs:
        return tag("p", "There are no entries yet.", class_="notice")
    return join((_section(tab, board.metrics) for tab in board.tabs), "\n")


def _section(tab: Tab, metrics: Mapping[str, Metric]) -> Markup:
    name = tab_id(tab)
    return tag(
        "section",
        tag("h2", f"{tab.title}, {tab.size}"),
        tag("p", _facts(tab, metrics), class_="facts"),
        tag("ul", *_tiles(tab, metrics), class_="tiles"),
        tag("div", class_="tools"),
        tag(
            "div", _table(tab, metrics), class_="table scroll", role="region", aria_label="Scores", tabindex=0
        ),
        tag("div", *(tag("p", note) for note in _notes(tab)), class_="notes"),
        tag("div", class_="figures"),
        id=name,
        class_="tab",
    )


def _facts(tab: Tab, metrics: Mapping[str, Metric]) -> str:
    better = "higher" if metrics[tab.ranking].direction is Direction.HIGHER else "lower"
    return (
        f"Given {tab.input_frames} frames of each of {len(tab.scenarios)} test scenarios of {tab.particles}"
        f" particles, predict the next {len(tab.frames)}. Ranked by {words(tab.ranking)} over the horizon,"
        f" {better} is better. Data set version {tab.dataset_version}, SHA-256 {tab.dataset_sha256[:12]}…"
    )


def _tiles(tab: Tab, metrics: Mapping[str, Metric]) -> Iterator[Markup]:
    entries = [row for row in tab.rows if not row.floor]
    ranked = [row for row in entries if row.rank is not None]
    if ranked:
        yield from _leader_tiles(tab, ranked, metrics[tab.ranking])
    fast = [(row.cost.speed_up, row) for row in ranked if row.cost is not None and row.cost.speed_up]
    if fast:
        speed, row = max(fast, key=lambda pair: pair[0])
        beside = "slower" if speed < 1.0 else "faster"
        device = f", {row.cost.device}" if row.cost else ""
        yield _tile(
            "speed of the fastest entry, solver = 1×",
            written(speed, "factor"),
            f"{beside} than the solver: {_short(row)}{device}; self-reported",
        )
    rest = len(entries) - len(ranked)
    yield _tile("entries", str(len(ranked)), f"and {rest} not ranked" if rest else "all ranked")


def _leader_tiles(tab: Tab, ranked: Sequence[Row], metric: Metric) -> Iterator[Markup]:
    leader = ranked[0]
    value = leader.values[tab.ranking].mean
    beside = sum(row.rank == leader.rank for row in ranked) - 1
    more = f", and {beside} that cannot be told from it" if beside else ""
    yield _tile(f"leader by {_quantity(metric_column(metric))}", text(value), f"{_short(leader)}{more}")
    floors = [row for row in tab.rows if row.floor and not math.isnan(row.values[tab.ranking].mean)]
    if floors and metric.direction is Direction.LOWER:
        floor = min(floors, key=lambda row: row.values[tab.ranking].mean)
        below = floor.values[tab.ranking].mean
        if below > 0.0:
            yield _tile("leader beside the better floor", f"{text(value / below, 2)}×", floor.name)


def _short(row: Row) -> str:
    return clean(row.name, 40)


def _tile(what: str, big: str, more: str) -> Markup:
    parts = {"what": what, "big": big, "more": more}
    return tag("li", *(tag("span", part, class_=kind) for kind, part in parts.items()))


def _quantity(column: Column) -> str:
    return f"{column.label} [{column.unit}]" if column.unit else column.label


def _table(tab: Tab, metrics: Mapping[str, Metric]) -> Markup:
    known = {column.key: column for column in (*map(metric_column, metrics.values()), *COSTS)}
    columns = [known[key] for key in presets_of(tab, metrics)["main"]]
    entries = [row for row in tab.rows if not row.floor and row.status == "active" and row.current]
    floors = [row for row in tab.rows if row.floor]
    head = [
        tag("th", "#", scope="col", class_="rank"),
        tag("th", "method", scope="col", class_="method"),
        *(_heading(column) for column in columns),
    ]
    return tag(
        "table",
        tag("caption", f"{tab.split} {tab.size}: methods and scores", class_="unseen"),
        tag("thead", tag("tr", *head)),
        tag("tbody", *(_row(row, columns, tab) for row in floors), class_="floors"),
        tag("tbody", *(_row(row, columns, tab) for row in entries), class_="entries"),
        class_="board",
    )


def _heading(column: Column) -> Markup:
    unit = f"{column.unit} {ARROWS[column.direction]}".strip()
    parts = [
        tag("span", column.label, class_="metric"),
        tag("span", unit, class_="unit") if unit else "",
        tag("span", REPORTED_MARK, class_="unit") if column.reported else "",
    ]
    return tag("th", *parts, scope="col", title=column.meaning)


def _row(row: Row, columns: Sequence[Column], tab: Tab) -> Markup:
    rank = "" if row.rank is None else f"{'=' if row.shared else ''}{row.rank}"
    chips = [
        *(_chip(flag.name, "flag bad") for flag in row.flags),
        *(_chip(flag.name, "flag warn") for flag in row.warnings),
    ]
    by = clean(" · ".join(filter(None, (", ".join(row.authors), row.affiliation))))
    method = tag(
        "th",
        tag("span", clean(row.name), class_="name"),
        *chips,
        tag(
            "span", clean("floor, computed by the scorer" if row.floor else by), class_="sub", title=clean(by)
        ),
        scope="row",
        class_="method",
    )
    cells = [_cell(row, column, ranks=column.key == tab.ranking) for column in columns]
    return tag("tr", tag("td", rank, class_="rank"), method, *cells, class_="floor" if row.floor else None)


def _chip(name: str, kind: str) -> Markup:
    label, meaning = EXPLAINED.get(name, (clean(name).replace("_", " "), None))
    return tag("span", label, class_=kind, title=meaning)


def _cell(row: Row, column: Column, *, ranks: bool) -> Markup:
    # the digits that the script has, so that it writes the same text
    held = value_of(row, column.key)
    shown = written(held if isinstance(held, str) else rounded(held, MEAN_DIGITS), column.form)
    said = tag("span", clean(shown), class_="n")
    value = row.values.get(column.key)
    return tag("td", said, interval((value.low, value.high)) if ranks and value else "")


def _notes(tab: Tab) -> Iterator[Markup]:
    yield escaped(
        "Mean over test scenarios and seeds; below it the 95 % bootstrap interval over scenarios."
        " ↓ lower, ↑ higher, ◎ closer to the perfect value is better;"
        " bold is best, and the bluer a cell, the nearer to it."
        " † some frames have no value. – not measured or undefined."
    )
    if tab.decided:
        test = (
            "Entries that the exact sign-flip test over scenarios cannot tell from the leader share its rank."
        )
    else:
        test = (
            "There are too few test scenarios for a claim: all share a rank, and the intervals speak alone."
        )
    yield escaped(f"{test} Grey rows are floors that cost nothing.")
    yield escaped(
        "Times, speed-up, parameters and hardware are self-reported: submitters say them and nobody computes"
        " them again. A speed-up below 1× means slower than the solver."
    )
    raised = {flag.name for row in tab.rows for flag in (*row.flags, *row.warnings)}
    for name in sorted(raised & EXPLAINED.keys()):
        label, meaning = EXPLAINED[name]
        yield join([tag("strong", label), ": ", meaning])
