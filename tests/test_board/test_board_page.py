"""The leaderboard's page as a file: content, HTML, the data of its script."""

from __future__ import annotations

import base64
import hashlib
import math
import re
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from html_check import Element, read_html
from numpy.testing import assert_allclose
from page_reader import element_text, read_page_data
from sample_boards import make_board, with_entry

from lagbench.board.columns import columns_of
from lagbench.board.entry import EntryCost, EntryFlag, Weights
from lagbench.board.model import Board, BoardRow, Tab
from lagbench.board.overview import conclude, find_hero, make_overviews
from lagbench.board.page import render, same_page
from lagbench.board.table_view import MOST_REASONS, Cell, make_table

HOSTILE = (
    "</script><script>console.error(1)</script>"
    "<img src=http://example.com/x onerror=alert(1)>\u2028"
)
DATA_SETS = (("cavity", "full"), ("fluid", "mini"))


@pytest.fixture(scope="module")
def board() -> Board:
    """Two tabs of eight entries."""
    return make_board(DATA_SETS)


@pytest.fixture(scope="module")
def page(board: Board) -> str:
    """The page of the board."""
    return render(board)


def first_tab(board: Board, *rows: BoardRow, **changes: Any) -> Tab:
    """Return the first tab with other rows."""
    return replace(board.tabs[0], rows=rows, **changes)


def with_rows(board: Board, *rows: BoardRow, **changes: Any) -> str:
    """Return the page of the first tab with other rows."""
    return render(replace(board, tabs=(first_tab(board, *rows, **changes),)))


def cells_of(board: Board, tab: Tab, key: str) -> list[Cell]:
    """Return the cells of a column, in the order of the table."""
    view = make_table(tab, board.metrics)
    return [line.cells[key] for line in view.lines]


def test_curves_and_films_arrive_at_the_script(board: Board, page: str) -> None:
    """They are what the board holds, up to the steps of their encoding."""
    data = read_page_data(page)
    assert [tab["id"] for tab in data.tabs] == ["cavity-full", "fluid-mini"]
    for tab, plain_tab in zip(board.tabs, data.tabs, strict=True):
        plain_rows = {row["id"]: row for row in plain_tab["rows"]}
        for row in tab.rows:
            plain_row = plain_rows[row.id]
            curve = row.curves[tab.curves[0]]
            plain_curve = plain_row["curves"][tab.curves[0]]
            frames = data.array(plain_curve["frames"])[:, 0]
            assert frames.tolist() == list(curve.frames)
            values = data.array(plain_curve["values"])
            assert_allclose(values[:, 0], curve.mean, rtol=2e-3)
            assert_allclose(values[:, 1], curve.low, rtol=2e-3)
            assert_allclose(values[:, 2], curve.high, rtol=2e-3)

            pictures = plain_row["pictures"]
            film = data.array(pictures["film"])
            film = film.reshape(len(pictures["filmFrames"]), -1, 2)
            assert film.shape[1] == len(pictures["material"])
            first_particle = row.pictures.film[0, 0]
            last_particle = row.pictures.film[-1, -1]
            assert_allclose(film[0, 0], first_particle, atol=6e-4)
            assert_allclose(film[-1, -1], last_particle, atol=6e-4)


def test_every_number_arrives_at_the_script(board: Board, page: str) -> None:
    """Every metric of every row, to nine digits; entries tell who scored them."""
    tab = board.tabs[0]
    plain_tab = read_page_data(page).tabs[0]
    keys = [column["key"] for column in plain_tab["columns"]]
    assert keys == list(columns_of(tab, board.metrics))
    plain_rows = {row["id"]: row for row in plain_tab["rows"]}
    plain_references = {row["id"]: row for row in plain_tab["references"]}
    assert len(plain_rows) + len(plain_references) == len(tab.lines)
    for row in tab.lines:
        if isinstance(row, BoardRow):
            plain_row = plain_rows[row.id]
        else:
            plain_row = plain_references[row.name]
        values = dict(zip(keys, plain_row["values"], strict=True))
        for metric, value in row.values.items():
            number = values[metric]
            if number is None:
                number = math.nan
            assert number == pytest.approx(value.mean, rel=1e-8, nan_ok=True)
        if isinstance(row, BoardRow):
            expected = "scored again" if row.verified else "as submitted"
            assert values["checked"] == expected


