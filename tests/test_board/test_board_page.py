"""The leaderboard's page as a file: content, HTML, the data of its script."""

from __future__ import annotations

import base64
import datetime
import hashlib
import math
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from html_check import Element, read_html
from numpy.testing import assert_allclose
from page_reader import element_text, read_page_data
from sample_boards import make_board, with_entry

from lagbench.board.build import picture_first
from lagbench.board.columns import columns_of
from lagbench.board.encoding import HARMLESS, decode
from lagbench.board.entry import (
    EntryCost,
    EntryFlag,
    Level,
    Reproduction,
    Status,
    Verification,
    Weights,
)
from lagbench.board.model import Board, BoardRow, Tab
from lagbench.board.overview import (
    SizeOverview,
    find_hero,
    make_overviews,
)
from lagbench.board.page import render, same_page
from lagbench.board.show import tables
from lagbench.board.table_view import MOST_REASONS, Cell, make_table
from lagbench.figures.solid import View
from lagbench.references.predictor import Kind

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


def page_of(board: Board, *tabs: Tab) -> str:
    """Return the page of a board with other tabs."""
    return render(replace(board, tabs=tabs))


def with_rows(board: Board, *rows: BoardRow) -> str:
    """Return the page of the first tab with other rows."""
    return page_of(board, first_tab(board, *rows))


def row_data_of(page: str) -> list[dict[str, Any]]:
    """Return what the script reads of the rows of the first tab."""
    first = read_page_data(page).tabs[0]
    rows: list[dict[str, Any]] = first["rows"]
    return rows


