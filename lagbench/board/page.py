"""The page of the leaderboard: one HTML file that asks nothing of the network.

All text and every number of the tables is plain HTML; a script of our own sorts,
filters and draws. A content security policy lets only that script and style sheet run,
by their hashes, so that text of strangers could do nothing even if it were not escaped.
Equal boards give equal bytes.
"""

from __future__ import annotations

import base64
import bisect
import functools
import hashlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
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

from .columns import columns_of, presets_of, value_of, written
from .cost import cost_figure
from .model import Board, Row, Tab
from .payload import FINENESS, Fineness, embedded, payload
from .table import EXPLAINED, draw_table

# bytes that an entry shall take, all in all; more only where its coarsest data need
# them
BUDGET = 40_000
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
"""What the page leads to, from the leaderboard's folder; what is not there is left out.
"""

FOOT = (
    "Velocity and vorticity are per frame; lengths are in units of the box. Times are "
    "of each entry's own"
    " machine.",
    "This page is one file, built by lagbench leaderboard build from the score files, "
    "and asks nothing of the"
    " network. How to cite a data set: lagbench cite.",
)


def render(board: Board, links: Mapping[str, str] = LINKS) -> str:
    """Return the page."""
    theme = _part("theme.js")
    parts = "\n".join(_part(f"{name}.js") for name in SCRIPTS)
    script = f'(() => {{\n"use strict";\n{parts}}})();\n'
    # colours by choice of the reader are those of the two schemes once more
    light = f"color-scheme:light;{format_variables(LIGHT)}"
    dark = f"color-scheme:dark;{format_variables(DARK)}"
    chosen = f":root[data-theme=light]{{{light}}}\n:root[data-theme=dark]{{{dark}}}\n"
    style = load_style_sheet() + chosen + _part("page.css")
    allowed = " ".join(_source(one) for one in (theme, script))
    held = {
        "policy": f"default-src 'none'; script-src {allowed}; style-src "
        f"{_source(style)}; img-src data:;"
        " base-uri 'none'; form-action 'none'",
        "style": style,
        "theme": theme,
        "script": script,
        "links": join(
            tag("a", label, href=address) for label, address in links.items()
        ),
        "lede": lede(board),
        "stage": stage(board),
        "navigation": navigation(board),
        "sections": join(
            [overview(board), *(section(tab, board.metrics) for tab in board.tabs)],
            "\n",
        ),
        "empty": empty(board),
        "foot": join(tag("p", line) for line in FOOT),
    }
    entries = sum(len(tab.rows) for tab in board.tabs)
    room = BUDGET * max(FEWEST, entries) - sum(
        len(one.encode()) for one in held.values()
    )

    drawn = functools.cache(lambda fineness: embedded(payload(board, fineness)))

    def fits(fineness: Fineness) -> bool:
        return len(drawn(fineness).encode()) <= room

    # the finest data that take no more room, else the coarsest; mostly it is the finest
    # of all
    if fits(FINENESS[0]):
        first = 0
    else:
        first = 1 + bisect.bisect_left(FINENESS[1:-1], True, key=fits)
    held["payload"] = drawn(FINENESS[first])
    # one pass: what is filled in is not looked at again
    return re.sub(r"\{\{([a-z]+)\}\}", lambda found: held[found[1]], _part("page.html"))


@functools.cache
def _part(name: str) -> str:
    return files(__package__).joinpath("page", name).read_text("utf-8")


def _source(said: str) -> str:
    return (
        f"'sha256-{base64.b64encode(hashlib.sha256(said.encode()).digest()).decode()}'"
    )


def lede(board: Board) -> Markup:
    """Return the sentence under the title."""
    rows = [row for tab in board.tabs for row in tab.rows]
    entries = len(rows)
    many = len(board.tabs)
    checked = sum(row.verified is not None for row in rows)
    shown = f"{entries} {'entry' if entries == 1 else 'entries'} on {many} data set{'s' * (many != 1)}"
    if checked:
        told = f"those of {checked}"
    else:
        told = "none yet"
    return escaped(
        "Neural surrogates of Lagrangian continuum simulators on data that anyone "
        "regenerates bit for bit:"
        f" {shown}. Every score follows from a score file; predictions that the "
        f"maintainers scored again:"
        f" {told}. Costs are self-reported."
    )


def stage(board: Board) -> Markup:
    """Return the place of the film above the fold, which the script fills."""
    if not board.tabs:
        return Markup("")
    return tag(
        "figure",
        id="stage",
        class_="scripted",
        aria_label="The truth beside the leader",
    )


def navigation(board: Board) -> Markup:
    """Return links to the overview and the tabs, grouped by split."""
    if not board.tabs:
        return Markup("")
    groups = [
        tag(
            "div",
            _link("overview", "Overview", "Overview of all splits"),
            class_="group",
        )
    ]
    for split, tabs in groupby(board.tabs, key=lambda tab: tab.size.split):
        links = [
            _link(tab.id, tab.size.name, f"{split} {tab.size.name}") for tab in tabs
        ]
        groups.append(
            tag("div", tag("span", split, class_="split"), *links, class_="group")
        )
    return tag("nav", *groups, class_="tabs", aria_label="Data sets")


