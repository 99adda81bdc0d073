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
import re
from collections.abc import Iterator, Mapping, Sequence
from importlib.resources import files
from itertools import groupby

from lagbench.addresses import DOCUMENTATION
from lagbench.data.checksums import round_digits
from lagbench.figures.colours import DARK, LIGHT, format_variables
from lagbench.figures.html import Markup, clipped, escaped, join, load_style_sheet, tag
from lagbench.figures.numbers import DIGITS, text, words
from lagbench.metrics.metric import Direction, Metric

from .columns import (
    HAS_GAPS,
    SOLVER_COSTS_MORE,
    comparisons_of,
    cost_of,
    format_ranks,
    format_value,
    is_beside_dearer_solver,
    leader_of,
    level_of,
    source_of_cost,
    value_of,
)
from .cost import cost_figure
from .encoding import decode, encode
from .entry import Level
from .model import Board, BoardRow, ReferenceRow, Tab
from .overview import (
    FINDING,
    MethodOverview,
    SizeOverview,
    count_data_sets,
    find_hero,
    is_open,
    join_names,
    make_overviews,
    summarise,
)
from .page_data import page_data
from .table import draw_table, fold_button
from .table_view import (
    DIVERGED,
    LABELS,
    SLOW,
    UNDER_TRAINED,
    TableView,
    make_table,
)

SCRIPTS = (
    "data",
    "text",
    "scale",
    "chart",
    "state",
    "fold",
    "table",
    "overview",
    "maps",
    "film",
    "hero",
    "detail",
    "main",
)
"""Parts of the script, in this order."""

PAGES = {
    "Documentation": "index",
    "How to take part": "submitting",
    "What the scores mean": "scoring",
    "All results": "results",
}
"""Pages of the documentation's site that the page links, by label."""


def links_to(documentation: str = DOCUMENTATION) -> dict[str, str]:
    """Return the links of the page, from the leaderboard's folder.

    Where the site has no address, it is the one that mkdocs makes in a clone. Links to
    missing files are left out later.

    >>> links_to("https://example.org/docs/")["All results"]
    'https://example.org/docs/results.html'
    """
    site = documentation.rstrip("/") or "../site"
    links = {}
    for label, name in PAGES.items():
        links[label] = f"{site}/{name}.html"
    return links


LINKS: Mapping[str, str] = links_to()
"""Links of the page at the address of the site that is set."""

TAKE_PART = """\
# once, in a clone of the repository
pip install -c constraints.txt '.[generate,plots,baselines]'
# the data, bit for bit; so for every split
lagbench generate --split cavity --size mini
# a model of ours, or write predictions.nc with a program of your own
lagbench train --baseline neuralmpm --split cavity --size mini
lagbench predict runs/cavity/mini/neuralmpm-0/weights.safetensors -o predictions.nc
# scores, and adds the entry
lagbench submit predictions.nc --from meta.yaml
# what the pull request must pass
lagbench leaderboard check --base origin/main
# anybody can repeat a score
lagbench leaderboard reproduce SPLIT/SIZE/METHOD"""
"""Commands by which a reader takes part."""

FOOT = (
    "Velocity and vorticity are per frame; lengths are in units of the box.",
    "This page is one file, built by lagbench leaderboard build from the score files, "
    "and asks nothing of the network. How to cite a data set: lagbench cite.",
)

OVERVIEW_WORDS = (
    "Skill is 0 for the best naive baseline, which learns nothing, and 1 for a perfect "
    "prediction. “0.9×” is the error beside that of the best classical solver that "
    "costs no more per frame than the model. Where all cost "
    f"more, the cheapest one takes its place, and the sign {SOLVER_COSTS_MORE} stands "
    "behind the number. So two models of one data set may stand beside different "
    "solvers. The error is the metric that ranks on the data set: that of vorticity in "
    "boxes full of fluid, the distance of particle clouds on free surfaces. The cost "
    "is the processor time of a frame on one core. Size mini is "
    "what a laptop makes in minutes, full is larger."
)

CELL_WORDS = (
    "A cell has the skill, the rank on this data set, and the error beside that of the "
    "best classical solver that costs no more per frame. Where all cost more, the "
    f"cheapest one takes its place, with the sign {SOLVER_COSTS_MORE}. The last one is "
    "missing where the cost is unknown. A question mark stands where its 95 % interval "
    "contains 1. A "
    "rank such as 2–4 names the places that a method takes when the test scenarios are "
    "drawn again (95 %). Ranks count entries only: classical solvers and baselines "
    "have none. Variants of a method are folded behind it, without a rank."
)


