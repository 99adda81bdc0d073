"""The leaderboard's page as a file: bytes, HTML, what its script is given."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from board_worlds import make_board, with_entry
from html_check import read_html
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lagbench.board.entry import Cost, Flag, Weights
from lagbench.board.model import Board, Row
from lagbench.board.page import BUDGET, FEWEST, render
from lagbench.board.payload import (
    FINENESS,
    LEVELS,
    coarse,
    embedded,
    pack,
    pack_film,
    payload,
)
from lagbench.board.table import MOST_REASONS
from lagbench.figures.html import text

DIGITS = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_"

HOSTILE = "</script><script>console.error(1)</script><img src=http://example.com/x onerror=alert(1)>\u2028"


@pytest.fixture(scope="module")
def board() -> Board:
    """Two tabs of eight entries."""
    return make_board((("cavity", "full"), ("fluid", "mini")))


@pytest.fixture(scope="module")
def page(board: Board) -> str:
    """Its page."""
    return render(board)


def with_rows(board: Board, *rows: Row, **changes: Any) -> str:
    """Return the page of the first tab with other rows."""
    return render(replace(board, tabs=(replace(board.tabs[0], rows=rows, **changes),)))


def unpack(packed: list[Any]) -> NDArray[np.float64]:
    """Read packed numbers back, letter by letter."""
    letters, low, high, log = packed
    steps = [
        64 * DIGITS.index(a) + DIGITS.index(b)
        for a, b in zip(letters[::2], letters[1::2], strict=True)
    ]
    share = np.array(steps) / LEVELS
    values = low * (high / low) ** share if log else low + (high - low) * share
    return np.where(share > 1.0, np.nan, values)


def unpack_film(packed: list[Any]) -> NDArray[np.float64]:
    """Read a film back: a first frame as above, then one letter a number beside
    constant velocity.
    """
    letters, low, high, kind, count, reach = packed
    assert kind == 2
    frames = [unpack([letters[: 2 * count], low, high, 0])]
    for at in range(2 * count, len(letters), count):
        steps = np.array(
            [DIGITS.index(letter) - 31 for letter in letters[at : at + count]]
        )
        before = frames[-2] if len(frames) > 1 else frames[-1]
        frames.append(
            2 * frames[-1] - before + reach * np.sign(steps) * (steps / 31) ** 2
        )
    return np.concatenate(frames)


def held_by(page: str) -> Any:
    """Return what the page's script is given."""
    (found,) = re.findall(
        r'<script type="application/json" id="board">(.*?)</script>', page, re.DOTALL
    )
    return json.loads(found)


@given(
    # Taichi, once started in this process, makes its thread round subnormals to zero.
    st.lists(
        st.floats(-1e6, 1e6, allow_subnormal=False) | st.just(float("nan")),
        min_size=1,
        max_size=40,
    ),
    st.booleans(),
)
@example([sys.float_info.min], True)
def test_packed_numbers_come_back(values: list[float], log: bool) -> None:
    """Unpacked values lie within half a step, or half a step of the logarithm, and gaps
    stay gaps.
    """
    x = np.array(values)
    packed: list[Any] = pack(x, log=log)
    _, low, high, logarithmic = packed
    back = unpack(packed)
    np.testing.assert_array_equal(np.isnan(back), np.isnan(x))
    known = ~np.isnan(x)
    if logarithmic:
        positive = known & (x >= low)
        bound = np.log(high / low) / LEVELS if high > low else 0.0
        assert np.all(np.abs(np.log(back[positive] / x[positive])) <= bound + 2e-5)
    else:
        room = 0.5 * (high - low) / LEVELS + 1e-5 * (1 + abs(x[known]))
        assert np.all(np.abs(back[known] - x[known]) <= room)


@given(st.floats(-1.0, 1.0), st.floats(-5e-3, 5e-3), st.floats(0.0, 3e-2))
def test_films_come_back(speed: float, pull: float, kick: float) -> None:
    """Rounding does not add up: letters are at most 61 / 31^2 of the reach apart, half
    of it may be off.
    """
    t = np.arange(40.0)
    moved = 0.5 + 0.01 * speed * t + 0.05 * pull * t**2
    film = np.stack([moved, np.full(40, 0.25), moved + kick * (t > 20)], axis=1)
    packed = pack_film(np.stack([film, film], axis=-1))
    back = unpack_film(packed).reshape(40, 3, 2)
    reach = float(packed[5])
    assert reach < 1.2 * max(0.011, abs(kick) + 0.001)
    assert (
        np.abs(back - film[..., None]).max()
        <= max(0.5 * 2.0 / LEVELS, 0.5 * 61 / 31**2 * reach) + 1e-9
    )


