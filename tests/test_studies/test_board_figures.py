"""Figures of the board: what they are drawn from, and what not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from lagbench.board.build import collect
from lagbench.board.cost import picture
from lagbench.data.registry import load
from studies import shift_figure, validation_curves
from studies.thesis.split_results import BOARD

CLONE = Path(__file__).parents[2]


@pytest.mark.parametrize(
    "arguments",
    [
        ["--board", str(CLONE / BOARD), "--size", "min"],
        ["--board", str(CLONE / BOARD), "--size", "tiny"],
        ["--board", "nowhere"],
    ],
)
def test_a_figure_of_nothing_replaces_no_figure(
    arguments: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """No size of that name, a size without scores on shift, and no board."""
    monkeypatch.chdir(tmp_path)
    figure = tmp_path / "shift.svg"
    figure.write_text("a figure")
    assert shift_figure.main([*arguments, "--output", str(figure)]) == 2
    assert figure.read_text() == "a figure"
    assert capsys.readouterr().err.startswith("error: ")


def test_curves_of_nothing_replace_no_figure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder without records of trainings has no curves."""
    board = tmp_path / "board"
    (board / "submissions").mkdir(parents=True)
    figure = tmp_path / "curves.svg"
    figure.write_text("a figure")
    arguments = ["--board", str(board), "--output", str(figure)]
    assert validation_curves.main(arguments) == 2
    assert figure.read_text() == "a figure"
    assert capsys.readouterr().err.startswith("error: ")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("draw", "arguments", "name"),
    [
        (shift_figure.main, [], "shift.svg"),
        (shift_figure.main, ["--size", "full"], "shift_full.svg"),
        (validation_curves.main, [], "validation_curves.svg"),
    ],
)
def test_committed_figures_are_those_of_the_board(
    draw: Callable[[Sequence[str]], int],
    arguments: list[str],
    name: str,
    tmp_path: Path,
) -> None:
    """An entry that is added or changed changes them too."""
    figure = tmp_path / name
    board = ["--board", str(CLONE / BOARD)]
    assert draw([*board, *arguments, "--output", str(figure)]) == 0
    assert figure.read_bytes() == (CLONE / "docs" / "figures" / name).read_bytes()


@pytest.mark.slow
def test_the_committed_chart_of_costs_is_that_of_the_board() -> None:
    """README shows it."""
    committed = CLONE / "docs" / "figures" / "accuracy_cost.svg"
    board = collect(CLONE / BOARD, only=[("cavity", "mini")])
    drawn = picture(board, load().size("cavity", "mini"))
    assert drawn == committed.read_text(encoding="utf-8")
