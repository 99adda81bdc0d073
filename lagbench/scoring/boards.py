"""Which folder is the leaderboard: the one that is named, or else one of two."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from lagbench.errors import UsageError

SUBMISSIONS = "submissions"
"""The folder of entries, which every leaderboard has; see `lagbench.board.folder`."""

DEFAULT_BOARDS = (
    Path("leaderboard"),
    Path(__file__).resolve().parents[2] / "leaderboard",
)
"""The leaderboard in the working folder, and that of a clone."""

MOST_NAMES = 1000
"""Names of a folder among which leaderboards are looked for."""

MOST_BOARDS = 3
"""Leaderboards that a hint lists."""


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
    fix = fix or "run it from the root of the clone, or name it: --board FOLDER"
    boards = [str(board) for board in find_boards_near(folder)]
    if boards:
        fix = f"there is a leaderboard in {', '.join(boards)}: name it; or {fix}"
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
        fix=fix,
    )


def find_boards_near(folder: Path) -> list[Path]:
    """Return leaderboards in a folder, beside it, and those that are the default."""
    candidates = []
    for place in (folder, folder.parent):
        with suppress(OSError):
            names = sorted(os.listdir(place))[:MOST_NAMES]
            candidates += [place / name for name in names]
    boards: dict[Path, Path] = {}
    for candidate in (*candidates, *DEFAULT_BOARDS):
        if (candidate / SUBMISSIONS).is_dir():
            boards.setdefault(candidate.resolve(), candidate)
    return list(boards.values())[:MOST_BOARDS]