def test_coarse_field_keeps_its_mean() -> None:
    """Blocks average the known nodes: 4 x 4 nodes become 2 x 2, worked by hand."""
    field = np.arange(16.0).reshape(4, 4)
    field[0, 0] = np.nan
    # upper left block: 1, 4, 5 are known, mean 10/3
    np.testing.assert_allclose(coarse(field, 2), [[10 / 3, 4.5], [10.5, 12.5]])
    np.testing.assert_array_equal(coarse(field, 4), field)


def test_board_arrives_at_the_script(board: Board, page: str) -> None:
    """Curves and films are what the board holds, up to the steps of their packing."""
    held = held_by(page)
    pool = held["pool"]
    assert [tab["id"] for tab in held["tabs"]] == ["cavity-full", "fluid-mini"]
    for tab, shown in zip(board.tabs, held["tabs"], strict=True):
        for row, given_row in zip(tab.rows, shown["rows"], strict=True):
            curve = row.curves[tab.curves[0]]
            packed = given_row["curves"][tab.curves[0]]
            assert pool[packed["frames"]] == list(curve.frames)
            np.testing.assert_allclose(
                unpack(pool[packed["mean"]]), curve.mean, rtol=2e-3
            )
            film = unpack_film(pool[given_row["pictures"]["film"]])
            count = len(pool[given_row["pictures"]["material"]])
            np.testing.assert_allclose(film[:2], row.pictures.film[0, 0], atol=3e-4)
            np.testing.assert_allclose(film[-2:], row.pictures.film[-1, -1], atol=1e-3)
            assert film.size == 2 * count * len(
                pool[given_row["pictures"]["filmFrames"]]
            )


def test_equal_boards_give_equal_bytes(page: str) -> None:
    """A board made anew gives the same page, well-formed, which names no time and no
    folder.
    """
    assert render(make_board((("cavity", "full"), ("fluid", "mini")))) == page
    assert read_html(page).faults == []
    assert not re.search(r"/home/|/tmp/|/root/|\d\d:\d\d:\d\d", page)


def lines_of(page: str) -> dict[str, dict[str, str]]:
    """Return name to column to value of the first table's rows, read as text."""
    table = page[
        page.index('<table class="board"') if '<table class="board"' in page else 0 :
    ]
    table = table[table.index('class="board">') : table.index("</table>")]
    keys = re.findall(r'<button [^>]*?data-sort="([^"]*)"', table)
    found = {}
    for line in re.findall(r"<tr[^>]*>.*?</tr>", table)[1:]:
        cells = re.findall(r"<t[dh]([^>]*)>", line)
        values = {
            k: re.search(r'data-value="([^"]*)"', c)
            for k, c in zip(keys, cells, strict=True)
        }
        found[values["name"][1]] = {k: v[1] for k, v in values.items() if v}  # type: ignore[index]
    return found


def test_every_number_stands_in_the_table(board: Board, page: str) -> None:
    """Every metric of every row is the value of a cell, to nine digits; entries say who
    scored them.
    """
    tab = board.tabs[0]
    lines = lines_of(page[page.index('id="cavity-full"') :])
    assert len(lines) == len(tab.lines)
    for row in tab.lines:
        name = row.name if hasattr(row, "name") else row.entry.name
        cells = lines[name.lower()]
        for metric, value in row.values.items():
            told = float(cells.get(metric, "nan"))
            assert told == pytest.approx(value.mean, rel=1e-8, nan_ok=True)
        if isinstance(row, Row):
            assert cells["checked"] == ("verified" if row.verified else "as submitted")


def test_the_overview_is_ordered_by_the_column_that_stands_first(
    board: Board, page: str
) -> None:
    """The mean skill, 0 where a method has no entry, the largest first; who has no
    skill comes last.
    """
    table = page[page.index('class="board across"') :]
    table = table[table.index("<tbody>") : table.index("</tbody>")]
    shown = {}
    for line in re.findall(r"<tr>.*?</tr>", table):
        name, first = re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", line)[:2]
        shown[name] = re.findall(r">([^<>]+)<", first)
    skills: dict[str, list[float]] = {}
    for row in (row for tab in board.tabs for row in tab.rows if row.rank is not None):
        skills.setdefault(row.entry.name, []).extend(
            [row.skill.mean] if row.skill else []
        )
    assert shown.keys() == skills.keys()
    means = [sum(skills[name]) / 2 if skills[name] else -math.inf for name in shown]
    assert means == sorted(means, reverse=True)
    for name, mean in zip(shown, means, strict=True):
        assert shown[name] == [
            text(mean if skills[name] else math.nan),
            f"{len(skills[name])} of 2",
        ]