def _link(name: str, label: str, said: str) -> Markup:
    return tag("a", label, href=f"#{name}", data_tab=name, aria_label=said)


def empty(board: Board) -> Markup:
    """Name the data sets without an entry, with the commands that begin one."""
    if not board.empty:
        return Markup("")
    split, size = board.empty[0]
    names = ", ".join(map(" ".join, board.empty))
    commands = f"lagbench generate --split {split} --size {size}\n"
    commands += "lagbench submit predictions.nc --from meta.yaml"
    if board.tabs:
        first = "No entry yet"
    else:
        first = "There are no entries yet"
    return tag(
        "section",
        tag("p", f"{first}: {names}. Yours can be the first:"),
        tag("pre", tag("code", commands)),
        class_="empty",
    )


def overview(board: Board) -> Markup:
    """Return one row per method over all splits, by mean skill: its skill where that is
    known, and rank.
    """
    if not board.tabs:
        return Markup("")
    rows: dict[str, dict[str, Row]] = {}
    for tab in board.tabs:
        for row in tab.rows:
            if row.rank is not None:
                rows.setdefault(row.id, {})[tab.id] = row
    ranked = {
        tab.id: sum(row.rank is not None for row in tab.rows) for tab in board.tabs
    }
    skills = {
        method: [
            row.skill.mean
            for row in held.values()
            if row.skill and math.isfinite(row.skill.mean)
        ]
        for method, held in rows.items()
    }
    # a gap counts as the best floor, so that nobody leads by the one data set that
    # suits
    means = {method: sum(held) / len(board.tabs) for method, held in skills.items()}
    heads = [
        tag(
            "th",
            tag("a", f"{tab.size.split} {tab.size.name}", href=f"#{tab.id}"),
            scope="col",
        )
        for tab in board.tabs
    ]
    lines = []
    for method in sorted(
        rows, key=lambda method: (not skills[method], -means[method], method)
    ):
        name = next(iter(rows[method].values())).entry.name
        cells = [
            _summary(rows[method].get(tab.id), tab, ranked[tab.id])
            for tab in board.tabs
        ]
        head = tag("th", clipped(name, 60), scope="row", class_="method")
        mean = tag(
            "span", text(means[method] if skills[method] else math.nan), class_="n"
        )
        of = tag("span", f"{len(skills[method])} of {len(board.tabs)}", class_="ci")
        lines.append(tag("tr", head, tag("td", mean, of), *cells))
    caption = (
        "Skill on every data set (0: the best floor, 1: perfect) where it is known, "
        "and rank; bold leads."
        " Methods stand in the order of their mean skill, in which a gap counts 0."
    )
    first = [
        tag("th", "method", scope="col", class_="method"),
        tag("th", "mean skill", scope="col"),
    ]
    table = tag(
        "table",
        tag("caption", caption, class_="unseen"),
        tag("thead", tag("tr", *first, *heads)),
        tag("tbody", *lines),
        class_="board across",
    )
    return tag(
        "section",
        tag("h2", "All data sets"),
        tag("p", caption, class_="facts"),
        tag(
            "div",
            table,
            class_="scroll",
            role="region",
            aria_label="Overview",
            tabindex=0,
        ),
        id="overview",
        class_="tab",
    )


def _summary(row: Row | None, tab: Tab, of: int) -> Markup:
    if row is None:
        return tag("td", "")
    rank = f"{row.rank}{' ≈' if row.tied else ''} of {of}"
    big, small = (text(row.skill.mean), f"rank {rank}") if row.skill else (rank, "")
    parts = [
        tag("span", big, class_="n"),
        tag("span", small, class_="ci") if small else "",
    ]
    link = tag("a", *parts, href=f"#tab={tab.id}&entry={row.id}")
    return tag("td", link, class_="best" if row.rank == 1 else None)


def section(tab: Tab, metrics: Mapping[str, Metric]) -> Markup:
    """Return the section of a tab."""
    if metrics[tab.ranking].direction is Direction.HIGHER:
        better = "higher"
    else:
        better = "lower"
    if tab.size.measured:
        sha256 = tab.size.measured.dataset_sha256
    else:
        sha256 = tab.rows[0].entry.dataset.sha256
    facts = (
        f"Given {tab.size.task.input_frames} frames of each of {len(tab.scenarios)} "
        f"test scenarios of"
        f" {tab.size.particles} particles, predict the next {len(tab.frames)}. Ranked "
        f"by {words(tab.ranking)}"
        f" over the horizon, {better} is better. Data set version {tab.size.version}, "
        f"SHA-256 {sha256[:12]}…"
    )
    region: dict[str, object] = {
        "role": "region",
        "aria_label": "Scores",
        "tabindex": 0,
    }
    return tag(
        "section",
        tag("h2", f"{tab.title}, {tab.size.name}"),
        tag("p", facts, class_="facts"),
        tag("ul", *_tiles(tab, metrics), class_="tiles"),
        _tools(tab, presets_of(tab, columns_of(tab, metrics))),
        tag("div", draw_table(tab, metrics), class_="table scroll", **region),
        tag("div", *(tag("p", note) for note in _notes(tab)), class_="notes"),
        tag("div", cost_figure(tab), class_="figures"),
        id=tab.id,
        class_="tab",
    )


