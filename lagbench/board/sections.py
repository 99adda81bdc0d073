"""What the page holds as plain HTML beside the tables: overview, facts, tiles, tools, notes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby

from lagbench.metrics.metric import Direction, Metric
from lagbench.report.html import Markup, clipped, escaped, join, tag, text, words

from .columns import columns_of, presets_of, value_of, written
from .cost import cost_figure
from .model import Board, Row, Tab
from .table import EXPLAINED, draw_table


def lede(board: Board) -> Markup:
    """Return the sentence under the title."""
    rows = [row for tab in board.tabs for row in tab.rows]
    entries, many, checked = len(rows), len(board.tabs), sum(row.verified is not None for row in rows)
    shown = f"{entries} {'entry' if entries == 1 else 'entries'} on {many} data set{'s' * (many != 1)}"
    told = f"those of {checked}" if checked else "none yet"
    return escaped(
        "Neural surrogates of Lagrangian continuum simulators on data that anyone regenerates bit for bit:"
        f" {shown}. Every score follows from a score file; predictions that the maintainers scored again:"
        f" {told}. Costs are self-reported."
    )


def stage(board: Board) -> Markup:
    """Return the place of the film above the fold, which the script fills."""
    if not board.tabs:
        return Markup("")
    return tag("figure", id="stage", class_="scripted", aria_label="The truth beside the leader")


def navigation(board: Board) -> Markup:
    """Return links to the overview and the tabs, grouped by split."""
    if not board.tabs:
        return Markup("")
    groups = [tag("div", _link("overview", "Overview", "Overview of all splits"), class_="group")]
    for split, tabs in groupby(board.tabs, key=lambda tab: tab.size.split):
        links = [_link(tab.id, tab.size.name, f"{split} {tab.size.name}") for tab in tabs]
        groups.append(tag("div", tag("span", split, class_="split"), *links, class_="group"))
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
    first = "No entry yet" if board.tabs else "There are no entries yet"
    return tag(
        "section",
        tag("p", f"{first}: {names}. Yours can be the first:"),
        tag("pre", tag("code", commands)),
        class_="empty",
    )


def overview(board: Board) -> Markup:
    """Return one row per method over all splits, by mean skill: its skill where that is known, and rank."""
    if not board.tabs:
        return Markup("")
    rows: dict[str, dict[str, Row]] = {}
    for tab in board.tabs:
        for row in tab.rows:
            if row.rank is not None:
                rows.setdefault(row.id, {})[tab.id] = row
    ranked = {tab.id: sum(row.rank is not None for row in tab.rows) for tab in board.tabs}
    skills = {
        method: [row.skill.mean for row in held.values() if row.skill and math.isfinite(row.skill.mean)]
        for method, held in rows.items()
    }
    # a gap counts as the best floor, so that nobody leads by the one data set that suits
    means = {method: sum(held) / len(board.tabs) for method, held in skills.items()}
    heads = [
        tag("th", tag("a", f"{tab.size.split} {tab.size.name}", href=f"#{tab.id}"), scope="col")
        for tab in board.tabs
    ]
    lines = []
    for method in sorted(rows, key=lambda method: (not skills[method], -means[method], method)):
        name = next(iter(rows[method].values())).entry.name
        cells = [_summary(rows[method].get(tab.id), tab, ranked[tab.id]) for tab in board.tabs]
        head = tag("th", clipped(name, 60), scope="row", class_="method")
        mean = tag("span", text(means[method] if skills[method] else math.nan), class_="n")
        of = tag("span", f"{len(skills[method])} of {len(board.tabs)}", class_="ci")
        lines.append(tag("tr", head, tag("td", mean, of), *cells))
    caption = (
        "Skill on every data set (0: the best floor, 1: perfect) where it is known, and rank; bold leads."
        " Methods stand in the order of their mean skill, in which a gap counts 0."
    )
    first = [tag("th", "method", scope="col", class_="method"), tag("th", "mean skill", scope="col")]
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
        tag("div", table, class_="scroll", role="region", aria_label="Overview", tabindex=0),
        id="overview",
        class_="tab",
    )


def _summary(row: Row | None, tab: Tab, of: int) -> Markup:
    if row is None:
        return tag("td", "")
    rank = f"{row.rank}{' ≈' if row.tied else ''} of {of}"
    big, small = (text(row.skill.mean), f"rank {rank}") if row.skill else (rank, "")
    parts = [tag("span", big, class_="n"), tag("span", small, class_="ci") if small else ""]
    link = tag("a", *parts, href=f"#tab={tab.id}&entry={row.id}")
    return tag("td", link, class_="best" if row.rank == 1 else None)


def section(tab: Tab, metrics: Mapping[str, Metric]) -> Markup:
    """Return the section of a tab."""
    better = "higher" if metrics[tab.ranking].direction is Direction.HIGHER else "lower"
    sha256 = tab.size.measured.dataset_sha256 if tab.size.measured else tab.rows[0].entry.dataset.sha256
    facts = (
        f"Given {tab.size.task.input_frames} frames of each of {len(tab.scenarios)} test scenarios of"
        f" {tab.size.particles} particles, predict the next {len(tab.frames)}. Ranked by {words(tab.ranking)}"
        f" over the horizon, {better} is better. Data set version {tab.size.version}, SHA-256 {sha256[:12]}…"
    )
    region: dict[str, object] = {"role": "region", "aria_label": "Scores", "tabindex": 0}
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
        leader, tied = ranked[0], sum(row.tied for row in ranked)
        who = clipped(leader.entry.name, 40) + (f", and {tied} that cannot be told from it" if tied else "")
        if leader.skill:
            yield _tile("skill of the leader", text(leader.skill.mean), who)
        value = float(value_of(leader, ranking))
        yield _tile(f"leader by {ranking.quantity}", text(value), who)
        losses = [(ranking.loss(float(value_of(one, ranking))), one.name) for one in tab.floors if one.counts]
        known = [held for held in losses if held[0] > 0.0]
        if known and metrics[tab.ranking].direction is Direction.LOWER:
            loss, best = min(known, key=lambda held: held[0])
            yield _tile("leader beside the best floor", f"{text(value / loss, 2)}×", best)
    # who is fast and learned nothing is no example
    learned = [row for row in ranked if row.skill and row.skill.mean > 0.0]
    fast = [
        (cost.speed_up, row, cost.device) for row in learned if (cost := row.entry.cost) and cost.speed_up
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
    yield _tile("entries", str(len(ranked)), f"and {rest} not ranked" if rest else "all ranked")


def _tile(what: str, big: str, more: str) -> Markup:
    parts = {"what": what, "big": big, "more": more}
    return tag("li", *(tag("span", part, class_=kind) for kind, part in parts.items()))


def _tools(tab: Tab, presets: Mapping[str, Sequence[str]]) -> Markup:
    hidden = sum(not row.active for row in tab.rows)
    buttons = [
        tag("button", name, type="button", data_preset=name, data_keys=" ".join(keys))
        for name, keys in presets.items()
    ]
    box, old = tag("input", type="checkbox"), "Withdrawn, superseded, or scored on old data"
    inactive = tag("label", box, f"inactive ({hidden})", class_="check", title=old)
    hint = "Filter methods, authors, hardware"
    return tag(
        "div",
        tag("input", type="search", placeholder=hint, aria_label="Filter", spellcheck="false"),
        tag("div", *buttons, class_="presets", role="group", aria_label="Columns"),
        inactive if hidden else "",
        tag("span", class_="count muted", role="status"),
        tag("button", "CSV", type="button", class_="plain csv", title="Save the table as it is shown"),
        class_="tools",
    )


def _notes(tab: Tab) -> Iterator[Markup]:
    yield escaped(
        "Click a row for curves, maps, a film, every number and the command that makes it again."
        " Ranks follow the ranking metric."
    )
    told = "There are too few test scenarios to tell entries apart: the intervals speak alone."
    if tab.decided:
        told = (
            "≈ cannot be told from the leader at 5 %: two-way bootstrap over scenarios and seeds, with one"
            " seed each the exact sign-flip test over scenarios; p-values corrected by Holm's method."
        )
    yield escaped(f"{told} Shaded rows are floors: what costs no learning, never ranked.")
    yield escaped(
        "Mean over test scenarios and seeds; below it the 95 % interval, of both resampled together."
        " ↓ lower, ↑ higher, ◎ closer to the perfect value is better;"
        " bold is best, floors included, and the bluer a cell, the nearer to it."
        " † some frames have no value. – not measured or undefined."
    )
    yield escaped(
        "Times, speed-up, budget, parameters and hardware are self-reported: submitters say them and nobody"
        " computes them again. A speed-up below 1× means slower than the solver. Scores are verified where"
        " the maintainers scored the predictions again, else as submitted."
    )
    raised = {flag.name for row in tab.rows for flag in (*row.flags, *row.warnings)}
    for name in sorted(raised & EXPLAINED.keys()):
        label, meaning = EXPLAINED[name]
        yield join([tag("strong", label), ": ", meaning])
