"""The table beside LagrangeBench's errors: the docs have it, and a row by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lagbench.board.entry_file import read_entry
from lagbench.board.folder import Folder
from lagbench.data.registry import load
from lagbench.scoring.score_file import read_statistics
from studies.lagrangebench import errors_of, main, table

REPOSITORY = Path(__file__).parents[2]
BOARD = REPOSITORY / "leaderboard"


def test_the_docs_have_the_table() -> None:
    """docs/exchange.md shows what the command prints."""
    page = (REPOSITORY / "docs/exchange.md").read_text()
    assert table(BOARD) in page


def test_errors_of_an_entry_by_hand() -> None:
    """Means over scenarios and seeds of the stored statistics."""
    size = load().size("poiseuille", "mini")
    entry = read_entry(BOARD / "submissions/poiseuille/mini/neuralmpm.yaml")
    errors = errors_of(entry, Folder(BOARD), size)

    assert len(entry.score_paths) == 3
    stored = []
    for path in entry.score_paths:
        stored.extend(read_statistics(BOARD / path).tallies.values())
    mse_20 = []
    e_kin = []
    for statistics in stored:
        row = dict(zip(statistics.names, statistics.values, strict=True))
        mse_20.append(row["position_mse"][:20].mean())
        # sum of m |u|^2 in units of volume and second
        unit = 2.0 / (size.value("density") * size.frame_interval**2)
        gap = unit * (row["energy_predicted"] - row["energy_true"])
        e_kin.append((gap[:20][1::10] ** 2).mean())
    assert errors["position_mse_20"] == pytest.approx(np.mean(mse_20))
    assert errors["e_kin_mse"] == pytest.approx(np.mean(e_kin))


def test_a_board_without_the_entries_is_no_crash(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It ends with the exit code of a file that cannot be read."""
    assert main(["--board", str(tmp_path)]) == 3
    output = capsys.readouterr()
    assert output.out == ""
    assert str(tmp_path) in output.err
