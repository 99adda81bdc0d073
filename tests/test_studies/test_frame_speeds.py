"""The table of speed-ups ends with a message where there is nothing to read."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.frame_speeds import main


def test_a_folder_without_a_leaderboard_has_no_table(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """An empty table would read as if no entry had a speed-up."""
    board = tmp_path / "none"
    assert main(["--board", str(board)]) == 2
    output = capsys.readouterr()
    assert output.out == ""
    assert str(board) in output.err


def test_a_damaged_entry_is_named(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    entry = tmp_path / "submissions" / "cavity" / "mini" / "gns.yaml"
    entry.parent.mkdir(parents=True)
    entry.write_text("split: [")
    assert main(["--board", str(tmp_path)]) == 3
    output = capsys.readouterr()
    assert output.out == ""
    assert str(entry) in output.err
