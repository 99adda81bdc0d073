"""Which folder is the leaderboard: the one that is named, or else one of two."""

from __future__ import annotations

import os
import shlex
from collections.abc import Sequence
from contextlib import suppress
from difflib import get_close_matches
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
"""Names of a folder that are compared with a wrong one."""

MOST_BOARDS = 3
"""Folders beside a wrong one that a hint may list."""


def find_board(board: str | Path | None = None, *, reads: bool = False) -> Path:
    """Return the folder of a leaderboard.

    Args:
        board: the named folder; ``leaderboard`` in the working folder when
            None, else that of the clone.
        reads: whether the caller only reads it. Where the named folder is no
            leaderboard, the message then offers the default one.

    Raises:
        UsageError: the named folder is no leaderboard, or no default is there.
    """
    defaults = [folder for folder in DEFAULT_BOARDS if is_board(folder)]
    if board is not None:
        if is_board(Path(board)):
            return Path(board)
        raise no_board(Path(board), offered=defaults[:1] if reads else ())
    if not defaults:
        raise no_board(offered=find_boards_here())
    return defaults[0]


def is_board(folder: Path) -> bool:
    """Return whether a folder has entries, or room for them."""
    return (folder / SUBMISSIONS).is_dir()


def require_board(board: str | Path, *, fix: str | None = None) -> None:
    """Refuse a folder that is no leaderboard.

    Raises:
        UsageError: the folder has no entries.
    """
    if not is_board(Path(board)):
        raise no_board(Path(board), fix)


def no_board(
    folder: Path = DEFAULT_BOARDS[0],
    fix: str | None = None,
    *,
    offered: Sequence[Path] = (),
) -> UsageError:
    """Return the error for a folder that is no leaderboard.

    Args:
        folder: the folder.
        fix: what to do; to name another folder when None.
        offered: leaderboards to offer where none has a similar name.
    """
    fix = fix or "run it from the root of the clone, or name it: --board FOLDER"
    boards = find_boards_near(folder) or offered[:MOST_BOARDS]
    if boards:
        names = ", ".join(map(str, boards))
        fix = f"there is a leaderboard in {names}: name it; or {fix}"
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
    """Return the leaderboard in a folder, and those beside it with similar names."""
    candidates = [folder / DEFAULT_BOARDS[0]]
    with suppress(OSError):
        names = sorted(os.listdir(folder.parent))[:MOST_NAMES]
        similar_names = get_close_matches(folder.name, names, n=MOST_BOARDS)
        candidates += [folder.parent / name for name in similar_names]
    return [candidate for candidate in candidates if is_board(candidate)]


def find_boards_here() -> list[Path]:
    """Return the leaderboards among the folders of the working folder, by name."""
    names: list[str] = []
    with suppress(OSError):
        names = sorted(os.listdir("."))[:MOST_NAMES]
    return [Path(name) for name in names if is_board(Path(name))]


def suggest_board(entry: str, *, searched: Path | None = None) -> str | None:
    """Return a hint that names the leaderboards which have an entry; None without one.

    Args:
        entry: the entry, as in ``cavity/mini/gns``.
        searched: the leaderboard that does not have it.
    """
    place = Path(entry)
    if len(place.parts) != 3 or place.is_absolute() or ".." in place.parts:
        return None
    options = []
    resolved = set()
    if searched is not None:
        resolved.add(searched.resolve())
    for board in (*find_boards_here(), *DEFAULT_BOARDS):
        is_entry = False
        with suppress(OSError, ValueError):
            is_entry = (board / SUBMISSIONS / f"{entry}.yaml").is_file()
        if is_entry and board.resolve() not in resolved:
            resolved.add(board.resolve())
            options.append(f"--board {shlex.quote(str(board))}")
    if not options:
        return None
    return f"another leaderboard has it: {', or '.join(options[:MOST_BOARDS])}"
