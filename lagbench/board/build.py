"""Draw the page: ``lagbench leaderboard build``. The same submissions give the same bytes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lagbench.atomic import write_atomically
from lagbench.data.registry import Registry
from lagbench.errors import ChecksFailedError

from .collect import collect
from .folder import Folder
from .schema import SCHEMA_NAME, schema_bytes

__all__ = ["BuildResult", "build", "drifted"]

OPTION = "--board"


@dataclass(frozen=True, kw_only=True)
class BuildResult:
    """A page that was drawn."""

    page: Path
    bytes: int  # its length
    tabs: int  # splits and sizes on it
    rows: int  # entries on it
    written: tuple[Path, ...]  # files that were written, because they were missing or had other bytes


def build(
    board: str | Path,
    *,
    check: bool = False,
    registry: Registry | None = None,
    report: Callable[[int], None] = lambda _: None,
) -> BuildResult:
    """Write the page and schema.json of a leaderboard's folder; files that are right stay untouched.

    Args:
        board: the leaderboard's folder.
        check: write nothing, fail where a file would change.
        registry: where splits are described; ours when None.
        report: told the entries read.

    Raises:
        UsageError: no leaderboard there.
        UnreadableFileError: an entry or a score file cannot be read.
        ChecksFailedError: an entry does not fit, or with ``check`` a file is stale.
        WorkFailedError: the disk is full or not writable.
    """
    from .page import render

    folder, held = Folder(board), collect(board, registry=registry, report=report)
    files = {folder.page: render(held).encode(), folder.path / SCHEMA_NAME: schema_bytes()}
    stale = [path for path, wanted in files.items() if drifted(path, wanted)]
    if stale and check:
        raise ChecksFailedError(
            "the page is not what the submissions give",
            where=", ".join(str(path) for path in stale),
            expected=f"{len(files[folder.page])} bytes, tabs {len(held.tabs)}",
            got="another content, or no file",
            fix="lagbench leaderboard build",
        )
    for path in stale:
        write_atomically(path, files[path], option=OPTION)
    return BuildResult(
        page=folder.page,
        bytes=len(files[folder.page]),
        tabs=len(held.tabs),
        rows=sum(len(tab.rows) for tab in held.tabs),
        written=tuple(stale),
    )


def drifted(path: Path, wanted: bytes) -> bool:
    """Tell whether a file is missing, a link, or has other bytes."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size != len(wanted):
        return True
    return path.read_bytes() != wanted
