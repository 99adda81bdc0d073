"""Tables of the docs that a command prints are those of the committed files."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.references import main as print_references
from benchmarks.season_grinding import main as print_season_grinding
from lagbench.board.folder import Folder
from studies.frame_speeds import read_speed_ups
from studies.frame_speeds import table as table_of_speeds
from studies.gates import active_rows, to_markdown
from studies.shift_figure import collect_shifted
from studies.shift_figure import table as table_of_shift
from studies.thesis.split_results import BOARD

CLONE = Path(__file__).parents[2]
DOCS = CLONE / "docs"


def tables_in(text: str) -> list[list[str]]:
    """Return the rows of each Markdown table, the line below its heading left out."""
    tables: list[list[str]] = []
    is_inside = False
    for line in text.splitlines():
        is_row = line.startswith("|")
        if is_row and not is_inside:
            tables.append([])
        is_inside = is_row
        if is_row and not set(line) <= set("|-: "):
            tables[-1].append(line)
    return tables


def table_like(tables: list[list[str]], heading: str) -> list[str]:
    """Return the only table with a heading."""
    (found,) = (table for table in tables if table[0] == heading)
    return found


def test_the_table_of_gates_has_what_gates_json_records() -> None:
    """Every row of weights of an active entry, gates that were not measured too."""
    (printed,) = tables_in(to_markdown(active_rows(Folder(BOARD))))
    page = tables_in((DOCS / "baselines.md").read_text())
    assert len(printed) > 10
    assert table_like(page, printed[0]) == printed


def test_the_table_of_speeds_has_the_costs_of_verified_yaml() -> None:
    """Every kind of model at both sizes."""
    (printed,) = tables_in(table_of_speeds(read_speed_ups(Folder(BOARD))))
    page = tables_in((DOCS / "baselines.md").read_text())
    assert len(printed) > 5
    assert table_like(page, printed[0]) == printed


@pytest.mark.slow
@pytest.mark.parametrize("size", ["mini", "full"])
def test_the_table_of_shift_has_the_scores_of_shift_yaml(size: str) -> None:
    """The best method of each kind on four data sets."""
    chosen = collect_shifted(BOARD, size)
    assert len(chosen) == 4
    (printed,) = tables_in(table_of_shift(chosen))
    page = tables_in((DOCS / "tasks.md").read_text())
    assert printed in page


@pytest.mark.slow
def test_the_tables_of_references_have_the_shipped_scores(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """All rows of benchmarks/references.py, in its order. The last two tables leave out
    the size tiny. That of the frozen field also has data sets without shipped scores.
    """
    monkeypatch.setattr(sys, "argv", ["references.py"])
    print_references()
    printed = tables_in(capsys.readouterr().out)
    page = tables_in((DOCS / "references.md").read_text())
    best, every, frozen, active = printed
    assert len(every) > 100
    assert table_like(page, best[0]) == best
    assert table_like(page, every[0]) == every
    frozen = [row for row in frozen if " tiny |" not in row]
    rows_of_page = table_like(page, frozen[0])
    assert len(frozen) > 10
    assert [row for row in rows_of_page if row in frozen] == frozen
    active = [row for row in active if " tiny |" not in row]
    assert len(active) > 8
    assert table_like(page, active[0]) == active


@pytest.mark.slow
def test_the_tables_of_seeds_that_were_tried_have_the_scores_of_the_board(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Both tables, for every data set of size mini."""
    print_season_grinding(["--board", str(BOARD)])
    gains, swaps = tables_in(capsys.readouterr().out)
    page = tables_in((DOCS / "seasons.md").read_text())
    assert len(gains) > 10
    assert table_like(page, gains[0]) == gains
    assert table_like(page, swaps[0]) == swaps
