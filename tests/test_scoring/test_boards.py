"""Which leaderboards a message offers for a folder that is none."""

from __future__ import annotations

from pathlib import Path

import pytest

from lagbench.errors import UsageError
from lagbench.scoring.boards import (
    find_board,
    require_board,
    suggest_board,
)
from lagbench.scoring.compare import compare


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


def test_the_leaderboard_that_has_an_entry_is_named(here: Path) -> None:
    """Its option helps more than a similar entry of the leaderboard that was read."""
    for board, method in (("leaderboard", "mlp"), ("autumn-board", "small")):
        folder = here / board / "submissions" / "cavity" / "mini"
        folder.mkdir(parents=True)
        (folder / f"{method}.yaml").write_text("")
    entry = "cavity/mini/small"
    assert str(suggest_board(entry)).endswith(": --board autumn-board")
    assert suggest_board(entry, searched=here / "autumn-board") is None
    for name in ("cavity/mini/none", "small", "../mini/small", "a\0/b/c"):
        assert suggest_board(name) is None

    with pytest.raises(UsageError, match="no such entry") as caught:
        compare(entry, "persistence", board="leaderboard")
    assert "--board autumn-board" in str(caught.value.fix)


def test_without_a_default_the_leaderboards_here_are_named(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lagbench.scoring.boards.DEFAULT_BOARDS", (Path("none"),))
    (here / "leaderboard" / "submissions").rmdir()
    with pytest.raises(UsageError, match="no leaderboard here") as caught:
        find_board()
    assert "autumn-board" in str(caught.value.fix)