def test_equal_boards_give_equal_pages(page: str) -> None:
    """The page is well-formed and names no time and no folder."""
    assert render(make_board(DATA_SETS)) == page
    assert read_html(page).faults == []
    assert not re.search(r"/home/|/tmp/|/root/|\d\d:\d\d:\d\d", page)


def test_pages_are_compared_by_content(page: str) -> None:
    """Another zlib gives other bytes; another content, a bomb or no data differ."""
    text_of_data = element_text(page, "page-data")
    content = zlib.decompress(base64.b64decode(text_of_data), wbits=31)

    def with_data(data: bytes, level: int) -> bytes:
        compressor = zlib.compressobj(level, wbits=31)
        compressed = compressor.compress(data) + compressor.flush()
        new_text = base64.b64encode(compressed).decode()
        return page.replace(text_of_data, new_text).encode()

    original = page.encode()
    other_zlib = with_data(content, 1)
    assert other_zlib != original
    assert same_page(other_zlib, original)
    assert not same_page(with_data(content + b" ", 1), original)
    assert not same_page(with_data(bytes(10 * len(content)), 9), original)
    assert not same_page(page.replace(text_of_data, "").encode(), original)
    assert not same_page(original.replace(b"GNS", b"GNs", 1), original)
    assert not same_page(b"another file", original)


def row_of(board: Board, name: str, method: str, **changes: Any) -> BoardRow:
    """Return the first row of a board under another name, with other skills."""
    row = with_entry(board.tabs[0].rows[0], name=name, method=method)
    return replace(row, **changes)


def test_only_methods_that_ran_everything_have_a_place(board: Board) -> None:
    """They stand in the order of their mean skill; the others follow, whatever their
    skill, and say what is missing. Not running a data set is no advantage.
    """
    skills = {
        "steady": (0.5, 0.4),
        "uneven": (0.9, -0.3),
        "picky": (0.99, None),
    }
    ranks = {
        "steady": 1,
        "uneven": 2,
        "picky": 3,
    }
    tabs = []
    for number, split in enumerate(("cavity", "fluid")):
        tab = make_board(((split, "mini"),)).tabs[0]
        value = tab.rows[0].values[tab.ranking]
        rows = []
        for method, rank in ranks.items():
            mean = skills[method][number]
            if mean is not None:
                skill = replace(value, mean=mean)
                rows.append(row_of(board, method, method, skill=skill, rank=rank))
        tabs.append(replace(tab, rows=tuple(rows)))
    (overview,) = make_overviews(replace(board, tabs=tuple(tabs)))
    places = []
    for method in overview.methods:
        places.append((method.method, method.rank, method.missing))
    assert places == [
        ("steady", 1, ()),
        ("uneven", 2, ()),
        ("picky", None, ("fluid",)),
    ]
    means = [method.mean_skill for method in overview.methods]
    assert means == pytest.approx([0.45, 0.3, 0.99])
    page = render(replace(board, tabs=tuple(tabs)))
    assert "not on fluid" in page


def test_the_places_over_all_data_sets_are_ranges(board: Board) -> None:
    """Two methods that win in turn share places; a third far behind does not."""
    tab = make_board((("cavity", "mini"),)).tabs[0]
    value = tab.rows[0].values[tab.ranking]
    rng = np.random.Generator(np.random.PCG64(3))
    first_noise, second_noise = rng.random((2, len(tab.scenarios)))
    losses_of_methods = {
        "a": 1.0 + second_noise,
        "b": 1.0 + first_noise,
        "c": 9.0 + second_noise,
    }
    rows = []
    for method, losses in losses_of_methods.items():
        skill = replace(value, mean=1.0 - losses.mean() / 10)
        row = row_of(board, method, method, losses=losses[None], skill=skill)
        rows.append(replace(row, rank=len(rows) + 1))
    naive_value = replace(value, mean=10.0)
    naive = replace(tab.references[0], values={tab.ranking: naive_value})
    tab = replace(tab, rows=tuple(rows), references=(naive,))
    (overview,) = make_overviews(replace(board, tabs=(tab,)))
    ranges = {method.method: method.rank_range for method in overview.methods}
    assert ranges["c"] == (3, 3)
    assert ranges["a"] == ranges["b"] == (1, 2)


