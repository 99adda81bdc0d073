"""Files that the commands of this folder write."""

from __future__ import annotations

from pathlib import Path

from lagbench.errors import UsageError


def check_writable(flag: str, path: Path | None) -> None:
    """Refuse a file that cannot be written; leave none that was not there."""
    if path is None:
        return
    is_new = not path.exists()
    try:
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        path.open("ab").close()
    except OSError as error:
        raise UsageError(
            f"the file cannot be written: {error.strerror}, expected a file in a "
            "folder that you may write to",
            where=f"{flag} {path}",
        ) from error
    if is_new:
        path.unlink()
