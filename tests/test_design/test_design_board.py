"""The tab of the design track: rows, sentences and the page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from lagbench.board.design import conclude_design, read_design
from lagbench.board.folder import Folder
from lagbench.board.page import render
from lagbench.board.rows import Board
from lagbench.design.judge import DesignEntry, Verdict, known_errors, write_entry
from lagbench.design.tasks import load_task

TASKS = [f"identify-{number:02d}" for number in range(5)]


@pytest.fixture
def folder(tmp_path: Path) -> Folder:
    """Return a board where CMA-ES on a network reaches 0.2 more than elsewhere."""
    for method, gain in (("cma-coarse", 0.0), ("cma-neuralmpm", 0.2)):
        for seed in (0, 1):
            verdicts = {}
            parameters = {}
            for number, name in enumerate(TASKS):
                known = known_errors()[name]
                score = 0.2 + 0.1 * number + gain
                error = known.random - score * (known.random - known.best)
                verdicts[name] = Verdict(error=error, sha256="")
                task = load_task(name)
                parameters[name] = [each.low for each in task.parameters]
            entry = DesignEntry(
                method=method,
                budget=10,
                seed=seed,
                parameters=parameters,
                seconds=dict.fromkeys(TASKS, 2.0),
                verdicts=verdicts,
            )
            write_entry(entry, tmp_path / "design" / f"{method}-10-{seed}.json")
    return Folder(tmp_path)


def test_rows_are_means_of_scores_and_differences_are_paired(folder: Folder) -> None:
    coarse, network = read_design(folder)
    assert (coarse.method, coarse.tasks) == ("cma-coarse", tuple(TASKS))
    assert coarse.score == pytest.approx(0.4)
    assert coarse.seconds == 2.0
    low, high = coarse.interval
    assert low < 0.4 < high
    assert network.difference(coarse) == pytest.approx((0.2, 0.2, 0.2, 5))
    assert "1 of 1" in conclude_design((coarse, network))[0]
    worse = replace(network, scores=coarse.scores)
    assert "0 of 1" in conclude_design((coarse, worse))[0]


def test_the_page_has_a_tab_with_the_rows(folder: Folder) -> None:
    assert not list(folder.misplaced())
    page = render(Board(tabs=()), design=read_design(folder))
    assert '<section id="tab-design">' in page
    assert "cma-neuralmpm" in page
    assert '<section id="tab-design">' not in render(Board(tabs=()))
