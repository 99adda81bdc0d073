"""The page of the leaderboard: one HTML file that asks nothing of the network.

All text and every number of the tables is plain HTML; a script of ours sorts, filters
and draws from data that stand in the page. A content security policy lets only that
script and style sheet run, by their hashes, so that text of strangers could do nothing
even if it were not escaped. Equal boards give pages with equal content.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import groupby

from lagbench.figures.colours import DARK, LIGHT, format_variables
from lagbench.figures.html import (
    Markup,
    clipped,
    escaped,
    join,
    load_style_sheet,
    tag,
    text,
    words,
)
from lagbench.metrics.metric import Direction, Metric

from .columns import format_value, leader_of, value_of
from .cost import cost_figure
from .encoding import decode, encode
from .model import Board, BoardRow, Tab
from .page_data import page_data
from .table import draw_table
from .table_view import LABELS, TableView, make_table

SCRIPTS = (
    "data",
    "text",
    "scale",
    "chart",
    "state",
    "table",
    "overview",
    "maps",
    "film",
    "hero",
    "detail",
    "main",
)
"""Parts of the script, in this order."""

LINKS: Mapping[str, str] = {
    "Repository": "../README.md",
    "Documentation": "../docs/index.md",
    "How to submit": "../docs/submitting.md",
    "Citation": "../CITATION.cff",
}
"""Links of the page, from the leaderboard's folder; links to missing files are left
out.
"""

FOOT = (
    "Velocity and vorticity are per frame; lengths are in units of the box. Times are "
    "of each entry's own machine.",
    "This page is one file, built by lagbench leaderboard build from the score files, "
    "and asks nothing of the network. How to cite a data set: lagbench cite.",
)

DATA_ELEMENT = re.compile(
    rb'(<script type="text/plain" id="page-(?:data|arrays)">)([A-Za-z0-9+/=]*)(?=</)'
)
"""The elements that hold encoded data."""


def render(board: Board, links: Mapping[str, str] = LINKS) -> str:
    """Return the page."""
    theme = _read_part("theme.js")
    script = _script()
    style = _style_sheet()
    views = []
    for tab in board.tabs:
        views.append(make_table(tab, board.metrics))
    data, arrays = page_data(views)

    link_tags = []
    for label, address in links.items():
        link_tags.append(tag("a", label, href=address))
    sections = [draw_overview(board)]
    for view in views:
        sections.append(draw_section(view, board.metrics))
    foot = []
    for line in FOOT:
        foot.append(tag("p", line))
    parts = {
        "policy": _policy(scripts=(theme, script), style=style),
        "style": style,
        "theme": theme,
        "script": script,
        "links": join(link_tags),
        "intro": draw_intro(board),
        "hero": draw_hero(board),
        "navigation": draw_navigation(board),
        "sections": join(sections, "\n"),
        "empty": draw_empty(board),
        "foot": join(foot),
        "data": encode(data),
        "arrays": encode(arrays),
    }
    # one pass: a part that is filled in is not looked at again
    template = _read_part("page.html")
    return re.sub(r"\{\{([a-z]+)\}\}", lambda match: parts[match[1]], template)


def same_page(first: bytes, second: bytes) -> bool:
    """Tell whether two pages have the same content.

    Their compressed data may differ: zlib gives other bytes where it was built
    otherwise. The first page may be a stranger's: what it encodes is read only up to
    the length of the data in the second.
    """
    if first == second:
        return True
    first_parts = DATA_ELEMENT.split(first)
    second_parts = DATA_ELEMENT.split(second)
    if len(first_parts) != len(second_parts):
        return False
    for number, (a, b) in enumerate(zip(first_parts, second_parts, strict=True)):
        if a == b:
            continue
        # text, opening tag and data take turns
        is_data = number % 3 == 2
        if not is_data or not _encode_same(a.decode(), b.decode()):
            return False
    return True


def _encode_same(first: str, second: str) -> bool:
    expected = decode(second, longest=2**30)
    try:
        return decode(first, longest=len(expected)) == expected
    except ValueError:
        return False


def links_in(page: bytes) -> dict[str, str]:
    """Return those of our links that a page has."""
    links = {}
    for label, address in LINKS.items():
        if str(tag("a", label, href=address)).encode() in page:
            links[label] = address
    return links


@functools.cache
def _read_part(name: str) -> str:
    return files(__package__).joinpath("page", name).read_text("utf-8")


def _script() -> str:
    """Return the script: an asynchronous function, as data are decompressed first."""
    parts = [_read_part(f"{name}.js") for name in SCRIPTS]
    body = "\n".join(parts)
    return f'(async () => {{\n"use strict";\n{body}}})();\n'


def _style_sheet() -> str:
    """Return the rules of all pages, two schemes to choose from, and our rules."""
    light = f"color-scheme:light;{format_variables(LIGHT)}"
    dark = f"color-scheme:dark;{format_variables(DARK)}"
    schemes = f":root[data-theme=light]{{{light}}}\n:root[data-theme=dark]{{{dark}}}\n"
    return load_style_sheet() + schemes + _read_part("page.css")


def _policy(*, scripts: Sequence[str], style: str) -> str:
    script_sources = " ".join(_source_of(script) for script in scripts)
    return (
        f"default-src 'none'; script-src {script_sources}; "
        f"style-src {_source_of(style)}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def _source_of(content: str) -> str:
    digest = hashlib.sha256(content.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def draw_intro(board: Board) -> Markup:
    """Return the sentence under the title."""
    entry_count = 0
    verified_count = 0
    for tab in board.tabs:
        entry_count += len(tab.rows)
        verified_count += sum(row.verified is not None for row in tab.rows)
    entries = _count(entry_count, "entry", "entries")
    data_sets = _count(len(board.tabs), "data set", "data sets")
    rescored = "none yet"
    if verified_count:
        rescored = f"those of {verified_count}"
    return escaped(
        "Neural surrogates of Lagrangian continuum simulators on data that anyone "
        f"regenerates bit for bit: {entries} on {data_sets}. Every score follows from "
        "a score file; predictions that the maintainers scored again: "
        f"{rescored}. Costs are self-reported."
    )


def _count(count: int, singular: str, plural: str) -> str:
    if count == 1:
        return f"1 {singular}"
    return f"{count} {plural}"


def draw_hero(board: Board) -> Markup:
    """Return the place of the film above the fold, which the script fills."""
    if not board.tabs:
        return Markup("")
    return tag(
        "figure",
        id="hero",
        class_="scripted",
        aria_label="The truth beside the leader",
    )


def draw_navigation(board: Board) -> Markup:
    """Return links to the overview and the tabs, grouped by split."""
    if not board.tabs:
        return Markup("")
    overview = _tab_link("overview", "Overview", "Overview of all splits")
    groups = [tag("div", overview, class_="group")]
    for split, tabs in groupby(board.tabs, key=lambda tab: tab.size.split):
        links = []
        for tab in tabs:
            name = tab.size.name
            links.append(_tab_link(tab.id, name, f"{split} {name}"))
        heading = tag("span", split, class_="split")
        groups.append(tag("div", heading, *links, class_="group"))
    return tag("nav", *groups, class_="tabs", aria_label="Data sets")


def _tab_link(name: str, label: str, description: str) -> Markup:
    return tag("a", label, href=f"#{name}", data_tab=name, aria_label=description)


def draw_empty(board: Board) -> Markup:
    """Return the names of data sets without an entry, and commands that begin one."""
    if not board.empty:
        return Markup("")
    split, size = board.empty[0]
    names = ", ".join(" ".join(data_set) for data_set in board.empty)
    commands = (
        f"lagbench generate --split {split} --size {size}\n"
        "lagbench submit predictions.nc --from meta.yaml"
    )
    beginning = "There are no entries yet"
    if board.tabs:
        beginning = "No entry yet"
    return tag(
        "section",
        tag("p", f"{beginning}: {names}. Yours can be the first:"),
        tag("pre", tag("code", commands)),
        class_="empty",
    )


@dataclass(frozen=True)
class MethodOverview:
    """A method on all data sets."""

    method: str
    rows: Mapping[str, BoardRow]  # ranked rows, by id of the tab
    skills: Sequence[float]
    # A data set without an entry counts 0, so that nobody leads by the one data set
    # that suits.
    mean_skill: float

    @property
    def name(self) -> str:
        """Name of the method."""
        first_row = next(iter(self.rows.values()))
        return first_row.entry.name


def draw_overview(board: Board) -> Markup:
    """Return one row per method over all splits, by mean skill."""
    if not board.tabs:
        return Markup("")
    headings = [
        tag("th", "method", scope="col", class_="method"),
        tag("th", "mean skill", scope="col"),
    ]
    for tab in board.tabs:
        link = tag("a", f"{tab.size.split} {tab.size.name}", href=f"#{tab.id}")
        headings.append(tag("th", link, scope="col"))
    lines = []
    for method in _order_methods(board):
        lines.append(_overview_line(method, board))
    caption = (
        "Skill on every data set (0: the best naive baseline, 1: perfect) where it is "
        "known, and rank; bold leads. Methods stand in the order of their mean skill, "
        "in which a data set without an entry counts 0."
    )
    table = tag(
        "table",
        tag("caption", caption, class_="unseen"),
        tag("thead", tag("tr", *headings)),
        tag("tbody", *lines),
        class_="board across",
    )
    region = tag(
        "div",
        table,
        class_="scroll",
        role="region",
        aria_label="Overview",
        tabindex=0,
    )
    return tag(
        "section",
        tag("h2", "All data sets"),
        tag("p", caption, class_="facts"),
        region,
        id="overview",
        class_="tab",
    )


def _order_methods(board: Board) -> list[MethodOverview]:
    """Return the ranked methods, by mean skill; methods without any come last."""
    rows_by_method: dict[str, dict[str, BoardRow]] = {}
    for tab in board.tabs:
        for row in tab.rows:
            if row.rank is not None:
                rows_by_method.setdefault(row.id, {})[tab.id] = row

    methods = []
    for method, rows in rows_by_method.items():
        skills = []
        for row in rows.values():
            if row.skill is not None and math.isfinite(row.skill.mean):
                skills.append(row.skill.mean)
        mean_skill = sum(skills) / len(board.tabs)
        methods.append(MethodOverview(method, rows, skills, mean_skill))
    return sorted(methods, key=lambda m: (not m.skills, -m.mean_skill, m.method))


def _overview_line(method: MethodOverview, board: Board) -> Markup:
    mean_skill = math.nan
    if method.skills:
        mean_skill = method.mean_skill
    coverage = f"{len(method.skills)} of {len(board.tabs)}"
    cells = [
        tag("th", clipped(method.name, 60), scope="row", class_="method"),
        tag(
            "td",
            tag("span", text(mean_skill), class_="n"),
            tag("span", coverage, class_="ci"),
        ),
    ]
    for tab in board.tabs:
        cells.append(_overview_cell(method.rows.get(tab.id), tab))
    return tag("tr", *cells)


def _overview_cell(row: BoardRow | None, tab: Tab) -> Markup:
    if row is None:
        return tag("td", "")
    ranked_count = sum(other.rank is not None for other in tab.rows)
    rank = f"{row.rank} of {ranked_count}"
    if row.tied:
        rank = f"{row.rank} ≈ of {ranked_count}"
    if row.skill is None:
        parts = [tag("span", rank, class_="n")]
    else:
        parts = [
            tag("span", text(row.skill.mean), class_="n"),
            tag("span", f"rank {rank}", class_="ci"),
        ]
    link = tag("a", *parts, href=f"#tab={tab.id}&entry={row.id}")
    return tag("td", link, class_="best" if row.rank == 1 else None)


def draw_section(view: TableView, metrics: Mapping[str, Metric]) -> Markup:
    """Return the section of a tab."""
    tab = view.tab
    table = tag(
        "div",
        draw_table(view),
        class_="table scroll",
        role="region",
        aria_label="Scores",
        tabindex=0,
    )
    notes = []
    for note in _notes(tab):
        notes.append(tag("p", note))
    return tag(
        "section",
        tag("h2", f"{tab.title}, {tab.size.name}"),
        tag("p", _describe_task(tab, metrics), class_="facts"),
        tag("ul", *_tiles(view, metrics), class_="tiles"),
        _tools(view),
        table,
        tag("div", *notes, class_="notes"),
        tag("div", cost_figure(tab), class_="figures"),
        id=tab.id,
        class_="tab",
    )


def _describe_task(tab: Tab, metrics: Mapping[str, Metric]) -> str:
    size = tab.size
    better = "lower"
    if metrics[tab.ranking].direction is Direction.HIGHER:
        better = "higher"
    sha256 = tab.rows[0].entry.dataset.sha256
    if size.measured:
        sha256 = size.measured.dataset_sha256
    return (
        f"Given {size.task.input_frames} frames of each of {len(tab.scenarios)} test "
        f"scenarios of {size.particles} particles, predict the next "
        f"{len(tab.frames)}. Ranked by {words(tab.ranking)} over the horizon, {better} "
        f"is better. Data set version {size.version}, SHA-256 {sha256[:12]}…"
    )


def _tiles(view: TableView, metrics: Mapping[str, Metric]) -> Iterator[Markup]:
    tab = view.tab
    leader = leader_of(tab.rows)
    if leader is not None:
        yield from _leader_tiles(view, leader, metrics)
    yield from _speed_tiles(tab)
    ranked_count = sum(row.rank is not None for row in tab.rows)
    unranked_count = len(tab.rows) - ranked_count
    more = "all ranked"
    if unranked_count:
        more = f"and {unranked_count} not ranked"
    yield _tile("entries", str(ranked_count), more)


def _leader_tiles(
    view: TableView, leader: BoardRow, metrics: Mapping[str, Metric]
) -> Iterator[Markup]:
    tab = view.tab
    ranking = view.columns[tab.ranking]
    tied_count = sum(row.tied for row in tab.rows if row.rank is not None)
    name = clipped(leader.entry.name, 40)
    if tied_count:
        name += f", and {tied_count} that cannot be told from it"
    if leader.skill is not None:
        yield _tile("skill of the leader", text(leader.skill.mean), name)
    value = float(value_of(leader, ranking))
    yield _tile(f"leader by {ranking.quantity}", text(value), name)

    if leader.against_classical is not None and leader.solver is not None:
        ratio = f"{text(leader.against_classical.mean, 2)}×"
        label = "error of the leader beside the best classical solver of its cost"
        yield _tile(label, ratio, leader.solver)


def _speed_tiles(tab: Tab) -> Iterator[Markup]:
    """Yield the tile of the fastest entry with skill: speed alone is no example."""
    fastest = None
    greatest = 0.0
    for row in tab.rows:
        cost = row.entry.cost
        has_skill = row.skill is not None and row.skill.mean > 0.0
        if row.rank is None or not has_skill or cost is None or not cost.speed_up:
            continue
        if cost.speed_up > greatest:
            greatest = cost.speed_up
            fastest = row
    if fastest is None or fastest.entry.cost is None:
        return
    comparison = "faster than the solver"
    if greatest < 1.0:
        comparison = "slower than the solver"
    name = clipped(fastest.entry.name, 40)
    yield _tile(
        "speed of the fastest entry with skill, solver = 1×",
        format_value(greatest, "factor"),
        f"{comparison}: {name}, {fastest.entry.cost.device}; self-reported",
    )


def _tile(what: str, big: str, more: str) -> Markup:
    return tag(
        "li",
        tag("span", what, class_="what"),
        tag("span", big, class_="big"),
        tag("span", more, class_="more"),
    )


def _tools(view: TableView) -> Markup:
    """Return filter, presets, the switch for inactive entries, and the CSV button."""
    buttons = []
    for name in view.presets:
        buttons.append(tag("button", name, type="button", data_preset=name))
    inactive_count = sum(not row.active for row in view.tab.rows)
    inactive = Markup("")
    if inactive_count:
        inactive = tag(
            "label",
            tag("input", type="checkbox"),
            f"inactive ({inactive_count})",
            class_="check",
            title="Withdrawn, superseded, or scored on old data",
        )
    return tag(
        "div",
        tag(
            "input",
            type="search",
            placeholder="Filter methods, authors, hardware",
            aria_label="Filter",
            spellcheck="false",
        ),
        tag("div", *buttons, class_="presets", role="group", aria_label="Columns"),
        inactive,
        tag("span", class_="count muted", role="status"),
        tag(
            "button",
            "CSV",
            type="button",
            class_="plain csv",
            title="Save the table as it is shown",
        ),
        class_="tools",
    )


def _notes(tab: Tab) -> Iterator[Markup]:
    yield escaped(
        "Click a row for curves, maps, a film, every number and the command that makes "
        "it again. Ranks follow the ranking metric."
    )
    claim = (
        "There are too few test scenarios to tell entries apart: the intervals speak "
        "alone."
    )
    if tab.decided:
        claim = (
            "≈ cannot be told from the leader at 5 %: two-way bootstrap over scenarios "
            "and seeds, with one seed each the exact sign-flip test over scenarios; "
            "p-values corrected by Holm's method."
        )
    yield escaped(
        f"{claim} Shaded rows are reference predictors, never ranked: naive baselines, "
        "which predict without learning and without equations, and classical solvers."
    )
    yield escaped(
        "Mean over test scenarios and seeds; below it the 95 % interval, of both "
        "resampled together. ↓ lower, ↑ higher, ◎ closer to the perfect value is "
        "better; bold is best, reference predictors included, and the bluer a cell, "
        "the nearer to it. † some frames have no value. – not measured or undefined."
    )
    yield escaped(
        "Times, speed-up, budget, parameters and hardware are self-reported: "
        "submitters state them and nobody computes them again. A speed-up below 1× "
        "means slower than the solver. Scores are verified where the maintainers "
        "scored the predictions again, else as submitted."
    )
    raised: set[str] = set()
    for row in tab.rows:
        for flag in (*row.flags, *row.warnings):
            raised.add(flag.name)
    for name in sorted(raised.intersection(LABELS)):
        label, meaning = LABELS[name]
        yield join([tag("strong", label), ": ", meaning])