def by_id(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return what the script reads of rows by their ids."""
    return {row["id"]: row for row in rows}


def cells_of(board: Board, tab: Tab, key: str) -> list[Cell]:
    """Return the cells of a column, in the order of the table."""
    view = make_table(tab, board.metrics)
    return [line.cells[key] for line in view.lines]


def test_curves_and_films_arrive_at_the_script(board: Board, page: str) -> None:
    """They are what the board holds, up to the steps of their encoding."""
    data = read_page_data(page)
    tab_ids = [tab["id"] for tab in data.tabs]
    assert tab_ids == ["cavity-full", "fluid-mini"]
    for tab, plain_tab in zip(board.tabs, data.tabs, strict=True):
        plain_rows = by_id(plain_tab["rows"])
        name_of_curve = tab.curves[0]
        for row in tab.rows:
            plain_row = plain_rows[row.id]
            curve = row.curves[name_of_curve]
            plain_curve = plain_row["curves"][name_of_curve]
            frames = data.array(plain_curve["frames"])
            assert frames[:, 0].tolist() == list(curve.frames)
            values = data.array(plain_curve["values"])
            mean, low, high = values.T
            assert_allclose(mean, curve.mean, rtol=2e-3)
            assert_allclose(low, curve.low, rtol=2e-3)
            assert_allclose(high, curve.high, rtol=2e-3)

            pictures = plain_row["pictures"]
            film = data.array(pictures["film"])
            frame_count = len(pictures["filmFrames"])
            film = film.reshape(frame_count, -1, 2)
            assert film.shape[1] == len(pictures["material"])
            first_particle = row.pictures.film[0, 0]
            last_particle = row.pictures.film[-1, -1]
            assert_allclose(film[0, 0], first_particle, atol=6e-4)
            assert_allclose(film[-1, -1], last_particle, atol=6e-4)


def test_the_obstacle_of_a_film_arrives_at_the_script() -> None:
    """Place and radius of the first film and of each film; else there is none."""
    board = make_board((("cavity", "mini"),), entries=3)
    row_without = read_page_data(render(board)).tabs[0]["rows"][0]
    assert row_without["pictures"]["obstacle"] is None

    disc = (0.25, 0.5, 0.046875)
    tab = board.tabs[0]
    rows = []
    for row in tab.rows:
        assert row.pictures is not None
        pictures = replace(row.pictures, obstacle=disc)
        rows.append(replace(row, pictures=pictures))
    data = read_page_data(with_rows(board, *rows))
    for row_data in data.tabs[0]["rows"]:
        assert row_data["pictures"]["obstacle"] == [0.25, 0.5, 0.04688]
    assert data.hero is not None
    assert data.hero["obstacle"] == [0.25, 0.5, 0.04688]


def test_the_periods_of_a_film_arrive_at_the_script() -> None:
    """One step in the picture per periodic axis; a box with walls has none."""
    for split, expected in (
        ("cavity", []),
        ("poiseuille", [[1.0, 0.0], [0.0, 1.0]]),
        ("cylinder", [[1.0, 0.0]]),
    ):
        board = make_board(((split, "mini"),), entries=3)
        assert read_page_data(render(board)).tabs[0]["periods"] == expected

    board = make_board((("curl-noise-3d", "mini"),), entries=3)
    periods = read_page_data(render(board)).tabs[0]["periods"]
    view = View(board.tabs[0].size.box)
    corner = view.place(np.zeros(3))
    for axis in range(3):
        end = view.place(np.eye(3)[axis])
        assert_allclose(periods[axis], end - corner, atol=1e-4)


def test_every_number_arrives_at_the_script(board: Board, page: str) -> None:
    """Every metric of every row, to nine digits, and who scored each entry."""
    tab = board.tabs[0]
    plain_tab = read_page_data(page).tabs[0]
    columns = columns_of(tab, board.metrics)
    keys = [column["key"] for column in plain_tab["columns"]]
    assert keys == list(columns)
    plain_rows = by_id(plain_tab["rows"])
    plain_references = by_id(plain_tab["references"])
    assert len(plain_rows) + len(plain_references) == len(tab.lines)
    for row in tab.lines:
        if isinstance(row, BoardRow):
            plain_row = plain_rows[row.id]
        else:
            plain_row = plain_references[row.name]
        numbers = zip(keys, plain_row["values"], strict=True)
        values = dict(numbers)
        for metric, value in row.values.items():
            number = values[metric]
            if number is None:
                number = math.nan
            expected = pytest.approx(value.mean, rel=1e-8, nan_ok=True)
            assert number == expected
        if isinstance(row, BoardRow):
            check = "scored again" if row.verified else "as submitted"
            assert values["checked"] == check


def test_equal_boards_give_equal_pages(page: str) -> None:
    """The page is well-formed and names no time and no folder."""
    assert render(make_board(DATA_SETS)) == page
    assert read_html(page).faults == []
    assert not re.search(r"/home/|/tmp/|/root/|\d\d:\d\d:\d\d", page)


def test_pages_are_compared_by_content(page: str) -> None:
    """Another zlib gives other bytes; another content, a bomb or no data differ."""
    text_of_data = element_text(page, "page-data")
    content = decode(text_of_data, longest=10**8)

    def with_text(text: str) -> bytes:
        return page.replace(text_of_data, text).encode()

    def with_data(data: bytes, level: int) -> bytes:
        compressor = zlib.compressobj(level, wbits=31)
        compressed = compressor.compress(data) + compressor.flush()
        encoded = base64.b85encode(compressed).translate(HARMLESS)
        return with_text(encoded.decode())

    original = page.encode()
    other_zlib = with_data(content, 1)
    assert other_zlib != original
    assert same_page(other_zlib, original)
    other_content = with_data(content + b" ", 1)
    assert not same_page(other_content, original)
    bomb = with_data(bytes(10 * len(content)), 9)
    assert not same_page(bomb, original)
    without_data = with_text("")
    assert not same_page(without_data, original)
    other_name = original.replace(b"GNS", b"GNs", 1)
    assert not same_page(other_name, original)
    assert not same_page(b"another file", original)


def row_of(board: Board, name: str, method: str, **changes: Any) -> BoardRow:
    """Return the first row of a board under another name, with other skills."""
    first_row = board.tabs[0].rows[0]
    row = with_entry(first_row, name=name, method=method)
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
        first_row = tab.rows[0]
        value = first_row.values[tab.ranking]
        rows = []
        for method, rank in ranks.items():
            mean = skills[method][number]
            if mean is not None:
                skill = replace(value, mean=mean)
                row = row_of(board, method, method, skill=skill, rank=rank)
                rows.append(row)
        tabs.append(replace(tab, rows=tuple(rows)))
    whole_board = replace(board, tabs=tuple(tabs))
    (overview,) = make_overviews(whole_board)
    places = []
    for method in overview.methods:
        place = (method.method, method.rank, method.missing)
        places.append(place)
    assert places == [
        ("steady", 1, ()),
        ("uneven", 2, ()),
        ("picky", None, ("fluid",)),
    ]
    means = [method.mean_skill for method in overview.methods]
    assert means == pytest.approx([0.45, 0.3, 0.99])
    overview_text = text_of_overview(render(whole_board))
    assert "on 1 of 2" in overview_text


def overview_of(
    board: Board, entries_by_split: Mapping[str, Mapping[str, str | None]]
) -> SizeOverview:
    """Return the overview of some data sets.

    Args:
        board: gives the rows.
        entries_by_split: method of which each entry is a variant; None for a method.
    """
    tabs = []
    for split, entries in entries_by_split.items():
        tab = make_board(((split, "mini"),)).tabs[0]
        rows = []
        for number, (entry, method) in enumerate(entries.items()):
            rank = None if method else number + 1
            rows.append(row_of(board, entry, entry, rank=rank, variant_of=method))
        tabs.append(replace(tab, rows=tuple(rows)))
    (overview,) = make_overviews(replace(board, tabs=tuple(tabs)))
    return overview


def lines_of(overview: SizeOverview) -> dict[str, list[str]]:
    """Return the data sets of each line by id; the line of a variant is indented."""
    lines = {}
    for method in overview.methods:
        lines[method.method] = list(method.rows)
        for variant in method.variants:
            lines[f"  {variant.method}"] = list(variant.rows)
    return lines


def test_a_variant_that_stands_alone_elsewhere_has_one_line(board: Board) -> None:
    """The line holds both data sets, and has no place: a variant has none."""
    overview = overview_of(
        board,
        {
            "cavity": {"gns": None, "gns-spread": "gns"},
            "fluid": {"gns-spread": None, "mlp": None},
        },
    )
    assert lines_of(overview) == {
        "gns": ["cavity-mini"],
        "  gns-spread": ["cavity-mini", "fluid-mini"],
        "mlp": ["fluid-mini"],
    }


def test_no_line_is_lost_where_methods_are_variants_too(board: Board) -> None:
    """A variant of a variant stands below the method; two variants of each other have a
    line each.
    """
    chain = overview_of(
        board,
        {
            "cavity": {"gns-x": None, "gns-x-y": "gns-x"},
            "fluid": {"gns": None, "gns-x": "gns"},
        },
    )
    assert lines_of(chain) == {
        "gns": ["fluid-mini"],
        "  gns-x": ["cavity-mini", "fluid-mini"],
        "  gns-x-y": ["cavity-mini"],
    }
    circle = overview_of(
        board, {"cavity": {"a": None, "b": "a"}, "fluid": {"b": None, "a": "b"}}
    )
    assert lines_of(circle) == {
        "a": ["cavity-mini", "fluid-mini"],
        "  b": ["cavity-mini", "fluid-mini"],
    }


def text_of_overview(page: str) -> str:
    """Return the text of the section of all data sets."""
    sections = read_html(page).named("section")
    (overview,) = [one for one in sections if one.attributes.get("id") == "overview"]
    return " ".join(overview.text.split())


def board_with(board: Board, methods: Mapping[tuple[str, str], Sequence[str]]) -> Board:
    """Return a board on which each data set has some methods, best first."""
    tabs = []
    for (split, size), names in methods.items():
        tab = make_board(((split, size),)).tabs[0]
        rows = []
        for number, name in enumerate(names):
            row = row_of(board, name, name.lower(), rank=number + 1)
            rows.append(replace(row, pictures=tab.rows[number].pictures))
        tabs.append(replace(tab, rows=tuple(rows)))
    return replace(board, tabs=tuple(tabs))


def test_a_size_without_places_says_why(board: Board) -> None:
    """It stands behind the sizes that have places."""
    split_board = board_with(
        board,
        {
            ("cavity", "full"): ["Alone"],
            ("fluid", "full"): ["Other"],
            ("cavity", "mini"): ["Both"],
            ("fluid", "mini"): ["Both"],
        },
    )
    overviews = make_overviews(split_board)
    assert [overview.size for overview in overviews] == ["mini", "full"]
    assert [overview.has_places for overview in overviews] == [True, False]
    shown = text_of_overview(render(split_board))
    assert re.search("Both is the only .* all 2 data sets", shown)
    assert re.search("No method .* all 2 data sets of size full", shown)


def test_the_first_film_is_of_a_row_in_sight(board: Board) -> None:
    """It is of the first method of the first table, whatever leads on a data set."""
    split_board = board_with(
        board,
        {
            ("cavity", "full"): ["Alone"],
            ("fluid", "full"): ["Other"],
            ("cavity", "mini"): ["Leader", "Both"],
            ("fluid", "mini"): ["Both"],
        },
    )
    overviews = make_overviews(split_board)
    hero = find_hero(overviews)
    assert hero is not None
    _, row = hero
    assert row.entry.name == "Both" == overviews[0].methods[0].name


def test_the_places_over_all_data_sets_are_ranges(board: Board) -> None:
    """Two methods that win in turn share places; a third far behind does not."""
    tab = make_board((("cavity", "mini"),)).tabs[0]
    first_row = tab.rows[0]
    value = first_row.values[tab.ranking]
    rng = np.random.Generator(np.random.PCG64(3))
    noise = rng.random((2, len(tab.scenarios)))
    first_noise, second_noise = noise
    losses_of_methods = {
        "a": 1.0 + second_noise,
        "b": 1.0 + first_noise,
        "c": 9.0 + second_noise,
    }
    rows = []
    for method, losses in losses_of_methods.items():
        mean_skill = 1.0 - losses.mean() / 10
        row = row_of(
            board,
            method,
            method,
            losses=losses[None],
            skill=replace(value, mean=mean_skill),
        )
        rank = len(rows) + 1
        rows.append(replace(row, rank=rank))
    naive_value = replace(value, mean=10.0)
    reference = tab.references[0]
    naive = replace(reference, values={tab.ranking: naive_value})
    tab = replace(tab, rows=tuple(rows), references=(naive,))
    (overview,) = make_overviews(replace(board, tabs=(tab,)))
    ranges = {}
    for method in overview.methods:
        ranges[method.method] = method.rank_range
    assert ranges["a"] == (1, 2)
    assert ranges["b"] == (1, 2)
    assert ranges["c"] == (3, 3)


def compared(
    board: Board,
    name: str,
    *,
    error: float,
    ratio: tuple[float, float, float] | None,
    **changes: Any,
) -> BoardRow:
    """Return a row with an error, and its ratio to a solver with low and high end."""
    row = row_of(board, name, name.lower(), **changes)
    tab = board.tabs[0]
    value = replace(row.values[tab.ranking], mean=error)
    against = None
    if ratio is not None:
        low, mean, high = ratio
        against = replace(value, mean=mean, low=low, high=high)
    return replace(
        row,
        values={**row.values, tab.ranking: value},
        solver="projection",
        against_classical=against,
    )


DEAR = (1.2, 1.5, 1.9)  # ratios to a solver: low end, value, high end
GOOD = (0.4, 0.5, 0.6)


def test_the_overview_names_data_sets_where_no_entry_has_skill(board: Board) -> None:
    """Rank 1 says nothing there."""
    row = compared(board, "Model", error=1.0, ratio=DEAR)
    for skill, is_told in ((-0.2, True), (0.2, False)):
        value = replace(row.values[board.tabs[0].ranking], mean=skill)
        tab = first_tab(board, replace(row, skill=value))
        shown = text_of_overview(page_of(board, tab))
        assert ("skill above 0 on cavity" in shown) is is_told


def test_the_notes_explain_marks_levels_and_columns(board: Board) -> None:
    """A reader without a pointer has no titles: what the tab shows stands below it."""
    row = compared(
        board, "Young", error=0.5, ratio=GOOD, failed_gates=("bias",), verified=None
    )
    page = page_of(board, first_tab(board, row))
    labels = [element.text for element in read_html(page).named("strong")]
    for label in ("under-trained", "÷ classical", "scores"):
        assert label in labels
    assert "as submitted: " in page
    assert "reproduced: " not in page


def run_again_on(*counts: int) -> Verification:
    """Return a line of an entry whose models ran on so many of 16 scenarios."""
    reproductions = []
    for seed, count in enumerate(counts):
        reproduction = Reproduction(
            seed=seed,
            model="0" * 64,
            metric="vorticity_nrmse",
            scenarios=count,
            of=16,
            submitted=0.5,
            reproduced=0.5,
            difference=0.0,
            tolerance=1e-3,
        )
        reproductions.append(reproduction)
    return Verification(
        scores=("0" * 64,),
        lagbench="0.1.0",
        date=datetime.date(2026, 1, 31),
        level=Level.REPRODUCED,
        reproduced=tuple(reproductions),
    )


def test_the_page_distinguishes_whole_and_partial_reproductions(board: Board) -> None:
    """The header counts both. The column states the number of scenarios. The notes
    explain how much a partial one shows.
    """
    whole = row_of(board, "Whole", "whole", verified=run_again_on(16, 16))
    partly = row_of(board, "Partly", "partly", verified=run_again_on(16, 4))
    other = row_of(board, "Other", "other", verified=run_again_on(2))
    nobody = row_of(board, "Nobody", "nobody", verified=None)
    page = with_rows(board, whole, partly, other, nobody)
    assert (
        "ran the models of 3 entries again and got the same scores, 1 on all test "
        "scenarios and 2 on a part of them. The others stand as submitted."
    ) in page
    assert "reproduced, 4 of 16 scenarios" in page
    assert "reproduced, 2 of 16 scenarios" in page
    assert "weaker evidence" in page
    assert "weaker evidence" not in with_rows(board, whole, nobody)
    assert "got the same scores on all test scenarios." in with_rows(board, whole)
    assert "scores on a part of the test scenarios." in with_rows(board, partly, other)


def test_the_header_counts_models_that_gave_other_scores(board: Board) -> None:
    """Somebody has run them again, though the entry stands as submitted."""
    whole = run_again_on(16)
    other_scores = whole.reproduced[0].model_copy(update={"difference": 1.0})
    differing = whole.model_copy(
        update={"level": Level.AS_SUBMITTED, "reproduced": (other_scores,)}
    )
    row = row_of(board, "Other", "other", verified=differing)
    nobody = row_of(board, "Nobody", "nobody", verified=None)
    words_of_others = "1 entry gave other scores"
    for page in (
        with_rows(board, row),
        with_rows(board, row, nobody),
        with_rows(board, row, row_of(board, "Whole", "whole", verified=whole)),
    ):
        assert words_of_others in page
        assert "nobody has scored them again" not in page
    page = with_rows(board, nobody)
    assert "nobody has scored them again" in page
    assert words_of_others not in page


def with_solvers(tab: Tab, errors: Mapping[str, float]) -> Tab:
    """Return a tab with classical solvers of some errors as references."""
    references = []
    for name, error in errors.items():
        reference = tab.references[0]
        value = replace(reference.values[tab.ranking], mean=error)
        solver = replace(
            reference,
            name=name,
            kind=Kind.CLASSICAL,
            values={**reference.values, tab.ranking: value},
        )
        references.append(solver)
    return replace(tab, references=tuple(references))


def test_the_table_of_a_data_set_marks_dearer_solvers(board: Board) -> None:
    """The sign stands behind the ratio, and the text below the table explains it."""
    row = compared(board, "Model", error=1.0, ratio=GOOD)
    for solver_costs_more in (True, False):
        marked_row = replace(row, solver_costs_more=solver_costs_more)
        page = read_html(with_rows(board, marked_row))
        signs = [sign.text for sign in page.named("sup")]
        assert ("‡" in signs) is solver_costs_more


def test_the_table_of_a_terminal_marks_dearer_solvers(board: Board) -> None:
    """The sign stands behind the ratio, and is explained above the table."""
    row = compared(board, "Model", error=1.0, ratio=GOOD)
    for solver_costs_more in (True, False):
        marked_row = replace(row, solver_costs_more=solver_costs_more)
        tab = first_tab(board, marked_row)
        for wide in (True, False):
            (table,) = tables(replace(board, tabs=(tab,)), wide=wide)
            column = table.columns.index("÷class.")
            cells = {line[1]: line[column] for line in table.rows}
            assert cells["model"].endswith("‡") is solver_costs_more
            assert ("‡" in table.title) is solver_costs_more
            for reference in tab.references:
                assert cells[reference.name] == "-"


def test_slow_solvers_are_marked(board: Board) -> None:
    """A classical solver that costs more than the simulator has a mark."""
    tab = with_solvers(board.tabs[0], {"fast": 1.0, "slow": 2.0})
    references = []
    for reference, seconds in zip(tab.references, (1.0, 3.0), strict=True):
        cost = EntryCost(
            seconds_per_frame=seconds, device="a", solver_seconds_per_frame=2.0
        )
        references.append(replace(reference, cost=cost))
    page = page_of(board, replace(tab, references=tuple(references)))
    lines = reference_lines(page)
    assert "slower than simulator" in lines["slow"]
    assert "slower than simulator" not in lines["fast"]


def reference_lines(page: str) -> dict[str, str]:
    """Return the text of the lines of reference predictors by name."""
    lines = {}
    for line in read_html(page).named("tr"):
        name = line.attributes.get("data-reference")
        if name:
            lines[name] = line.text
    return lines


def test_ranks_count_entries_only(board: Board) -> None:
    """The page says so above the table, with the references before rank 1."""
    first_row = board.tabs[0].rows[0]
    error = first_row.values[board.tabs[0].ranking].mean
    errors = {"better": 0.5 * error, "worse": 2.0 * error}
    page = page_of(board, with_solvers(board.tabs[0], errors))
    assert "entries only" in page
    assert re.search("better .*before rank 1", page)
    assert reference_lines(page)["better"].startswith("ref.")
    assert "before rank 1" not in page_of(
        board, with_solvers(board.tabs[0], {"worse": 2.0 * error})
    )


def test_variants_have_no_film(board: Board) -> None:
    """Their method has; the page would become too long."""
    head, variant = board.tabs[0].rows[:2]
    variant = replace(variant, variant_of=head.id, rank=None)
    page = with_rows(board, head, variant)
    head_data, variant_data = row_data_of(page)
    assert head_data["pictures"] is not None
    assert variant_data["pictures"] is None
    assert variant_data["variantOf"] == head.id


def test_many_methods_have_no_film(board: Board) -> None:
    """The first of every tab have one, and their variants; the page says how many."""
    methods = [len(tab.rows) for tab in board.tabs]
    assert methods == [8, 8]
    assert picture_first(board.tabs, most=16) == list(board.tabs)

    head, variant, *others = board.tabs[0].rows
    variant = replace(variant, variant_of=head.id, rank=None)
    tabs = [first_tab(board, head, *others, variant), board.tabs[1]]
    pictured = picture_first(tabs, most=7)
    assert [tab.pictured for tab in pictured] == [3, 3]
    for tab in pictured:
        has_pictures = [row.pictures is not None for row in tab.rows[:7]]
        assert has_pictures == 3 * [True] + 4 * [False]
    assert pictured[0].rows[-1].pictures is not None  # the variant of the first

    page = page_of(board, *pictured)
    assert "those of the first 3 methods" in page
    first = read_page_data(page).tabs[0]
    assert first["pictured"] == 3
    assert [row["pictures"] is not None for row in first["rows"][:4]].count(True) == 3


def test_pictures_are_let_go_tab_by_tab(board: Board) -> None:
    """As by one call for all tabs: the memory of a large board stays small."""
    at_once = picture_first(board.tabs, most=7)
    tabs: list[Tab] = []
    for tab in board.tabs:
        tabs = picture_first([*tabs, tab], most=7)
    for one, other in zip(tabs, at_once, strict=True):
        assert one.pictured == other.pictured
        has_pictures = [row.pictures is not None for row in one.rows]
        assert has_pictures == [row.pictures is not None for row in other.rows]
        assert True in has_pictures
        assert False in has_pictures


def test_every_tab_has_a_film(board: Board) -> None:
    """The first method has one, however few may have one on the whole page."""
    pictured = picture_first(board.tabs, most=1)
    assert [tab.pictured for tab in pictured] == [1, 1]
    assert picture_first([], most=1) == []


def test_the_first_film_is_of_several_materials() -> None:
    """It has all particles that are known, with a key; links say how to take part."""
    board = make_board((("cavity", "mini"), ("fluid", "mini")))
    hero = find_hero(make_overviews(board))
    assert hero is not None
    tab, row = hero
    assert tab.size.split == "fluid"  # the sample has four materials there
    page_data = read_page_data(render(board))
    plain = page_data.hero
    assert plain["entry"] == row.id
    particle_count = row.pictures.film.shape[1]
    assert len(plain["material"]) == particle_count
    materials = [name for _, name in plain["key"]]
    assert materials == ["liquid", "jelly", "snow", "rope"]


def test_the_first_film_shows_skill_where_there_is_any() -> None:
    """A data set of many materials stands back while the method has no skill there."""
    board = make_board((("cavity", "mini"), ("fluid", "mini")))
    tabs = []
    for tab in board.tabs:
        rows = []
        for row in tab.rows:
            assert row.skill is not None
            if tab.size.split == "fluid":
                row = replace(row, skill=replace(row.skill, mean=-0.1))
            rows.append(row)
        tabs.append(replace(tab, rows=tuple(rows)))
    hero = find_hero(make_overviews(replace(board, tabs=tuple(tabs))))
    assert hero is not None
    assert hero[0].size.split == "cavity"


def test_references_are_judged_like_entries(board: Board) -> None:
    """A reference predictor that is better than every entry takes bold and colour."""
    tab = board.tabs[0]
    first_reference, *other_references = tab.references
    best = {}
    for name, value in first_reference.values.items():
        best[name] = replace(value, mean=1e-9)
    reference = replace(first_reference, values=best)
    changed = replace(tab, references=(reference, *other_references))
    view = make_table(changed, board.metrics)
    first_line = view.lines[0]
    assert first_line.row is reference
    cell = first_line.cells[tab.ranking]
    assert cell.classes == ("best", "heat0")
    page = page_of(board, changed)
    (opening_tag,) = re.findall(r"<tbody>(<tr class=\"reference\"[^>]*>)", page)
    assert f'data-reference="{reference.name}"' in opening_tag


def test_values_below_and_above_an_aim_do_not_cancel(board: Board) -> None:
    """Energy ratios 0 and 2 have the mean 1; 0.9 and 0.9 are nearer to the aim."""
    rows = []
    energy_ratios = (
        (0.0, 2.0),
        (0.9, 0.9),
        (0.5, 0.5),
    )
    first_rows = board.tabs[0].rows[:3]
    for row, per_scenario in zip(first_rows, energy_ratios, strict=True):
        mean = sum(per_scenario) / 2
        value = row.values["energy_ratio"]
        changed = replace(value, mean=mean, per_scenario=per_scenario)
        values = {**row.values, "energy_ratio": changed}
        rows.append(replace(row, values=values))
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
    pattern = f'<tr[^>]*data-entry="{row.id}".*?</tr>'
    lines: list[str] = re.findall(pattern, page)
    return lines[0]


def test_rows_lead_to_code_paper_and_weights(board: Board, page: str) -> None:
    """A link each where the entry has one, and to nothing but the web."""
    link = r'<a href="(http[^"]*)"[^>]*>(\w+)</a>'
    for row in board.tabs[0].rows:
        line = line_of(page, row)
        links = {}
        for address, label in re.findall(link, line):
            links[label] = address
        expected = {}
        for key in ("code", "paper", "weights"):
            address = getattr(row.entry, key)
            if address:
                expected[key] = address
        assert links == expected
    first_row = board.tabs[0].rows[0]
    bad = with_entry(first_row, code="javascript:alert(1)")
    bad_page = with_rows(board, bad)
    assert 'href="javascript' not in bad_page


def test_the_details_name_the_entry_whose_weights_a_row_shares(board: Board) -> None:
    """With its status where it is inactive, and a link where it is on the page."""
    first, second, *_ = board.tabs[0].rows
    keeper = "/".join(second.entry.place)

    def about_weights(*rows: BoardRow, keeper: str = keeper) -> list[list[str]]:
        weights = Weights(path="x", sha256="0" * 64, shared_with=keeper)
        predictions = []
        for prediction in first.entry.predictions:
            shared = prediction.model_copy(update={"weights": weights})
            predictions.append(shared)
        row = with_entry(first, predictions=tuple(predictions))
        about = by_id(row_data_of(with_rows(board, row, *rows)))[row.id]["about"]
        return [item for item in about if item[0] == "weights"]

    link = f"#tab={board.tabs[0].id}&entry={second.id}"
    assert about_weights(second) == [["weights", f"those of {keeper}", link]]
    withdrawn = with_entry(second, status=Status.WITHDRAWN)
    words = f"those of {keeper}, which is withdrawn"
    assert about_weights(withdrawn) == [["weights", words, link]]
    other = "fluid/mini/elsewhere"
    assert about_weights(keeper=other) == [["weights", f"those of {other}"]]


def test_weights_beside_the_entry_have_a_link_a_seed(board: Board) -> None:
    """The links lead to where the leaderboard's folder keeps them."""
    row = board.tabs[0].rows[0]
    entry = row.entry
    seed_mean = row.seed_means[0]
    two_files = 2 * entry.score.files[:1]
    score = entry.score.model_copy(update={"files": two_files})
    weights = Weights(path="x", sha256="0" * 64)
    prediction = entry.predictions[0]
    predictions = []
    for seed in (0, 1):
        update = {"seed": seed, "weights": weights}
        predictions.append(prediction.model_copy(update=update))
    row = with_entry(
        row,
        predictions=tuple(predictions),
        score=score,
        weights=None,
    )
    row = replace(row, seed_means=(seed_mean, seed_mean))
    page = with_rows(board, row)
    links = re.findall(r'href="(weights/[^"]*)"', page)
    place = "/".join(entry.place)
    assert links == [f"weights/{place}_0.safetensors", f"weights/{place}_1.safetensors"]


def test_skill_below_nothing_is_not_shaded_as_skill(board: Board) -> None:
    """Of skills 0.8, 0.1 and -50 the second is far from the first."""
    rows = []
    skills = (0.8, 0.1, -50.0)
    first_rows = board.tabs[0].rows[:3]
    for row, skill in zip(first_rows, skills, strict=True):
        assert row.skill is not None
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
    score = row.entry.score
    file = score.files[0].model_copy(update=update)
    flagged_score = score.model_copy(update={"files": (file,)})
    flagged = with_entry(row, score=flagged_score)
    page = with_rows(board, flagged)
    counts = []
    for element in read_html(page).named("span"):
        title = element.attributes.get("title") or ""
        counts.append(title.count("reason"))
    counts.sort()
    assert counts[-2:] == [MOST_REASONS, len(reasons)]


def sorters(page: str) -> list[Element]:
    """Return the headings of columns."""
    buttons = []
    for button in read_html(page).named("button"):
        if button.attributes.get("data-sort"):
            buttons.append(button)
    return buttons


def test_budgets_are_marked_as_self_reported(page: str) -> None:
    """Headings of what nobody can compute again say so; scores do not.

    Neither do times of a frame: they are measured or stated, row by row.
    """
    marked = set()
    for heading in sorters(page):
        assert "self\u2011reported" not in heading.text
    for tab in read_page_data(page).tabs:
        for column in tab["columns"]:
            if "self\u2011reported" in column["marks"]:
                marked.add(column["key"])
    assert marked == {
        "parameters",
        "budget",
        "track",
        "windows",
        "epochs",
        "cpu_hours",
        "gpu_hours",
    }


@pytest.mark.parametrize(
    ("speed", "word"),
    [
        (0.1, "slower"),
        (17.25, "faster"),
    ],
)
def test_speed_is_compared_with_the_solver(
    board: Board, speed: float, word: str
) -> None:
    """The tile of the fastest entry says on which side of the simulator it is."""
    cost = EntryCost(
        seconds_per_frame=2.0,
        device="a machine",
        solver_seconds_per_frame=2.0 * speed,
    )
    first_row = board.tabs[0].rows[0]
    page = with_rows(board, with_entry(first_row, cost=cost))
    items = [element.text for element in read_html(page).named("li")]
    (tile,) = [item for item in items if "fastest" in item]
    assert f"{word} than the simulator" in tile
    assert "self-reported" in tile


def test_policy_allows_only_our_script_and_style(page: str) -> None:
    """The policy forbids all but the hashes of what the page holds."""
    reading = read_html(page)
    _, meta, *_ = reading.named("meta")
    policy = meta.attributes["content"]
    assert policy.startswith("default-src 'none';")
    assert "unsafe" not in policy
    inline = re.findall(r"<(script|style)>(.*?)</\1>", page, re.DOTALL)
    names = [name for name, _ in inline]
    assert names == ["style", "script", "script"]
    for _, body in inline:
        digest = hashlib.sha256(body.encode()).digest()
        encoded = base64.b64encode(digest).decode()
        assert f"'sha256-{encoded}'" in policy
    assert not re.search(r"""src=["']?(https?:)?//""", page)
    (link,) = reading.named("link")
    assert link.attributes.get("rel") == "icon"
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
    plain_page = with_rows(board, first)
    elements = read_html(page).elements
    plain_elements = read_html(plain_page).elements
    names = [element.name for element in elements]
    assert names == [element.name for element in plain_elements]
    (row_data,) = row_data_of(page)
    assert row_data["command"] == HOSTILE


@pytest.mark.slow
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


def test_the_introduction_counts_data_sets_of_active_entries(board: Board) -> None:
    """A data set all of whose entries are withdrawn is not one of them."""
    first, second = board.tabs
    withdrawn = []
    for row in second.rows:
        inactive_row = with_entry(row, status=Status.WITHDRAWN)
        withdrawn.append(replace(inactive_row, rank=None))
    inactive = replace(second, rows=tuple(withdrawn))
    count = sum(row.active for row in first.rows)
    assert f"{count} entries on 1 data set that" in page_of(board, first, inactive)


def test_the_introduction_leads_to_taking_part(page: str) -> None:
    """The link is above the tables; what it leads to is on the page."""
    parsed = read_html(page)
    (link,) = [a for a in parsed.named("a") if a.text == "Take part"]
    assert link.attributes["href"] == "#take-part"
    places = [section.attributes.get("id") for section in parsed.named("section")]
    assert "take-part" in places