@pytest.mark.parametrize(
    ("low", "ratio", "high", "beginning"),
    [
        (1.1, 1.5, 1.9, "Learning does not pay on cavity full"),
        (0.8, 1.5, 1.9, "Whether learning pays on cavity full is open"),
        (0.8, 0.9, 1.1, "Whether learning pays on cavity full is open"),
        (0.4, 0.5, 0.6, "Learning pays on cavity full"),
    ],
)
def test_a_sentence_says_whether_learning_pays(
    board: Board,
    low: float,
    ratio: float,
    high: float,
    beginning: str,
) -> None:
    """It follows from the best ratio of any active entry that learns."""
    row = board.tabs[0].rows[0]
    value = replace(row.values["position_rmse"], mean=ratio, low=low, high=high)
    worse = replace(value, mean=9.0, high=10.0)
    rows = (
        replace(row, against_classical=worse, solver="projection"),
        replace(row, against_classical=value, solver="projection"),
    )
    tab = first_tab(board, *rows)
    assert conclude(tab).startswith(beginning)
    assert conclude(first_tab(board, row)) == ""


def test_variants_have_no_film(board: Board) -> None:
    """Their method has; the page would become too long."""
    head, variant = board.tabs[0].rows[:2]
    variant = replace(variant, variant_of=head.id, rank=None)
    plain = read_page_data(with_rows(board, head, variant)).tabs[0]["rows"]
    assert plain[0]["pictures"] is not None
    assert plain[1]["pictures"] is None
    assert plain[1]["variantOf"] == head.id


def test_the_first_film_is_of_several_materials(board: Board) -> None:
    """It has all particles that are known, with a key; links say how to take part."""
    hero = find_hero(board)
    assert hero is not None
    tab, row = hero
    assert tab.size.split == "fluid"  # the sample has four materials there
    plain = read_page_data(render(board)).hero
    assert plain["entry"] == row.id
    assert len(plain["material"]) == row.pictures.film.shape[1]
    assert [name for _, name in plain["key"]] == ["liquid", "jelly", "snow", "rope"]


def test_the_first_film_shows_skill_where_there_is_any(board: Board) -> None:
    """A data set of many materials stands back while its best entry has no skill."""
    tabs = []
    for tab in board.tabs:
        rows = []
        for row in tab.rows:
            assert row.skill is not None
            if tab.size.split == "fluid":
                row = replace(row, skill=replace(row.skill, mean=-0.1))
            rows.append(row)
        tabs.append(replace(tab, rows=tuple(rows)))
    hero = find_hero(replace(board, tabs=tuple(tabs)))
    assert hero is not None
    assert hero[0].size.split == "cavity"


def test_references_are_judged_like_entries(board: Board) -> None:
    """A reference predictor that is better than every entry takes bold and colour."""
    tab = board.tabs[0]
    best = {}
    for name, value in tab.references[0].values.items():
        best[name] = replace(value, mean=1e-9)
    reference = replace(tab.references[0], values=best)
    other_references = tab.references[1:]
    changed = replace(tab, references=(reference, *other_references))
    first_line = make_table(changed, board.metrics).lines[0]
    assert first_line.row is reference
    assert first_line.cells[tab.ranking].classes == ("best", "heat0")
    page = render(replace(board, tabs=(changed,)))
    (opening_tag,) = re.findall(r"<tbody>(<tr class=\"reference\"[^>]*>)", page)
    assert f'data-reference="{reference.name}"' in opening_tag