def test_floors_are_judged_like_entries(board: Board) -> None:
    """A floor that is better than every entry takes the bold, and the deepest colour,
    from them.
    """
    tab = board.tabs[0]
    floor = tab.floors[0]
    best = {name: replace(value, mean=1e-9) for name, value in floor.values.items()}
    page = with_rows(
        board, *tab.rows, floors=(replace(floor, values=best), *tab.floors[1:])
    )
    (first,) = re.findall(r"<tbody>(<tr class=\"floor\"[^>]*>.*?</tr>)", page)
    assert f'data-floor="{floor.name}"' in first
    assert (
        re.findall(r'<td class="([^"]*)"[^>]*data-value="1e-09"', first)[0]
        == "best heat0"
    )
    assert '<td class="rank" data-value="0"></td>' in first


def test_beside_and_beyond_an_aim_do_not_cancel(board: Board) -> None:
    """Energy ratios 0 and 2 have the mean 1 and are no aim reached: 0.9 and 0.9 are
    nearer.
    """
    rows = []
    for row, scenarios in zip(
        board.tabs[0].rows, ((0.0, 2.0), (0.9, 0.9), (0.5, 0.5)), strict=False
    ):
        value = replace(
            row.values["energy_ratio"], mean=sum(scenarios) / 2, per_scenario=scenarios
        )
        rows.append(replace(row, values={**row.values, "energy_ratio": value}))
    page = with_rows(board, *rows, floors=())
    cells = re.findall(
        r'<td(?: class="([^"]*)")?[^>]*data-value="(1|0.9|0.5)" data-loss="([^"]*)"',
        page,
    )
    found = {
        value: ("best" in kind, pytest.approx(float(loss)))
        for kind, value, loss in cells
    }
    assert found == {"1": (False, 1.0), "0.9": (True, 0.1), "0.5": (False, 0.5)}


def test_rows_lead_to_code_paper_and_weights(board: Board, page: str) -> None:
    """A link each where the entry has one, and to nothing but the web.

    Weights beside the entry have one a seed, to where the leaderboard's folder keeps
    them.
    """
    for row in board.tabs[0].rows:
        line = re.findall(f'<tr[^>]*data-entry="{row.id}".*?</tr>', page)[0]
        links = re.findall(r'<a href="(http[^"]*)"[^>]*>(\w+)</a>', line)
        wanted = {key: getattr(row.entry, key) for key in ("code", "paper", "weights")}
        assert {name: address for address, name in links} == {
            k: v for k, v in wanted.items() if v
        }
    bad = with_entry(board.tabs[0].rows[0], code="javascript:alert(1)")
    assert 'href="javascript' not in with_rows(board, bad)
    row = board.tabs[0].rows[0]
    score = row.entry.score.model_copy(update={"files": 2 * row.entry.score.files[:1]})
    weights = Weights(path="x", sha256="0" * 64)
    made = row.entry.predictions[0]
    kept = tuple(
        made.model_copy(update={"seed": seed, "weights": weights}) for seed in (0, 1)
    )
    row = with_entry(row, predictions=kept, score=score, weights=None)
    page = with_rows(board, replace(row, seed_means=2 * row.seed_means[:1]))
    place = "/".join(row.entry.place)
    assert re.findall(r'href="(weights/[^"]*)"', page) == [
        f"weights/{place}_{seed}.pt" for seed in (0, 1)
    ]


def test_skill_below_nothing_is_not_shaded_as_skill(board: Board) -> None:
    """Skills of 0.8, 0.1 and -50: the first is the deepest, the second far from it, the
    last the palest.
    """
    rows = [
        replace(row, skill=replace(row.skill, mean=skill))
        for row, skill in zip(board.tabs[0].rows, (0.8, 0.1, -50.0), strict=False)
        if row.skill
    ]
    page = with_rows(board, *rows, floors=())
    shades = re.findall(
        r'<td class="(?:[^"]* )?(\w+)"[^>]*data-value="(0\.8|0\.1|-50)"', page
    )
    assert set(shades) == {("heat0", "0.8"), ("heat4", "0.1"), ("heat4", "-50")}


def test_a_warning_tells_a_few_reasons_and_a_flag_all(board: Board) -> None:
    """Scenarios that jump say the same with other numbers; every reason to suspect a
    copy is another.
    """
    reasons = tuple(f"reason {number}" for number in range(9))
    row = board.tabs[0].rows[0]
    names = {"flags": "copy_suspect", "warnings": "max_displacement"}
    raised = {kind: (Flag(name=name, reasons=reasons),) for kind, name in names.items()}
    files = (row.entry.score.files[0].model_copy(update=raised),)
    page = with_rows(
        board,
        with_entry(row, score=row.entry.score.model_copy(update={"files": files})),
    )
    titles = [e.attributes.get("title") or "" for e in read_html(page).named("span")]
    assert sorted(title.count("reason") for title in titles)[-2:] == [
        MOST_REASONS,
        len(reasons),
    ]