LEVEL_MEANINGS = {
    Level.AS_SUBMITTED: "the maintainers did not follow the scores",
    Level.SCORED_AGAIN: "the maintainers scored the predictions of the submitter again",
    Level.REPRODUCED: "the maintainers ran the model and got the same scores",
}
"""What the maintainers did with an entry, in words behind the name of its level."""

PARTIAL_MEANING = (
    "Where a number of scenarios stands behind the level, the maintainers ran the "
    "model on these test scenarios only. That is weaker evidence: the scores on the "
    "others are as submitted."
)

RANK_MEANING = "Best to worst rank in 95 % of the resamples of scenarios and seeds"

DATA_ELEMENT = re.compile(
    rb'(<script type="text/plain" id="page-(?:data|arrays)">)([!-;=?-~]*)(?=</)'
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
    overviews = make_overviews(board)
    hero = find_hero(overviews)
    data, arrays = page_data(views, hero)

    link_tags = []
    for label, address in links.items():
        link_tags.append(tag("a", label, href=address))
    sections = [draw_overview(overviews)]
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
        "hero": draw_hero() if hero else Markup(""),
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


def links_in(page: bytes, known_links: Mapping[str, str]) -> dict[str, str]:
    """Return those of our links that a page has."""
    links = {}
    for label, address in known_links.items():
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
    """Return the paragraphs under the title: question, answer, what is verified.

    They count active entries only, and the data sets that have one.
    """
    rows: list[BoardRow] = []
    data_set_count = 0
    for tab in board.tabs:
        active_rows = [row for row in tab.rows if row.active]
        rows += active_rows
        if active_rows:
            data_set_count += 1
    question = (
        "Which neural surrogate predicts how fluids and soft bodies move, and is it "
        "better than a classical solver of the same cost?"
    )
    paragraphs = [tag("p", question, class_="lede")]
    statement, reasons = FINDING
    answer = tag("strong", statement)
    paragraphs.append(tag("p", answer, f" {reasons}", class_="lede"))
    entries = _count(len(rows), "entry", "entries")
    data_sets = _count(data_set_count, "data set", "data sets")
    evidence = escaped(
        f"{entries} on {data_sets} that every x86-64 Linux CPU regenerates bit for "
        "bit. Every score follows from committed score files. "
        f"{_describe_levels(rows)} {_describe_costs(rows)}"
    )
    paragraphs.append(tag("p", evidence, class_="facts"))
    link = tag("a", "Take part", href="#take-part", class_="plain")
    paragraphs.append(tag("p", link))
    return join(paragraphs)


def _describe_levels(rows: Sequence[BoardRow]) -> str:
    """Return how many entries the maintainers followed how far, and where."""
    counts = dict.fromkeys(Level, 0)
    machines = set()
    whole_count = 0
    run_count = 0
    differing_count = 0
    for row in rows:
        counts[level_of(row)] += 1
        if row.verified is not None and row.verified.reproduced:
            run_count += 1
            if not all(model.agrees for model in row.verified.reproduced):
                differing_count += 1
        if row.verified is not None and row.verified.is_reproduced_wholly:
            whole_count += 1
        if row.verified is not None and row.verified.cost is not None:
            machines.add(row.verified.cost.machine)
    clauses: list[str] = []
    run_again = counts[Level.REPRODUCED]
    if run_again:
        models = _count(run_again, "entry", "entries")
        clause = f"ran the models of {models} again and got the same scores"
        clause += _describe_extent(whole_count, run_again - whole_count)
        clauses.append(clause)
    if counts[Level.SCORED_AGAIN]:
        predictions = _count(counts[Level.SCORED_AGAIN], "entry", "entries")
        clauses.append(f"scored the predictions of {predictions} again")
    differing = ""
    if differing_count:
        models = _count(differing_count, "entry", "entries")
        differing = f" The models of {models} gave other scores."
    if not clauses:
        sentence = "All entries stand as submitted"
        if not run_count:
            sentence += ": nobody has scored them again yet"
        return f"{sentence}.{differing}"
    sentence = f"The maintainers of this leaderboard {' and '.join(clauses)}"
    if machines:
        sentence += f"; machine: {', '.join(sorted(machines))}"
    if counts[Level.AS_SUBMITTED]:
        sentence += ". The others stand as submitted"
    return f"{sentence}.{differing}"


def _describe_extent(whole: int, partly: int) -> str:
    """Return on how much of the test subset models were run again."""
    if not partly:
        return " on all test scenarios"
    if not whole:
        return " on a part of the test scenarios"
    return f", {whole} on all test scenarios and {partly} on a part of them"


def _describe_costs(rows: Sequence[BoardRow]) -> str:
    sources = [source_of_cost(row) for row in rows]
    measured_count = sources.count("measured")
    reported_count = sources.count("self-reported")
    if not reported_count:
        return ""
    if not measured_count:
        return "Costs are self-reported."
    return f"Costs: {measured_count} measured, {reported_count} self-reported."


def _count(count: int, singular: str, plural: str) -> str:
    if count == 1:
        return f"1 {singular}"
    return f"{count} {plural}"


def draw_hero() -> Markup:
    """Return the place of the film above the fold, which the script fills."""
    return tag(
        "figure",
        id="hero",
        class_="scripted",
        aria_label="The truth beside a model",
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
    """Return how to take part, and the names of data sets without an entry."""
    parts = [
        tag("h2", "Take part"),
        tag(
            "p",
            "Predict the test scenarios with your model. Describe it in meta.yaml: "
            "authors and command are required. lagbench submit scores the predictions "
            "and writes the entry into a clone of the repository; open a pull request "
            "with these files and nothing else. Nobody runs your code unless you give "
            "the model too. docs/submitting.md has a meta.yaml and each step.",
        ),
        tag("pre", tag("code", TAKE_PART)),
    ]
    if board.empty:
        names = ", ".join(" ".join(data_set) for data_set in board.empty)
        beginning = "No entry yet" if board.tabs else "There are no entries yet"
        parts.append(tag("p", f"{beginning}: {names}. Yours can be the first."))
    return tag("section", *parts, class_="empty", id="take-part")


def draw_overview(overviews: Sequence[SizeOverview]) -> Markup:
    """Return a section with the findings and a table of methods for each
    size.
    """
    if not overviews:
        return Markup("")
    parts = [
        tag("h2", "All data sets"),
        tag("p", OVERVIEW_WORDS, class_="facts"),
    ]
    for number, overview in enumerate(overviews):
        items = [tag("li", sentence) for sentence in summarise(overview)]
        parts.append(tag("h3", overview.size))
        parts.append(tag("ul", *items, class_="verdicts"))
        if number == 0:
            parts.append(tag("p", CELL_WORDS, class_="facts"))
        parts.append(_overview_table(overview))
    return tag("section", *parts, id="overview", class_="tab")


def _overview_table(overview: SizeOverview) -> Markup:
    headings = [
        tag("th", "#", scope="col", class_="rank", title=RANK_MEANING),
        tag("th", "method", scope="col", class_="method"),
        tag("th", "kind", scope="col", class_="words"),
        tag("th", "mean skill", scope="col"),
    ]
    for tab in overview.tabs:
        link = tag("a", tab.size.split, href=f"#{tab.id}")
        headings.append(tag("th", link, scope="col"))
    headings.append(tag("th", "scores", scope="col", class_="words"))
    bodies = []
    complete = []
    incomplete = []
    for method in overview.methods:
        lines = _overview_lines(method, overview)
        if method.rank is None:
            incomplete += lines
        else:
            complete += lines
    bodies.append(tag("tbody", *complete))
    if incomplete:
        words_of_group = _explain_missing_places(overview)
        heading = tag(
            "th",
            tag("span", words_of_group),
            colspan=len(headings),
            scope="rowgroup",
            class_="group",
        )
        bodies.append(tag("tbody", tag("tr", heading), *incomplete))
    caption = f"All data sets of size {overview.size}"
    return _scrolled_table(caption, headings, bodies, class_="board across")


def _scrolled_table(
    caption: str,
    headings: Sequence[Markup],
    bodies: Sequence[Markup],
    *,
    class_: str,
) -> Markup:
    """Return a table that scrolls sideways where the page is narrow."""
    table = tag(
        "table",
        tag("caption", caption, class_="unseen"),
        tag("thead", tag("tr", *headings)),
        *bodies,
        class_=class_,
    )
    return tag(
        "div",
        table,
        class_="scroll",
        role="region",
        aria_label=caption,
        tabindex=0,
    )


def _explain_missing_places(overview: SizeOverview) -> str:
    """Return why the methods of the second group have no place."""
    data_sets = count_data_sets(overview)
    if overview.has_places:
        return f"Without a place: not on {data_sets}"
    return (
        f"Nobody has a place yet: a place needs a skill on {data_sets} of this size. "
        "The rank on one data set stands in its column."
    )


def _overview_lines(method: MethodOverview, overview: SizeOverview) -> list[Markup]:
    """Return the line of a method, and those of its variants, folded away."""
    lines = [_overview_line(method, overview)]
    for variant in method.variants:
        lines.append(_overview_line(variant, overview, variant_of=method.method))
    return lines


def _overview_line(
    method: MethodOverview, overview: SizeOverview, *, variant_of: str | None = None
) -> Markup:
    """Return the line of one method, with a cell for each data set."""
    rank = ""
    if method.rank is not None:
        rank = format_ranks(method.rank, method.rank_range)
    short_name = clipped(method.name, 60)
    name = [tag("span", short_name, class_="name")]
    if method.variants:
        button = fold_button(method.method, len(method.variants))
        name.append(button)
    if method.missing:
        data_set_count = len(overview.tabs)
        present_count = data_set_count - len(method.missing)
        share = f"on {present_count} of {data_set_count}"
        title = f"not on {', '.join(method.missing)}"
        skill = tag("span", share, class_="ci gaps", title=title)
    else:
        skill = tag("span", text(method.mean_skill), class_="n")
    cells = [
        tag("td", rank, class_="rank"),
        tag("th", *name, scope="row", class_="method"),
        tag("td", str(method.kind), class_="words"),
        tag("td", skill),
    ]
    for tab in overview.tabs:
        row = method.rows.get(tab.id)
        cells.append(_overview_cell(row, tab))
    level = _lowest_level(method)
    cells.append(tag("td", level, class_="words"))
    if variant_of is None:
        return tag("tr", *cells)
    return tag("tr", *cells, class_="variant folded", data_variant_of=variant_of)


def _lowest_level(method: MethodOverview) -> str:
    """Return what is verified of all its data sets."""
    levels = [level_of(row) for row in method.rows.values()]
    return str(min(levels, key=lambda level: level.rank))


def _overview_cell(row: BoardRow | None, tab: Tab) -> Markup:
    if row is None:
        return tag("td")  # the style sheet writes a dash
    remarks = []
    if row.rank is not None:
        remarks.append(f"rank {format_ranks(row.rank, row.rank_range)}")
    if row.against_classical is not None:
        ratio = f"{text(row.against_classical.mean)}×"
        if row.solver_costs_more:
            ratio += SOLVER_COSTS_MORE
        if is_open(row.against_classical):
            ratio += "?"
        remarks.append(ratio)
    parts = []
    if row.skill is not None:
        parts.append(tag("span", text(row.skill.mean), class_="n"))
    for remark in remarks:
        parts.append(tag("span", remark, class_="ci"))
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
        tag("p", _describe_ranks(view), class_="facts"),
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


def _describe_ranks(view: TableView) -> str:
    """Return what has a rank, and which reference predictors stand before rank 1."""
    ahead = []
    for line in view.lines:
        if isinstance(line.row, ReferenceRow):
            ahead.append(line.name)
        elif line.row.rank == 1:
            break
    else:
        ahead = []
    sentence = "Ranks count entries only. Shaded rows are reference predictors"
    if not ahead:
        return f"{sentence}, without a rank."
    return f"{sentence}, without a rank: {join_names(ahead)} would stand before rank 1."


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
        more = f"and {unranked_count} variants or not ranked"
    yield _tile("methods", str(ranked_count), more)


def _leader_tiles(
    view: TableView, leader: BoardRow, metrics: Mapping[str, Metric]
) -> Iterator[Markup]:
    tab = view.tab
    ranking = view.columns[tab.ranking]
    tied_count = sum(row.tied for row in tab.rows if row.rank is not None)
    name = clipped(leader.entry.name, 40)
    if tied_count:
        name += f", and {tied_count} that cannot be told from it"
    variants = tab.variants_of(leader)
    if variants and variants[0].values[tab.ranking].mean < float(
        value_of(leader, ranking)
    ):
        name += f"; its variant “{clipped(variants[0].entry.name, 60)}” has "
        name += text(variants[0].values[tab.ranking].mean)
    if leader.skill is not None:
        yield _tile("skill of the leader", text(leader.skill.mean), name)
    value = float(value_of(leader, ranking))
    yield _tile(f"leader by {ranking.quantity}", text(value), name)

    if leader.against_classical is not None and leader.solver is not None:
        ratio = f"{text(leader.against_classical.mean)}×"
        label = (
            "error of the leader beside the best classical solver that costs no more "
            "per frame"
        )
        if leader.solver_costs_more:
            label = (
                "error of the leader beside the cheapest classical solver, which costs "
                "more per frame"
            )
        yield _tile(label, ratio, leader.solver)


def _speed_tiles(tab: Tab) -> Iterator[Markup]:
    """Yield the tile of the fastest entry with skill: speed alone is no example."""
    fastest = None
    greatest = 0.0
    for row in tab.rows:
        cost = cost_of(row)
        has_skill = row.skill is not None and row.skill.mean > 0.0
        if row.rank is None or not has_skill or cost is None or not cost.speed_up:
            continue
        if cost.speed_up > greatest:
            greatest = cost.speed_up
            fastest = row
    cost = None if fastest is None else cost_of(fastest)
    if fastest is None or cost is None:
        return
    shown_speed = round_digits(greatest, DIGITS)
    comparison = "as fast as the simulator"
    if shown_speed > 1.0:
        comparison = "faster than the simulator"
    elif shown_speed < 1.0:
        comparison = "slower than the simulator"
    name = clipped(fastest.entry.name, 40)
    yield _tile(
        "speed of the fastest entry with skill; the simulator that made the data = 1×",
        format_value(greatest, "factor"),
        f"{comparison}: {name}, {cost.device}; {source_of_cost(fastest)}",
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
    # their headings alone say too little
    for column in comparisons_of(tab):
        yield _explain(column.label, column.meaning)
    if tab.pictured is not None:
        count = _count(tab.pictured, "method", "methods")
        yield escaped(
            f"Maps, distributions and films are those of the first {count} of each "
            "data set: with those of all the page would be too long. lagbench score "
            "PREDICTIONS --report FOLDER draws them for any predictions."
        )
    claim = (
        "There are too few test scenarios to tell entries apart: the intervals speak "
        "alone."
    )
    if tab.decided:
        claim = (
            "A rank is the range in which it lies in 95 % of the resamples of "
            "scenarios and seeds. ≈ cannot be told from the leader at 5 %: two-way "
            "bootstrap over scenarios and seeds, with one seed each the exact "
            "sign-flip test over scenarios; p-values corrected by Holm's method. "
            "Variants of a method by the same authors are folded behind it and have no "
            "rank."
        )
    yield escaped(
        f"{claim} Shaded rows are reference predictors, never ranked: naive baselines, "
        "which predict without learning and without equations, and classical solvers."
    )
    levels = {level_of(row) for row in tab.rows}
    if levels:
        meanings = []
        for level in sorted(levels, key=lambda level: level.rank):
            meanings.append(f"{level}: {LEVEL_MEANINGS[level]}")
        meaning = f"{'; '.join(meanings)}."
        lines = [row.verified for row in tab.rows if row.verified is not None]
        if any(line.is_reproduced and not line.is_reproduced_wholly for line in lines):
            meaning += f" {PARTIAL_MEANING}"
        yield _explain("scores", meaning)
    if any(reference.is_slow for reference in tab.references):
        yield _explain(*SLOW)
    yield escaped(
        "Mean over test scenarios and seeds; below it the 95 % interval, of both "
        "resampled together. ↓ lower, ↑ higher, ◎ closer to the perfect value is "
        "better; bold is best, reference predictors included, and the bluer a cell, "
        f"the nearer to it. {HAS_GAPS} some frames have no value. – not measured or "
        "undefined."
    )
    yield escaped(
        "Budget, parameters and hardware are self-reported: submitters state them and "
        "nobody computes them again. So are times, except where the column says "
        "measured: then we timed the entry, the simulator that made the data and the "
        "classical solvers in one run on one core, and “÷ classical” compares these "
        f"times. {_times_of_references(tab)} A speed-up below 1× means slower than the "
        "simulator."
    )
    if any(is_beside_dearer_solver(row) for row in tab.rows):
        yield escaped(
            f"{SOLVER_COSTS_MORE} every classical solver costs more than the model."
        )
    if any(row.failed_gates for row in tab.rows):
        yield _explain(*UNDER_TRAINED)
    if any(row.diverged for row in tab.rows):
        yield _explain(*DIVERGED)
    raised: set[str] = set()
    for row in tab.rows:
        for flag in (*row.flags, *row.warnings):
            raised.add(flag.name)
    for name in sorted(raised.intersection(LABELS)):
        yield _explain(*LABELS[name])


def _times_of_references(tab: Tab) -> str:
    """Return where the times of the shaded rows come from."""
    if tab.run is None:
        return "Those of the shaded rows are of another run."
    return (
        "Those of the shaded rows are of the same run. Of naive baselines that read "
        "train they are converted from another run by the time of the simulator."
    )


def _explain(label: str, meaning: str) -> Markup:
    return join([tag("strong", label), ": ", meaning])