def _tiles(tab: Tab, metrics: Mapping[str, Metric]) -> Iterator[Markup]:
    ranked = [row for row in tab.rows if row.rank is not None]
    ranking = columns_of(tab, metrics)[tab.ranking]
    if ranked:
        leader = ranked[0]
        tied = sum(row.tied for row in ranked)
        who = clipped(leader.entry.name, 40) + (
            f", and {tied} that cannot be told from it" if tied else ""
        )
        if leader.skill:
            yield _tile("skill of the leader", text(leader.skill.mean), who)
        value = float(value_of(leader, ranking))
        yield _tile(f"leader by {ranking.quantity}", text(value), who)
        losses = [
            (ranking.loss(float(value_of(one, ranking))), one.name)
            for one in tab.floors
            if one.counts
        ]
        known = [held for held in losses if held[0] > 0.0]
        if known and metrics[tab.ranking].direction is Direction.LOWER:
            loss, best = min(known, key=lambda held: held[0])
            yield _tile(
                "leader beside the best floor", f"{text(value / loss, 2)}×", best
            )
    # who is fast and learned nothing is no example
    learned = [row for row in ranked if row.skill and row.skill.mean > 0.0]
    fast = [
        (cost.speed_up, row, cost.device)
        for row in learned
        if (cost := row.entry.cost) and cost.speed_up
    ]
    if fast:
        speed, row, device = max(fast, key=lambda held: held[0])
        beside = f"{'slower' if speed < 1.0 else 'faster'} than the solver"
        yield _tile(
            "speed of the fastest entry with skill, solver = 1×",
            written(speed, "factor"),
            f"{beside}: {clipped(row.entry.name, 40)}, {device}; self-reported",
        )
    rest = len(tab.rows) - len(ranked)
    yield _tile(
        "entries", str(len(ranked)), f"and {rest} not ranked" if rest else "all ranked"
    )


def _tile(what: str, big: str, more: str) -> Markup:
    parts = {"what": what, "big": big, "more": more}
    return tag("li", *(tag("span", part, class_=kind) for kind, part in parts.items()))


def _tools(tab: Tab, presets: Mapping[str, Sequence[str]]) -> Markup:
    hidden = sum(not row.active for row in tab.rows)
    buttons = [
        tag("button", name, type="button", data_preset=name, data_keys=" ".join(keys))
        for name, keys in presets.items()
    ]
    box = tag("input", type="checkbox")
    old = "Withdrawn, superseded, or scored on old data"
    inactive = tag("label", box, f"inactive ({hidden})", class_="check", title=old)
    hint = "Filter methods, authors, hardware"
    return tag(
        "div",
        tag(
            "input",
            type="search",
            placeholder=hint,
            aria_label="Filter",
            spellcheck="false",
        ),
        tag("div", *buttons, class_="presets", role="group", aria_label="Columns"),
        inactive if hidden else "",
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
        "Click a row for curves, maps, a film, every number and the command that "
        "makes it again."
        " Ranks follow the ranking metric."
    )
    told = "There are too few test scenarios to tell entries apart: the intervals speak alone."
    if tab.decided:
        told = (
            "≈ cannot be told from the leader at 5 %: two-way bootstrap over "
            "scenarios and seeds, with one"
            " seed each the exact sign-flip test over scenarios; p-values corrected "
            "by Holm's method."
        )
    yield escaped(
        f"{told} Shaded rows are floors: what costs no learning, never ranked."
    )
    yield escaped(
        "Mean over test scenarios and seeds; below it the 95 % interval, of both "
        "resampled together."
        " ↓ lower, ↑ higher, ◎ closer to the perfect value is better;"
        " bold is best, floors included, and the bluer a cell, the nearer to it."
        " † some frames have no value. – not measured or undefined."
    )
    yield escaped(
        "Times, speed-up, budget, parameters and hardware are self-reported: "
        "submitters say them and nobody"
        " computes them again. A speed-up below 1× means slower than the solver. "
        "Scores are verified where"
        " the maintainers scored the predictions again, else as submitted."
    )
    raised = {flag.name for row in tab.rows for flag in (*row.flags, *row.warnings)}
    for name in sorted(raised & EXPLAINED.keys()):
        label, meaning = EXPLAINED[name]
        yield join([tag("strong", label), ": ", meaning])