def test_values_below_and_above_an_aim_do_not_cancel(board: Board) -> None:
    """Energy ratios 0 and 2 have the mean 1; 0.9 and 0.9 are nearer to the aim."""
    rows = []
    scenario_means = ((0.0, 2.0), (0.9, 0.9), (0.5, 0.5))
    for row, per_scenario in zip(board.tabs[0].rows, scenario_means, strict=False):
        mean = sum(per_scenario) / 2
        value = row.values["energy_ratio"]
        value = replace(value, mean=mean, per_scenario=per_scenario)
        rows.append(replace(row, values={**row.values, "energy_ratio": value}))
    tab = first_tab(board, *rows, references=())
    losses = {}
    best = []
    for cell in cells_of(board, tab, "energy_ratio"):
        losses[cell.value] = cell.loss
        if "best" in cell.classes:
            best.append(cell.value)
    assert losses == pytest.approx({1.0: 1.0, 0.9: 0.1, 0.5: 0.5})
    assert best == [0.9]


def line_of(page: str, row: BoardRow) -> str:
    """Return the line of an entry in the table."""
    return str(re.findall(f'<tr[^>]*data-entry="{row.id}".*?</tr>', page)[0])


def test_rows_lead_to_code_paper_and_weights(board: Board, page: str) -> None:
    """A link each where the entry has one, and to nothing but the web."""
    for row in board.tabs[0].rows:
        actual = re.findall(r'<a href="(http[^"]*)"[^>]*>(\w+)</a>', line_of(page, row))
        links = {label: address for address, label in actual}
        expected = {}
        for key in ("code", "paper", "weights"):
            address = getattr(row.entry, key)
            if address:
                expected[key] = address
        assert links == expected
    bad = with_entry(board.tabs[0].rows[0], code="javascript:alert(1)")
    assert 'href="javascript' not in with_rows(board, bad)


def test_weights_beside_the_entry_have_a_link_a_seed(board: Board) -> None:
    """The links lead to where the leaderboard's folder keeps them."""
    row = board.tabs[0].rows[0]
    files = 2 * row.entry.score.files[:1]
    score = row.entry.score.model_copy(update={"files": files})
    weights = Weights(path="x", sha256="0" * 64)
    prediction = row.entry.predictions[0]
    predictions = []
    for seed in (0, 1):
        update = {"seed": seed, "weights": weights}
        predictions.append(prediction.model_copy(update=update))
    row = with_entry(row, predictions=tuple(predictions), score=score, weights=None)
    seed_mean = row.seed_means[0]
    page = with_rows(board, replace(row, seed_means=(seed_mean, seed_mean)))
    place = "/".join(row.entry.place)
    expected = [f"weights/{place}_{seed}.pt" for seed in (0, 1)]
    assert re.findall(r'href="(weights/[^"]*)"', page) == expected


def test_skill_below_nothing_is_not_shaded_as_skill(board: Board) -> None:
    """Of skills 0.8, 0.1 and -50 the second is far from the first."""
    rows = []
    for row, skill in zip(board.tabs[0].rows, (0.8, 0.1, -50.0), strict=False):
        if row.skill:
            value = replace(row.skill, mean=skill)
            rows.append(replace(row, skill=value))
    tab = first_tab(board, *rows, references=())
    shades = {}
    for cell in cells_of(board, tab, "skill"):
        shades[cell.value] = cell.classes[-1]
    assert shades == {0.8: "heat0", 0.1: "heat4", -50.0: "heat4"}


def test_a_warning_shows_a_few_reasons_and_a_flag_all(board: Board) -> None:
    """Warnings of other scenarios say the same with other numbers."""
    reasons = tuple(f"reason {number}" for number in range(9))
    row = board.tabs[0].rows[0]
    update = {
        "flags": (EntryFlag(name="copy_suspect", reasons=reasons),),
        "warnings": (EntryFlag(name="max_displacement", reasons=reasons),),
    }
    file = row.entry.score.files[0].model_copy(update=update)
    score = row.entry.score.model_copy(update={"files": (file,)})
    page = with_rows(board, with_entry(row, score=score))
    counts = []
    for element in read_html(page).named("span"):
        title = element.attributes.get("title") or ""
        counts.append(title.count("reason"))
    assert sorted(counts)[-2:] == [MOST_REASONS, len(reasons)]


