"""The panel of an entry in a real browser, and what text of strangers does there:
nothing.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

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
    still,
    until,
)
from numpy.testing import assert_allclose
from sample_boards import make_board, with_entry

from lagbench.board.build import picture_first
from lagbench.board.cost import points_of
from lagbench.board.entry import EntryFlag, Weights
from lagbench.board.model import Board
from lagbench.board.page import render

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium here: apt-get install chromium"
)

HOSTILE = (
    "</script><script>console.error(1)</script>"
    "<img src=http://example.com/x onerror=console.error(2)>"
)


@pytest.fixture(scope="module")
def board() -> Board:
    """A tab of eight entries."""
    return make_board((("cavity", "full"),), nodes=16)


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


def test_panel_by_keyboard(page: Page, board: Board) -> None:
    """Enter on a name opens its panel, Escape closes it; the focus comes back to the
    name.
    """
    row = next(row for row in board.tabs[0].rows if row.flags)
    restored(page, "#tab=cavity-full")
    run(
        page,
        f"document.querySelector('section:not([hidden]) [data-entry={row.id}] "
        f".name').focus()",
    )
    press(page, "Enter")
    until(page, "document.getElementById('panel').open")
    text = page.value("document.getElementById('panel').textContent")
    entry = row.entry
    for said in (
        entry.name,
        entry.command,
        entry.training,
        row.flags[0].reasons[0],
        entry.authors[0],
    ):
        assert said in text
    assert f"entry={row.id}" in page.value("location.hash")
    assert page.value(
        "document.getElementById('panel').contains(document.activeElement)"
    )
    press(page, "Tab")
    assert page.value(
        "document.getElementById('panel').contains(document.activeElement)"
    )
    press(page, "Escape")
    until(
        page,
        "!document.getElementById('panel').open && !location.hash.includes('entry=')",
    )
    assert page.value("document.activeElement.textContent") == entry.name


@pytest.mark.slow
def test_the_panel_leads_to_the_entry_whose_weights_a_row_shares(
    running: Browser, board: Board, tmp_path: Path
) -> None:
    first, second, *others = board.tabs[0].rows
    keeper = "/".join(second.entry.place)
    weights = Weights(path="x", sha256="0" * 64, shared_with=keeper)
    predictions = []
    for prediction in first.entry.predictions:
        predictions.append(prediction.model_copy(update={"weights": weights}))
    sharing = with_entry(first, predictions=tuple(predictions))
    tab = replace(board.tabs[0], rows=(sharing, second, *others))
    file = tmp_path / "index.html"
    file.write_text(render(replace(board, tabs=(tab,))), encoding="utf-8")
    page = running.open(file, width=390)
    restored(page, f"#tab=cavity-full&entry={first.id}")
    run(page, "document.querySelector('#panel .origin dd a').click()")
    title = "document.getElementById('panel-title').textContent"
    until(page, f"{title} === {json.dumps(second.entry.name)}")
    assert page.messages == []
    close(page)


def test_panel_draws_everything(page: Page, board: Board) -> None:
    """Curves, dots per scenario, maps, histograms, energy and the film are drawn."""
    tab = board.tabs[0]
    restored(page, "#tab=cavity-full&entry=gns")
    drawn = page.value(
        "[...document.querySelectorAll('#panel [data-figure]')].map(f => "
        "f.dataset.figure)"
    )
    assert drawn == [
        "errors",
        "scenarios",
        "maps",
        "film",
        "energy",
        "residual",
        "distribution",
    ]
    count = "document.querySelectorAll('#panel [data-figure={}] {}').length"
    lines = 1 + (tab.rows[0].id != "gns") + len(tab.references)
    assert page.value(count.format("errors", ".line:not(.swatch *)")) == lines
    assert page.value(count.format("errors", ".band")) == 1
    assert page.value(count.format("scenarios", ".chart .spot.s0")) == len(
        tab.scenarios
    )
    shapes = page.value(
        "[...document.querySelectorAll('#panel [data-figure=scenarios] .key .spot')]"
        ".map(s => s.getAttribute('d') ?? `circle ${s.getAttribute('r')}`)"
    )
    assert len(shapes) == 1 + len(tab.references)
    assert len(set(shapes)) == len(shapes)
    assert page.value(count.format("energy", ".chart .line")) == 4
    fields = page.value(
        "[...document.querySelectorAll('#panel canvas')].map(c =>"
        " new Set(c.getContext('2d').getImageData(0, 0, c.width, c.height).data).size)"
    )
    maps = len(tab.truth.map_frames)
    assert len(fields) == maps * 3 + 2
    assert min(fields) > 4
    errors = "document.querySelector('#panel [data-figure=errors]')"
    run(page, f"{errors}.querySelector('select').value = 'vorticity_pearson'")
    run(page, f"{errors}.querySelector('select').dispatchEvent(new Event('change'))")
    assert "stable above 0.95" in page.value(f"{errors}.textContent")


def test_panel_without_pictures_says_so(
    running: Browser, board: Board, tmp_path: Path
) -> None:
    """An entry behind those with a film has curves; the panel says who has films."""
    tabs = picture_first(board.tabs, most=2)
    path = tmp_path / "index.html"
    path.write_text(render(replace(board, tabs=tuple(tabs))), encoding="utf-8")
    page = running.open(path, width=1280)
    still(page)
    last = tabs[0].rows[5]
    restored(page, f"#tab=cavity-full&entry={last.id}")
    drawn = page.value(
        "[...document.querySelectorAll('#panel [data-figure]')].map(f => "
        "f.dataset.figure)"
    )
    assert drawn == ["errors", "scenarios", "energy"]
    panel = page.value("document.querySelector('#panel').textContent")
    assert "films of the first 2 methods" in panel
    assert page.messages == []
    close(page)


def test_map_shows_the_field(page: Page, board: Board) -> None:
    """Pixels of the truth's map: opacity is the share of the greatest value, colour its
    sign.
    """
    restored(page, "#tab=cavity-full&entry=gns")
    data = page.value(
        "[...document.querySelector('#panel canvas').getContext('2d').getImageData(0, "
        "0, 16, 16).data]"
    )
    # [x node, y node]
    pixels = np.array(data).reshape(16, 16, 4)[::-1].transpose(1, 0, 2)
    truth = board.tabs[0].truth.vorticity
    field = truth[0]
    limit = np.nanmax(np.abs(field))
    known = np.isfinite(field)
    assert np.all(pixels[~known] == [128, 128, 128, 34])
    assert_allclose(pixels[known][:, 3], 255 * np.abs(field[known]) / limit, atol=1.6)
    strong = known & (np.abs(field) > 0.2 * limit)
    assert np.all((pixels[strong][:, 0] > pixels[strong][:, 2]) == (field[strong] > 0))


def test_film_shows_the_obstacle(
    running: Browser, board: Board, tmp_path: Path
) -> None:
    """The truth and the prediction have a disc where the obstacle stands, and nothing
    beside it.
    """
    tab = board.tabs[0]
    rows = []
    for row in tab.rows:
        assert row.pictures is not None
        # all particles stand in a corner, away from the disc
        film = 0.1 * np.asarray(row.pictures.film)
        pictures = replace(row.pictures, film=film, obstacle=(0.25, 0.75, 0.125))
        rows.append(replace(row, pictures=pictures))
    path = tmp_path / "index.html"
    path.write_text(
        render(replace(board, tabs=(replace(tab, rows=tuple(rows)),))),
        encoding="utf-8",
    )
    opened = running.open(path, width=1280)
    still(opened)
    restored(opened, "#tab=cavity-full&entry=gns")
    opacities = opened.value(
        "[...document.querySelectorAll('#panel canvas.film')].flatMap(c => "
        "[[0.25, 0.25], [0.25, 0.145], [0.35, 0.25], [0.25, 0.1], [0.4, 0.25]]"
        ".map(([x, y]) => c.getContext('2d')"
        ".getImageData(c.width * x, c.height * y, 1, 1).data[3]))"
    )
    assert opacities == 2 * [255, 255, 255, 0, 0]
    close(opened)


@pytest.mark.slow
def test_film_plays_unless_motion_is_unwanted(page: Page) -> None:
    """With reduced motion it waits for Play; otherwise it starts; Pause stops it."""
    at = "Number(document.querySelector('#panel input[type=range]').value)"
    label = "document.querySelector('#panel .play').textContent"
    restored(page, "#tab=cavity-full&entry=gns")
    assert page.value(label) == "Play"
    assert page.value(at) == 0
    still(page, "no-preference")
    restored(page, "#tab=cavity-full&entry=gns")
    assert page.value(label) == "Pause"
    until(page, f"{at} > 0")
    run(page, "document.querySelector('#panel .play').click()")
    stopped = page.value(at)
    time.sleep(0.2)
    assert 0 < page.value(at) == stopped


def test_command_is_copied(page: Page, board: Board) -> None:
    """The button puts the exact command into the clipboard."""
    page.browser.call(
        "Browser.grantPermissions",
        permissions=["clipboardReadWrite", "clipboardSanitizedWrite"],
    )
    restored(page, "#tab=cavity-full&entry=gns")
    page.call("Page.bringToFront")
    page.call(
        "Runtime.evaluate",
        expression="document.querySelector('.copy').click()",
        userGesture=True,
    )
    until(page, "document.querySelector('.copy').textContent === 'Copied'")
    held = page.call(
        "Runtime.evaluate",
        expression="navigator.clipboard.readText()",
        awaitPromise=True,
    )
    row = next(row for row in board.tabs[0].rows if row.id == "gns")
    assert held["result"]["value"] == row.entry.command


def test_scatter_leads_to_entries(page: Page, board: Board) -> None:
    """Every entry with a cost is a dot that is a link; the best in both are joined."""
    restored(page, "#tab=cavity-full")
    dots: Any = page.value(
        "[...document.querySelectorAll('section:not([hidden]) [data-figure=cost] "
        "a.dot')]"
        ".map(a => [a.href.baseVal, a.classList.contains('best')])"
    )
    rows = [
        row for row in board.tabs[0].rows if row.active and row.entry.cost is not None
    ]
    assert len(dots) == len(rows)
    marks = {mark.name: (mark.seconds, mark.error) for mark in points_of(board.tabs[0])}
    points = {row.id: marks[row.entry.name] for row in rows}
    best = {
        i
        for i, (x, y) in points.items()
        if not any(a <= x and b <= y and (a, b) != (x, y) for a, b in points.values())
    }
    assert {href.partition("entry=")[2] for href, front in dots if front} == best
    press(page, "Tab")
    run(
        page,
        "document.querySelector('section:not([hidden]) [data-figure=cost] "
        "a.dot').focus()",
    )
    ring = "getComputedStyle(document.activeElement.querySelector('.reach')).stroke"
    assert page.value(ring) != "none"
    press(page, "Enter")
    until(page, "document.getElementById('panel').open")


@pytest.mark.slow
def test_hostile_text_does_nothing(
    running: Browser, board: Board, tmp_path: Path
) -> None:
    """Scripts, images and odd addresses in a submission show as text in table, panel
    and CSV.
    """
    tab = board.tabs[0]
    texts = dict.fromkeys(("command", "notes", "training", "name"), HOSTILE)
    bad = with_entry(
        tab.rows[0],
        **texts,
        hardware="{{script}}",
        authors=(HOSTILE, "__proto__", "\u202eright to left"),
        affiliation="=HYPERLINK(1)",
        code="javascript:console.error(3)",
        paper="data:text/html,<script>console.error(4)</script>",
    )
    flag = EntryFlag.model_construct(name="__proto__", reasons=(HOSTILE,), share=None)
    odd = bad.entry.score.files[0].model_copy(update={"flags": (flag,)})
    bad = with_entry(bad, score=bad.entry.score.model_copy(update={"files": (odd,)}))
    long = with_entry(tab.rows[1], name="=1+1" + "W" * 10_000)
    path = tmp_path / "index.html"
    shown = replace(board, tabs=(replace(tab, rows=(bad, long, *tab.rows[2:])),))
    path.write_text(render(shown), encoding="utf-8")
    page = running.open(path, width=390)
    still(page)
    for hash_ in ("", f"entry={bad.id}", f"entry={long.id}"):
        restored(page, f"#tab=cavity-full&{hash_}")
        assert page.value("document.images.length") == 0
        assert page.value("document.scripts.length") == 4
        assert page.value(
            "[...document.links].every(a => ['file:', 'https:'].includes(a.protocol))"
        )
        assert page.value("document.documentElement.scrollWidth") <= 390
        assert HOSTILE in page.value(
            "document.querySelector('section:not([hidden]) tr[data-entry] "
            ".name').textContent"
        )
        if hash_.endswith(bad.id):
            until(page, "document.getElementById('panel').open")
            assert HOSTILE in page.value(
                "document.querySelector('#panel h2').textContent"
            )
    assert page.messages == []
    assert {request.partition("#")[0] for request in page.requests} == {
        path.absolute().as_uri()
    }
    close(page)


@pytest.mark.slow
def test_fifty_entries_are_there_within_a_second(
    running: Browser, tmp_path: Path
) -> None:
    """Loading to a page that answers takes less than a second of processor time."""
    path = tmp_path / "index.html"
    path.write_text(
        render(make_board((("cavity", "full"),), entries=50, nodes=40)),
        encoding="utf-8",
    )
    page = running.open(path, width=1280)
    # the clock of a busy machine says nothing
    page.call("Performance.enable", timeDomain="threadTicks")
    restored(page, "#tab=cavity-full")
    told = {
        one["name"]: one["value"]
        for one in page.call("Performance.getMetrics")["metrics"]
    }
    assert len(names(page)) == 48
    assert 0.01 < told["TaskDuration"] < 1.0
    close(page)
