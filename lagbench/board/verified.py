"""The list of entries whose predictions the maintainers scored again: leaderboard/verified.yaml.

It lies apart from the entries, so that nobody can claim it for his own: ``leaderboard check
--base`` names every change to it. A line holds while the entry has the very score files that
it names; ``leaderboard check --predictions FILE --record`` writes it.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

from pydantic import Field, RootModel

from lagbench.atomic import write_atomically
from lagbench.errors import ChecksFailedError

from .entry import MOST_SEEDS, Date, Entry, Hash, Short, Strict
from .entry_file import examine, load_plain, spell
from .folder import VERIFIED, Folder

__all__ = ["Verification", "read_verified", "record", "verification_of"]


class Verification(Strict):
    """What the maintainers found."""

    scores: Annotated[tuple[Hash, ...], Field(min_length=1, max_length=MOST_SEEDS, strict=False)]
    lagbench: Short
    date: Date


class _List(RootModel[dict[str, Verification]]):
    """Entries, by path relative to the leaderboard's folder."""


def read_verified(folder: Folder) -> Mapping[str, Verification]:
    """Return the list; empty where there is none."""
    path = folder.path / VERIFIED
    if not path.exists() and not path.is_symlink():
        return {}
    held = load_plain(path)
    found, mistakes = examine(_List, {} if held is None else held)
    if found is None:
        raise ChecksFailedError(
            "the list of verified entries does not fit",
            where=str(path),
            expected="entry path: {scores: [SHA-256, ...], lagbench: VERSION, date: YYYY-MM-DD}",
            got="\n    ".join(["", *map(str, mistakes)]),
            fix="`lagbench leaderboard check --predictions FILE --record` writes it",
        )
    return found.root


def verification_of(entry: Entry, known: Mapping[str, Verification]) -> Verification | None:
    """Return the line of an entry; None without one, or if it is of other score files."""
    line = known.get(entry.yaml_path.as_posix())
    return line if line and line.scores == tuple(held.sha256 for held in entry.score.files) else None


def record(folder: Folder, entries: Sequence[Entry], date: datetime.date) -> Path | None:
    """Add entries to the list, or renew their lines; return its path, None without any."""
    if not entries:
        return None
    held: dict[str, object] = {path: line.model_dump() for path, line in read_verified(folder).items()}
    for entry in entries:
        held[entry.yaml_path.as_posix()] = {
            "scores": tuple(file.sha256 for file in entry.score.files),
            "lagbench": version("lagbench"),
            "date": date,
        }
    path = folder.path / VERIFIED
    write_atomically(path, spell({name: held[name] for name in sorted(held)}), option="--board")
    return path