def sorters(page: str) -> list[Element]:
    """Return the headings of columns."""
    buttons = read_html(page).named("button")
    return [button for button in buttons if button.attributes.get("data-sort")]


def test_budgets_are_marked_as_self_reported(page: str) -> None:
    """Headings of what nobody can compute again say so; scores do not.

    Neither do times of a frame: they are measured or stated, row by row.
    """
    marked = set()
    for heading in sorters(page):
        if "self\u2011reported" in heading.text:
            marked.add(heading.attributes["data-sort"])
    assert marked == {
        "parameters",
        "budget",
        "track",
        "windows",
        "epochs",
        "cpu_hours",
        "gpu_hours",
    }


@pytest.mark.parametrize(("speed", "word"), [(0.1, "slower"), (17.25, "faster")])
def test_speed_is_told_against_the_solver(
    board: Board, speed: float, word: str
) -> None:
    """The tile of the fastest entry says on which side of the solver it is."""
    cost = EntryCost(
        seconds_per_frame=2.0, device="a machine", solver_seconds_per_frame=2.0 * speed
    )
    page = with_rows(board, with_entry(board.tabs[0].rows[0], cost=cost))
    items = [element.text for element in read_html(page).named("li")]
    (tile,) = [item for item in items if "fastest" in item]
    assert f"{word} than the solver" in tile
    assert "self-reported" in tile


def test_policy_allows_only_our_script_and_style(page: str) -> None:
    """The policy forbids all but the hashes of what the page holds."""
    policy = read_html(page).named("meta")[1].attributes["content"]
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy
    inline = re.findall(r"<(script|style)>(.*?)</\1>", page, re.DOTALL)
    assert [name for name, _ in inline] == ["style", "script", "script"]
    for _, body in inline:
        digest = hashlib.sha256(body.encode()).digest()
        assert f"'sha256-{base64.b64encode(digest).decode()}'" in policy
    assert not re.search(r"""src=["']?(https?:)?//""", page)
    links = read_html(page).named("link")
    assert [link.attributes.get("rel") for link in links] == ["icon"]
    forbidden = r"url\(|@import|innerHTML|eval\(|\bfetch\(|XMLHttpRequest|new Function"
    assert not re.search(forbidden, page)


def test_hostile_text_stays_text(board: Board) -> None:
    """Whatever a name holds, the page has the same elements as without it."""
    first = board.tabs[0].rows[0]
    bad = with_entry(
        first,
        name=HOSTILE,
        authors=(HOSTILE,),
        affiliation=HOSTILE,
        command=HOSTILE,
    )
    page = with_rows(board, bad)
    names = [element.name for element in read_html(page).elements]
    plain = read_html(with_rows(board, first))
    assert names == [element.name for element in plain.elements]
    assert read_page_data(page).tabs[0]["rows"][0]["command"] == HOSTILE


@pytest.mark.parametrize("entries", [16, 32])
def test_an_entry_takes_at_most_40_kilobytes(entries: int) -> None:
    """On two splits, the tables included."""
    data_sets = (("cavity", "full"), ("fluid", "full"))
    page = render(make_board(data_sets, entries=entries))
    assert len(page.encode()) <= 40_000 * 2 * entries


def test_a_board_without_entries_names_what_could_be_begun() -> None:
    """It has no tabs, and shows the commands."""
    empty = (("cavity", "mini"), ("fluid", "full"))
    page = render(Board(tabs=(), empty=empty, metrics={}))
    reading = read_html(page)
    assert reading.faults == []
    assert "cavity mini, fluid full" in page
    assert "lagbench generate --split cavity --size mini" in page
    assert reading.named("table") == []
    assert 'role="tab' not in page


def test_score_files_without_a_skill_leave_no_gap() -> None:
    """There is no column of skills."""
    page = render(make_board((("cavity", "full"),), skill=False))
    assert 'data-sort="skill"' not in page
    assert read_html(page).faults == []
