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
        board: the named folder; ``leaderboard`` in the working folder when None, else
            that of the clone.

    Raises:
        UsageError: the named folder is no leaderboard, or no default is there.
    """
    if board is not None:
        require_board(board)
        return Path(board)
    for folder in DEFAULT_BOARDS:
        if is_board(folder):
            return folder
    raise UsageError("no leaderboard here; name one: --board FOLDER")


def is_board(folder: Path) -> bool:
    """Return whether a folder has entries, or room for them."""
    return (folder / SUBMISSIONS).is_dir()


def require_board(board: str | Path) -> None:
    """Refuse a folder that is no leaderboard.

    Raises:
        UsageError: the folder has no entries.
    """
    if not is_board(Path(board)):
        raise UsageError(
            f"{board} is no leaderboard: it has no folder {SUBMISSIONS}; name another: "
            "--board FOLDER"
        )
