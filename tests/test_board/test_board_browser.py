"""The leaderboard's page in a real browser: tabs, sorting, filters, addresses, CSV,
silence.
"""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from browser import (
    CHROMIUM,
    Browser,
    Page,
    close,
    names,
    press,
    restored,
    run,
    seen,
    still,
    until,
)
from PIL import Image
from sample_boards import make_board, with_entry

from lagbench.board.columns import columns_of, format_value, presets_of, value_of
from lagbench.board.model import Board, BoardRow, ReferenceRow, Tab
from lagbench.board.page import render
from lagbench.data.registry import load
from lagbench.metrics import METRICS, Direction

NO_CHROMIUM = "no Chromium here: apt-get install chromium"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason=NO_CHROMIUM),
]


@pytest.fixture(scope="module")
def board() -> Board:
    """Three tabs of eight entries each, two of which are no longer active."""
    return make_board(
        (("cavity", "full"), ("cavity", "mini"), ("fluid", "mini")), nodes=16
    )


@pytest.fixture(scope="module")
def file(board: Board, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its page."""
    path = tmp_path_factory.mktemp("board") / "index.html"
    path.write_text(render(board), encoding="utf-8")
    return path


@pytest.fixture
def page(running: Browser, file: Path) -> Iterator[Page]:
    """The page opened, still films; nothing complained of and nothing asked for in the
    end.
    """
    opened = running.open(file, width=1280)
    still(opened)
    yield opened
    assert opened.messages == []
    assert {request.partition("#")[0] for request in opened.requests} == {
        file.absolute().as_uri()
    }
    close(opened)


def go(page: Page, tab: Tab) -> None:
    """Choose a tab as a reader does."""
    run(page, f"document.querySelector('.tabs a[data-tab=\"{tab.id}\"]').click()")
    until(page, f"!document.getElementById('{tab.id}').hidden")


def test_the_overview_of_all_splits_fits_a_laptop(
    running: Browser, tmp_path: Path
) -> None:
    """Every split that has a size mini has a column, and none lies outside. So it is
    with made-up entries and on the committed page.
    """
    data_sets = [(name, "mini") for name in load().splits]
    path = tmp_path / "index.html"
    page_text = render(make_board(tuple(data_sets), nodes=16))
    path.write_text(page_text, encoding="utf-8")
    committed = Path(__file__).parents[2] / "leaderboard" / "index.html"
    box = "document.querySelector('.across').parentElement"
    for file in (path, committed):
        page = running.open(file, width=1280)
        columns = page.value(f"{box}.querySelectorAll('thead th').length")
        assert columns > len(data_sets)
        assert page.value(f"{box}.scrollWidth") <= page.value(f"{box}.clientWidth")
        close(page)


@pytest.mark.parametrize(
    ("width", "dark"),
    [(1280, False), (1280, True), (390, False), (390, True), (320, False)],
)
def test_page_opens_in_silence(
    running: Browser, file: Path, board: Board, width: int, dark: bool
) -> None:
    """The film plays, a dot shows focus; no message, no other request, no sideways
    scrolling; its scheme.
    """
    page = running.open(file, width=width, dark=dark)
    until(page, "Number(document.querySelector('#hero input').value) > 0")
    go(page, board.tabs[0])
    press(page, "Tab")
    assert page.focus_shows("section:not([hidden]) [data-figure=cost] a.dot")
    run(page, "document.querySelector('.tabs a').click()")
    for opened in (False, True):
        if opened:
            run(page, "document.querySelector('.across td a').click()")
            until(page, "document.getElementById('panel').open")
            assert page.value("document.getElementById('panel').scrollWidth") <= width
        assert page.value("document.documentElement.scrollWidth") <= width
        picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("L"))
        assert bool(np.median(picture) < 80) is dark
    assert page.messages == []
    assert page.requests == [file.absolute().as_uri()]
    close(page)


def test_long_author_lines_clip_no_column(
    running: Browser, board: Board, tmp_path: Path
) -> None:
    """At 1280 pixels all main columns are in view, whatever the names; the title has
    the whole line.
    """
    authors = tuple(f"A. Rather Long Name of Somebody {i}" for i in range(4))
    tab = board.tabs[0]
    said = {
        "affiliation": "An institute " * 12,
        "name": "A name as long as names may be " * 3,
    }
    rows = tuple(with_entry(row, authors=authors, **said) for row in tab.rows)
    columns = (*tab.columns, "velocity_rmse", "mse_avg")
    path = tmp_path / "long.html"
    path.write_text(
        render(replace(board, tabs=(replace(tab, rows=rows, columns=columns),))),
        "utf-8",
    )
    page = running.open(path, width=1280)
    restored(page, f"#tab={tab.id}")
    table = "document.querySelector('section:not([hidden]) .table')"
    assert page.value(f"{table}.scrollWidth") <= page.value(f"{table}.clientWidth")
    heads = page.value(
        f"[...{table}.querySelectorAll('thead th:not([hidden])')].map(th => "
        f"th.textContent)"
    )
    assert len(heads) == 2 + 1 + 4 + 4
    assert heads[-2:] == ["time taken by", "scores"]
    titles = page.value(
        f"[...{table}.querySelectorAll('tr[data-entry] .sub')].map(e => e.title)"
    )
    assert all(", ".join(authors) in title for title in titles)
    close(page)


def test_badges_say_what_is_wrong(page: Page, board: Board) -> None:
    """A warning is called by the fault, with its share as a percentage; its title says
    more.
    """
    go(page, board.tabs[0])
    flags = "document.querySelectorAll('section:not([hidden]) tr[data-entry] .flag')"
    chips = dict(page.value(f"[...{flags}].map(e => [e.textContent, e.title])"))
    assert "outside the box" in chips["leaves the box: 5.9 %"]
    assert "kinetic energy" in chips["unphysical"]
    warning = (
        "document.querySelector('section:not([hidden]) tr[data-entry] .flag.warn')"
    )
    run(page, f"{warning}.closest('tr').click()")
    until(page, "document.getElementById('panel').open")
    assert "leaves the box" in page.value(
        "document.querySelector('#panel .flags').textContent"
    )


def test_every_line_of_the_charts_is_drawn(page: Page, board: Board) -> None:
    """A path that only moves shows nothing: each line over frames goes from a point to
    another.
    """
    for tab in board.tabs:
        go(page, tab)
        lines = "section:not([hidden]) [data-figure=lines] path.line"
        shown = f"document.querySelectorAll('{lines}')"
        paths = page.value(f"[...{shown}].map(line => line.getAttribute('d'))")
        assert paths
        assert all({"L", "H"} & {*path} for path in paths)


def test_film_above_the_fold(running: Browser, file: Path, board: Board) -> None:
    """Truth beside the leader of the tab, in view at once on both widths; a key pauses
    it.
    """
    play = "document.querySelector('#hero .play')"
    at = "Number(document.querySelector('#hero input').value)"
    for width, height in ((1280, 800), (390, 844)):
        page = running.open(file, width=width, height=height)
        assert (
            page.value(
                "document.querySelector('#hero .films').getBoundingClientRect().bottom"
            )
            <= height
        )
        until(page, f"{at} > 0")
        assert page.value(f"{play}.textContent") == "Pause"
        run(page, f"{play}.focus()")
        press(page, "Enter")
        stopped = page.value(at)
        time.sleep(0.2)
        assert 0 < page.value(at) == stopped
        drawn = (
            "[...document.querySelectorAll('#hero canvas')].map(c =>"
            " new Set(c.getContext('2d').getImageData(0, 0, c.width, "
            "c.height).data).size)"
        )
        assert min(page.value(drawn)) > 4
        for tab in board.tabs:
            go(page, tab)
            assert tab.rows[0].entry.name in page.value(
                "document.querySelector('#hero').textContent"
            )
            assert (
                page.value(f"{play}.textContent") == "Play"
            )  # a pause holds for the next film
        assert page.messages == []
        close(page)


def test_film_above_the_fold_waits_where_motion_is_unwanted(
    page: Page, board: Board
) -> None:
    """With reduced motion nothing moves by itself; the film plays when asked, and rests
    under a panel.
    """
    label = "document.querySelector('#hero .play').textContent"
    at = "document.querySelector('#hero input').value"
    restored(page, board.tabs[0].id)
    assert page.value(label) == "Play"
    assert page.value(at) == "0"
    run(page, "document.querySelector('#hero .play').click()")
    until(page, f"{at} > 0")
    run(page, "document.querySelector('#hero figcaption a').click()")
    until(page, "document.getElementById('panel').open")
    assert page.value(label) == "Play"
    run(page, "document.getElementById('panel').close()")
    until(page, f"{label} === 'Pause'")


def positions_between(page: Page, film: str, time: float, periods: str) -> list[float]:
    """Return what the page's function gives for one particle of a film."""
    script = files("lagbench.board").joinpath("page", "film.js").read_text()
    frames = f"{film}.length / 2"
    call = f"positionsAt({film}, 1, {frames}, {time}, {periods})"
    values: list[float] = page.value(f"(() => {{{script}\nreturn [...{call}];}})()")
    return values


def test_a_film_does_not_fly_across_a_periodic_box(page: Page) -> None:
    """A particle that leaves on one side stays there until it is on the other.

    Catmull-Rom splines give straight lines at the constant speed 0.04 per frame.
    """
    wrapped = "[0.90, 0.5, 0.94, 0.5, 0.98, 0.5, 0.02, 0.5, 0.06, 0.5]"
    both_axes = "[[1, 0], [0, 1]]"
    early = positions_between(page, wrapped, 2.25, both_axes)
    late = positions_between(page, wrapped, 2.75, both_axes)
    assert early == pytest.approx([0.98, 0.5])
    assert late == pytest.approx([0.02, 0.5])
    # beside the jump nothing is drawn towards the other side
    for time_before, least, most in ((1.5, 0.94, 0.98), (3.5, 0.02, 0.06)):
        x, y = positions_between(page, wrapped, time_before, both_axes)
        assert least <= x <= most
        assert y == pytest.approx(0.5)

    even = "[0.10, 0.5, 0.14, 0.5, 0.18, 0.5, 0.22, 0.5, 0.26, 0.5]"
    x, _ = positions_between(page, even, 1.5, both_axes)
    assert x == pytest.approx(0.16)
    # with walls such a step is a motion
    x, _ = positions_between(page, wrapped, 2.5, "[]")
    assert x == pytest.approx(0.5)


def test_a_film_that_begins_again_runs_no_faster(page: Page, board: Board) -> None:
    """After three ends, one picture is drawn per picture of the screen, not four."""
    slider = "document.querySelector('#hero input')"
    restored(page, board.tabs[0].id)
    run(
        page,
        "window.plain = window.requestAnimationFrame.bind(window),"
        " window.requestAnimationFrame = then => { window.asked += 1; return "
        "window.plain(then); },"
        " window.tick = () => { window.ticks += 1; window.plain(window.tick); }, "
        "window.tick()",
    )
    run(page, "document.querySelector('#hero .play').click()")
    for _ in range(3):
        run(
            page,
            f"{slider}.value = {slider}.max, {slider}.dispatchEvent(new "
            f"Event('input'))",
        )
        until(page, f"Number({slider}.value) < 0.5 * Number({slider}.max)")
    run(page, "window.asked = window.ticks = 0")
    until(page, "window.ticks >= 20")
    assert 0 < page.value("window.asked") <= 1.5 * page.value("window.ticks")


def test_overview_leads_to_every_board(page: Page, board: Board) -> None:
    """One row per method with its skill on every data set; a cell opens the entry
    there.
    """
    assert (
        page.value("document.querySelector('section.tab:not([hidden])').id")
        == "overview"
    )
    lines = "[...document.querySelectorAll('.across')[0].querySelectorAll('tbody tr')]"
    cells = f"{lines}.map(tr => [...tr.cells].map(td => td.textContent))"
    rows = {row[1]: row for row in page.value(cells)}
    ranked = [row for row in board.tabs[0].rows if row.rank is not None]
    assert rows.keys() == {row.entry.name for row in ranked}
    for row in ranked:
        skill = format_value(row.skill.mean, "number") if row.skill else ""
        assert rows[row.entry.name][4] == f"{skill}rank {row.rank}"
    opener = (
        "document.querySelectorAll('.across')[1].querySelector('td:nth-child(5) a')"
    )
    run(page, f"{opener}.click()")
    until(page, "document.getElementById('panel').open")
    assert (
        page.value("document.querySelector('section.tab:not([hidden])').id")
        == board.tabs[1].id
    )


def test_variants_unfold_behind_their_method(
    running: Browser, board: Board, tmp_path: Path
) -> None:
    """They are hidden until their method's button is pressed, or a filter finds
    them; they stand behind their method, have no rank and open a panel without a film.
    """
    tab = board.tabs[0]
    head, variant, *others = tab.rows
    variant = replace(variant, variant_of=head.id, rank=None, tied=False)
    path = tmp_path / "variants.html"
    tab = replace(tab, rows=(head, *others, variant))
    path.write_text(render(replace(board, tabs=(tab,))), "utf-8")
    page = running.open(path, width=1280)
    still(page)
    restored(page, f"#tab={tab.id}&sort=-name")
    section = "document.querySelector('section:not([hidden])')"
    line = f"{section}.querySelector('tr[data-entry={variant.id}]')"
    is_shown = f"getComputedStyle({line}).display !== 'none'"
    assert not page.value(is_shown)
    run(page, f"{section}.querySelector('.fold').click()")
    assert page.value(is_shown)
    assert page.value(f"{line}.previousElementSibling.dataset.entry") == head.id
    assert page.value(f"{line}.cells[0].textContent") == ""
    run(page, f"{section}.querySelector('.fold').click()")
    assert not page.value(is_shown)
    restored(page, f"#tab={tab.id}&filter={variant.id}")
    assert page.value(is_shown)
    run(page, f"{line}.querySelector('.name').click()")
    until(page, "document.getElementById('panel').open")
    assert page.value("document.querySelectorAll('#panel canvas').length") == 0
    assert page.messages == []
    close(page)


def test_all_columns_are_shown_on_request(page: Page, board: Board) -> None:
    """Every number of a row is in the table, in the order of the headings."""
    tab = board.tabs[0]
    restored(page, f"#tab={tab.id}&columns=all")
    columns = columns_of(tab, board.metrics)
    for row in tab.rows[:2]:
        texts = page.value(
            f"[...document.querySelectorAll('#{tab.id} tr[data-entry={row.id}] > *')]"
            ".slice(2).map(td => td.textContent)"
        )
        assert len(texts) == len(columns)
        for cell, column in zip(texts, columns.values(), strict=True):
            assert cell.startswith(format_value(value_of(row, column), column.form))


def test_the_table_needs_no_script(
    running: Browser, file: Path, page: Page, board: Board
) -> None:
    """Without JavaScript all tabs show the rows and main columns that the script shows
    later.
    """
    plain = running.open(file, width=1280)
    plain.call("Emulation.setScriptExecutionDisabled", value=True)
    plain.call("Page.reload")
    running.wait("Page.loadEventFired")
    root = plain.call("DOM.getDocument")["root"]["nodeId"]
    html = plain.call("DOM.getOuterHTML", nodeId=root)["outerHTML"]
    before = page.value(
        f"[...new DOMParser().parseFromString({json.dumps(html)}, 'text/html')"
        ".querySelectorAll('section.tab:not(#overview)')]"
        ".map(tab => [...tab.querySelectorAll('tbody tr:not([hidden])')]"
        ".map(tr => [tr.cells[0], tr.querySelector('.name'),"
        " ...[...tr.querySelectorAll('td:not(.rank, [hidden])')].map(td => "
        "td.firstChild)]"
        ".map(e => e.textContent)))"
    )
    assert len(before) == len(board.tabs)
    for tab, rows in zip(board.tabs, before, strict=True):
        go(page, tab)
        assert seen(page) == rows
        assert len(rows) == 8


def test_every_preset_shows_the_board(page: Page, board: Board) -> None:
    """Each preset shows the values of its columns, and reference predictors where their
    score puts them.
    """
    tab = board.tabs[0]
    go(page, tab)
    columns = columns_of(tab, board.metrics)
    shown = [row for row in tab.lines if isinstance(row, ReferenceRow) or row.active]
    shown.sort(key=lambda row: row.values[tab.ranking].mean)
    for name, keys in presets_of(tab, columns).items():
        run(
            page,
            f"document.querySelector('section:not([hidden]) "
            f"[data-preset={name}]').click()",
        )
        chosen = [columns[key] for key in keys]
        expected = [
            [format_value(value_of(row, one), one.form) for one in chosen]
            for row in shown
        ]
        assert [row[2:] for row in seen(page)] == expected
        pressed = "section:not([hidden]) [aria-pressed=true]"
        label = f"document.querySelector('{pressed}').textContent"
        assert page.value(label) == name


@pytest.mark.parametrize(
    "key",
    ["position_rmse", "vorticity_pearson", "energy_ratio", "speed_up", "parameters"],
)
def test_sorting(page: Page, board: Board, key: str) -> None:
    """A click sorts best first, another worst first; gaps stay last, and reference
    predictors are sorted with the entries.
    """
    tab = board.tabs[0]
    go(page, tab)
    column = columns_of(tab, board.metrics)[key]
    run(
        page,
        "document.querySelector('section:not([hidden]) [data-preset=all]').click()",
    )
    direction = METRICS[key].direction if key in METRICS else Direction.HIGHER

    def loss(row: BoardRow) -> float:
        if (
            direction is Direction.TARGET
        ):  # too much here and too little there do not cancel
            return float(np.mean(np.abs(np.array(row.values[key].per_scenario) - 1.0)))
        value = float(value_of(row, column))
        return -value if direction is Direction.HIGHER else value

    rows = [row for row in tab.rows if row.active]
    known = sorted((row for row in rows if not np.isnan(loss(row))), key=loss)
    gaps = [row.entry.name for row in rows if np.isnan(loss(row))]
    heading = f"section:not([hidden]) [data-sort={key}]"
    run(page, f"document.querySelector('{heading}').click()")
    assert names(page) == [row.entry.name for row in known] + gaps
    first = page.value(f"document.querySelector('{heading}').closest('th').ariaSort")
    assert first == ("descending" if direction is Direction.HIGHER else "ascending")
    assert page.value(f"document.activeElement === document.querySelector('{heading}')")
    run(page, f"document.querySelector('{heading}').click()")
    assert names(page) == [row.entry.name for row in known[::-1]] + gaps
    assert (
        page.value(
            "document.querySelectorAll('section:not([hidden]) th[aria-sort]').length"
        )
        == 1
    )
    assert len(seen(page)) == len(rows) + len(tab.references)


def test_filter_by_keyboard(page: Page, board: Board) -> None:
    """A slash leads to the filter; every word must occur; reference predictors stay."""
    go(page, board.tabs[0])
    press(page, "/")
    page.call("Input.insertText", text="examples GAT")
    run(page, "0")
    assert names(page) == [
        row.entry.name
        for row in board.tabs[0].rows
        if row.active and "GAT" in row.entry.name
    ]
    assert len(seen(page)) == len(names(page)) + 2
    assert "of 6 entries" in page.value(
        "document.querySelector('section:not([hidden]) .count').textContent"
    )
    page.call("Input.insertText", text=" nobody")
    run(page, "0")
    assert names(page) == []
    assert len(seen(page)) == 2


def test_tabs_by_keyboard(page: Page, board: Board) -> None:
    """Arrows move between tabs, one section is shown at a time, going back goes
    back.
    """
    run(page, "document.querySelector('.tabs a').focus()")
    press(page, "ArrowRight")
    press(page, "ArrowRight")
    shown = (
        "[...document.querySelectorAll('section.tab')]"
        ".filter(section => !section.hidden).map(section => section.id)"
    )
    assert page.value(shown) == ["cavity-mini"]
    press(page, "End")
    assert page.value(shown) == ["fluid-mini"]
    assert page.value("document.activeElement.dataset.tab") == "fluid-mini"
    assert page.value(
        "[...document.querySelectorAll('[aria-selected=true]')].map(a => a.dataset.tab)"
    ) == ["fluid-mini"]
    assert names(page) == [row.entry.name for row in board.tabs[2].rows if row.active]
    run(page, "history.back()")
    until(page, f"String({shown}) === 'cavity-mini'")


def test_address_restores_the_state(page: Page) -> None:
    """What was chosen stands in the address; loading that address shows the same."""
    run(page, "document.querySelectorAll('.tabs a')[3].click()")
    run(
        page,
        "document.querySelector('section:not([hidden]) [data-preset=energy]').click()",
    )
    run(
        page,
        "document.querySelector('section:not([hidden]) "
        "[data-sort=energy_error]').click()",
    )
    run(page, "document.querySelector('section:not([hidden]) .check input').click()")
    run(
        page,
        "document.querySelector('section:not([hidden]) input[type=search]').focus()",
    )
    page.call("Input.insertText", text="du châtelet")
    run(page, "0")
    address = page.value("location.hash")
    table = seen(page)
    for part in (
        "tab=fluid-mini",
        "columns=energy",
        "sort=energy_error",
        "inactive=1",
        "filter=",
    ):
        assert part in address
    restored(page, "")
    assert seen(page) != table
    restored(page, address)
    assert seen(page) == table
    assert (
        page.value(
            "document.querySelector('section:not([hidden]) input[type=search]').value"
        )
        == "du châtelet"
    )


@pytest.mark.parametrize(
    "address", ["#fluid-mini", "#tab=fluid-mini&columns=nothing&sort=-x&entry=y&cost=z"]
)
def test_odd_addresses_do_no_harm(page: Page, board: Board, address: str) -> None:
    """The name of a tab alone is enough; what is unknown is passed over."""
    restored(page, address)
    assert names(page) == [row.entry.name for row in board.tabs[2].rows if row.active]
    assert page.value("document.getElementById('panel').open") is False


def test_inactive_entries_hide_behind_a_toggle(page: Page, board: Board) -> None:
    """Withdrawn and superseded entries show on demand, unranked and named so."""
    go(page, board.tabs[0])
    gone = [row for row in board.tabs[0].rows if not row.active]
    assert len(gone) == 2
    assert not {row.entry.name for row in gone} & set(names(page))
    run(page, "document.querySelector('section:not([hidden]) .check input').click()")
    rows = {row[1]: row for row in seen(page)}
    assert [rows[row.entry.name][0] for row in gone] == ["–", "–"]
    flags = "document.querySelectorAll('section:not([hidden]) tr.inactive .flag')"
    chips = page.value(f"[...{flags}].map(e => [e.textContent, e.title])")
    told = [title for label, title in chips if label in ("withdrawn", "superseded")]
    assert all(
        title.startswith(row.entry.reason)
        for row, title in zip(gone, told, strict=True)
    )


@pytest.mark.parametrize("preset", ["main", "cost"])
def test_csv_equals_the_table(
    page: Page, board: Board, tmp_path: Path, preset: str
) -> None:
    """The file has the rows and columns of the table in its order, with all digits."""
    tab = board.tabs[0]
    go(page, tab)
    columns = columns_of(tab, board.metrics)
    page.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    run(
        page,
        f"document.querySelector('section:not([hidden]) "
        f"[data-preset={preset}]').click()",
    )
    run(
        page,
        "document.querySelector('section:not([hidden]) [data-sort=speed_up]').click()",
    )
    run(page, "document.querySelector('section:not([hidden]) .csv').click()")
    path = tmp_path / f"lagbench-{tab.id}-{preset}.csv"
    for _ in range(100):
        if path.exists():
            break
        time.sleep(0.05)
    head, *lines = list(
        csv.reader(io.StringIO(path.read_text(encoding="utf-8"), newline=""))
    )
    keys = list(presets_of(tab, columns)[preset])
    assert head == [
        "rank",
        "method",
        "status",
        *keys,
        "vorticity_rmse_low",
        "vorticity_rmse_high",
    ]
    shown = seen(page)
    assert [line[1] for line in lines] == [row[1] for row in shown]
    ranks = [row[0].rstrip("≈").replace("ref.", "") for row in shown]
    assert [line[0] for line in lines] == ranks
    values = {row.entry.name: row.values for row in tab.rows} | {
        row.name: row.values for row in tab.references
    }
    for line, texts in zip(lines, shown, strict=True):
        for key, cell, said in zip(keys, line[3:-2], texts[2:], strict=True):
            form = columns[key].form
            assert (
                format_value(cell if form == "text" else float(cell or "nan"), form)
                == said
            )
        value = values[line[1]]["vorticity_rmse"]
        assert float(line[3 + keys.index("vorticity_rmse")]) == pytest.approx(
            value.mean, rel=1e-8
        )
        assert [float(cell) for cell in line[-2:]] == pytest.approx(
            [value.low, value.high], rel=1e-5
        )


def test_scheme_can_be_chosen(page: Page) -> None:
    """The button goes from the system's scheme to light, dark, and back."""
    paper = "getComputedStyle(document.body).backgroundColor"
    scheme = "document.documentElement.dataset.theme ?? 'auto'"
    seen_papers = []
    for _ in range(3):
        run(page, "document.getElementById('theme').click()")
        seen_papers.append((page.value(scheme), page.value(paper)))
    light = "rgb(255, 255, 255)"
    dark = "rgb(16, 20, 27)"
    assert seen_papers == [("light", light), ("dark", dark), ("auto", light)]
