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
        UsageError: the folder has no entries and no room for them.
    """
    folders = DEFAULT_BOARDS if board is None else (Path(board),)
    for folder in folders:
        if (folder / SUBMISSIONS).is_dir():
            return folder
    raise UsageError(
        f"{folders[0]} is no leaderboard: it has no folder {SUBMISSIONS}; name "
        "another: --board FOLDER"
    )
