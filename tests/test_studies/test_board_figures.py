"""Figures of the board: what they cannot be drawn from."""

from __future__ import annotations

from pathlib import Path

import pytest

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
