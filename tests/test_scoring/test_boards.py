"""Which leaderboards a message offers for a folder that is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from lagbench.errors import UsageError
from lagbench.scoring.boards import board_option, find_board, require_board


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the working folder, with the default leaderboard and two others."""
    for name in ("leaderboard", "autumn-board", "archive/leaderboard"):
        (tmp_path / name / "submissions").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("board", "reads", "offered"),
    [
        ("autum-board", True, "autumn-board"),
        ("autum-board", False, "autumn-board"),
        ("archive", False, "archive/leaderboard"),
        ("nothere", True, "leaderboard"),
        ("other/nothere", True, "leaderboard"),
    ],
)
def test_a_similar_leaderboard_is_offered(
    board: str, reads: bool, offered: str, here: Path
) -> None:
    with pytest.raises(UsageError) as caught:
        find_board(board, reads=reads)
    assert caught.value.where == board
    assert f" in {offered}:" in str(caught.value.fix)


@pytest.mark.parametrize("board", ["nothere", "other/nothere"])
def test_no_other_leaderboard_is_offered_to_write_into(board: str, here: Path) -> None:
    """The message advised to write into the board of the clone."""
    for find in (find_board, require_board):
        with pytest.raises(UsageError) as caught:
            find(board)
        assert "root of the clone" in str(caught.value.fix)


def test_a_command_names_a_board_that_is_not_the_default(here: Path) -> None:
    assert board_option(here / "leaderboard") == ""
    assert board_option("autumn-board") == " --board autumn-board"
