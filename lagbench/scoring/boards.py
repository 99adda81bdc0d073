"""Which folder is the leaderboard: the one that is named, or else one of two."""

from __future__ import annotations

from pathlib import Path

from lagbench.errors import UsageError

SUBMISSIONS = "submissions"
"""The folder of entries, which every leaderboard has; see `lagbench.board.folder`."""

DEFAULT_BOARDS = (
    Path("leaderboard"),
    Path(__file__).resolve().parents[2] / "leaderboard",
)
"""The leaderboard in the working folder, and that of a clone."""


def find_board(board: str | Path | None = None) -> Path:
    """Return the folder of a leaderboard.

    Args:
        board: the named folder; ``leaderboard`` in the working folder when
            None, else that of the clone.

    Raises:
        UsageError: the named folder is no leaderboard, or no default is there.
    """
    if board is not None:
        require_board(board)
        return Path(board)
    for folder in DEFAULT_BOARDS:
        if (folder / SUBMISSIONS).is_dir():
            return folder
    raise no_board()


def require_board(board: str | Path, *, fix: str | None = None) -> None:
    """Refuse a folder that is no leaderboard.

    Raises:
        UsageError: the folder has no entries.
    """
    if not (Path(board) / SUBMISSIONS).is_dir():
        raise no_board(Path(board), fix)


def no_board(folder: Path = DEFAULT_BOARDS[0], fix: str | None = None) -> UsageError:
    """Return the error for a folder that is no leaderboard."""
    got = "no such folder"
    if folder.is_dir():
        got = "a folder without it"
    elif folder.exists():
        got = "a file"
    return UsageError(
        "no leaderboard here",
        where=str(folder),
        expected=f"a folder that holds {SUBMISSIONS}/",
        got=got,
        fix=fix or "run it from the root of the clone, or name it: --board FOLDER",
    )