def test_costs_are_marked_as_self_reported(board: Board, page: str) -> None:
    """Headings of what nothing can compute again say so; scores do not."""
    heads = [
        e for e in read_html(page).named("button") if e.attributes.get("data-sort")
    ]
    marked = {
        e.attributes["data-sort"] for e in heads if "self\u2011reported" in e.text
    }
    assert marked == {
        *(
            "speed_up",
            "seconds_per_frame",
            "solver_seconds_per_frame",
            "parameters",
            "device",
        ),
        *("budget", "track", "windows", "epochs", "cpu_hours", "gpu_hours"),
    }


@pytest.mark.parametrize(("speed", "said"), [(0.1, "slower"), (17.25, "faster")])
def test_speed_is_told_against_the_solver(
    board: Board, speed: float, said: str
) -> None:
    """The tile of the fastest entry says what 1 stands for, and on which side of it the
    entry is.
    """
    cost = Cost(
        seconds_per_frame=2.0, device="a machine", solver_seconds_per_frame=2.0 * speed
    )
    page = with_rows(board, with_entry(board.tabs[0].rows[0], cost=cost))
    (tile,) = [e.text for e in read_html(page).named("li") if "fastest" in e.text]
    assert f"{said} than the solver" in tile
    assert "self-reported" in tile


def test_policy_allows_only_our_script_and_style(page: str) -> None:
    """The policy forbids all but the hashes of what the page holds; nothing in it runs
    by itself.
    """
    policy = read_html(page).named("meta")[1].attributes["content"]
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy
    inline = re.findall(r"<(script|style)>(.*?)</\1>", page, re.DOTALL)
    assert [name for name, _ in inline] == ["style", "script", "script"]
    digests = [
        base64.b64encode(hashlib.sha256(body.encode()).digest()).decode()
        for _, body in inline
    ]
    assert all(f"'sha256-{digest}'" in policy for digest in digests)
    assert not re.search(r"""src=["']?(https?:)?//""", page)
    assert [e.attributes.get("rel") for e in read_html(page).named("link")] == ["icon"]
    assert not re.search(
        r"url\(|@import|innerHTML|eval\(|\bfetch\(|XMLHttpRequest|new Function", page
    )


def test_hostile_text_stays_text(board: Board) -> None:
    """Whatever a name holds, the page has the same elements as without it."""
    first = board.tabs[0].rows[0]
    bad = with_entry(
        first, name=HOSTILE, authors=(HOSTILE,), affiliation=HOSTILE, command=HOSTILE
    )
    page = with_rows(board, bad)
    names = [element.name for element in read_html(page).elements]
    assert names == [
        element.name for element in read_html(with_rows(board, first)).elements
    ]
    assert held_by(page)["tabs"][0]["rows"][0]["command"] == HOSTILE
    assert "\u2028" not in page.split('id="board">')[1]


@given(st.text())
def test_any_text_survives_embedding(text: str) -> None:
    """JSON in HTML reads back as it was and holds nothing that could end its
    element.
    """
    said = embedded({"text": text})
    assert not set("<>&\u2028\u2029") & set(said)
    assert json.loads(said)["text"] == text


@pytest.mark.parametrize("entries", [16, 25, 32])
def test_many_entries_fit(entries: int) -> None:
    """On two splits: up to fifty entries in at most 2 MB, more in as much for each."""
    size = len(
        render(
            make_board((("cavity", "full"), ("fluid", "full")), entries=entries)
        ).encode()
    )
    assert size <= BUDGET * max(FEWEST, 2 * entries)
    assert BUDGET * FEWEST <= 2_000_000


def test_finer_is_longer(board: Board) -> None:
    """Each step of fineness is shorter than the one before, so that the search may
    halve.
    """
    one = replace(board, tabs=board.tabs[:1])
    sizes = [len(embedded(payload(one, fineness))) for fineness in FINENESS]
    assert sizes == sorted(sizes, reverse=True)


def test_boards_without_entries_or_skill_are_pages() -> None:
    """A board without entries has no tabs, and names what could be begun and how.

    Score files that do not say a skill leave no gap on the page.
    """
    page = render(
        Board(tabs=(), empty=(("cavity", "mini"), ("fluid", "full")), metrics={})
    )
    reading = read_html(page)
    assert reading.faults == []
    assert "cavity mini, fluid full" in page
    assert "lagbench generate --split cavity --size mini" in page
    assert reading.named("table") == []
    assert 'role="tab' not in page
    page = render(make_board((("cavity", "full"),), skill=False))
    assert 'data-sort="skill"' not in page
    assert read_html(page).faults == []
