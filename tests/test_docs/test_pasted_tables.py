"""Tables of the docs that a command prints are those of the committed files."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from benchmarks.references import main as print_references
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


def cells_of(row: str) -> list[str]:
    """Return the texts between the bars of a row."""
    return [cell.strip() for cell in row.strip("|").split("|")]


def active_records() -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield data set, method and line of verified.yaml of each active entry."""
    verified = yaml.safe_load((BOARD / "verified.yaml").read_text())
    for place, record in verified.items():
        entry = yaml.safe_load((BOARD / place).read_text())
        if "status" not in entry:
            yield f"{entry['split']} {entry['size']}", entry["method"], record


def format_time(seconds: float) -> str:
    """Return a time of three digits, in seconds from one second on."""
    if seconds >= 1.0:
        return f"{seconds:.3g} s"
    return f"{1000 * seconds:.3g} ms"


def test_the_times_of_a_row_of_results_come_from_one_run() -> None:
    """The time of the model and that of the classical solver."""
    runs: dict[str, list[tuple[float, dict[str, float]]]] = {}
    for data_set, _, record in active_records():
        cost = record.get("cost")
        if cost is not None:
            run = (cost["seconds_per_frame"], cost["classical"])
            runs.setdefault(data_set, []).append(run)

    tables = tables_in((DOCS / "results.md").read_text())
    rows, *_ = (table for table in tables if table[0].startswith("| data set | metric"))
    assert len(rows) > 20
    for row in rows[1:]:
        data_set, _, _, classical, _, model, *_ = cells_of(row)
        solver, solver_time = re.findall(r"^(\S+): .* \((\S+ m?s)\)", classical)[0]
        (model_time,) = re.findall(r"\((\S+ m?s)\)", model)
        times = []
        for seconds, solvers in runs[data_set]:
            times.append((format_time(seconds), format_time(solvers[solver])))
        assert (model_time, solver_time) in times


def test_the_times_of_hybrids_are_those_of_verified_yaml() -> None:
    """The time of a frame over that of the solver that made the data."""
    expected = {}
    for data_set, method, record in active_records():
        if method == "hybrid-projection":
            cost = record["cost"]
            ratio = cost["seconds_per_frame"] / cost["solver"]
            expected[data_set] = f"{ratio:.1f}"
    page = tables_in((DOCS / "baselines.md").read_text())
    heading = "| data set | time of a frame, hybrid / solver that made the data |"
    rows = table_like(page, heading)
    assert dict(map(cells_of, rows[1:])) == expected


def test_the_differences_of_reproduced_models_are_those_of_verified_yaml() -> None:
    """How many models of active entries came back how exactly."""
    counts = [0, 0, 0, 0]
    for data_set, _, record in active_records():
        for seed in record.get("reproduced", []):
            if seed["difference"] == 0:
                counts[0] += 1
            elif seed["difference"] <= 1e-5:
                counts[1] += 1
            elif not data_set.startswith("fluid "):
                counts[2] += 1
            else:
                counts[3] += 1
    text = (DOCS / "reproduce.md").read_text()
    heading = "| relative difference of the ranking metric | models |"
    rows = table_like(tables_in(text), heading)
    assert [int(cells_of(row)[1]) for row in rows[1:]] == counts
    assert f"the models of each entry, {sum(counts)} in total" in text


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
