"""Checks on what became of entries: superseded by one that is there, and not by itself in the end."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from lagbench.submission import Finding

from .entry import Entry
from .entry_checks import finding
from .folder import Folder, entry_path

__all__ = ["check_lives"]

Place = tuple[str, str, str]


def check_lives(folder: Folder, entries: Sequence[Entry]) -> Iterator[Finding]:
    """Yield entries whose successor is not there, and those that follow each other in a circle."""
    after = {
        entry.place: (entry.split, entry.size, entry.superseded_by)
        for entry in entries
        if entry.superseded_by is not None
    }
    for entry in entries:
        successor = after.get(entry.place)
        if successor is None:
            continue
        if not (folder.path / entry_path(successor)).is_file():
            yield _ends_nowhere(entry, "superseded by one that is not there", successor[2])
        elif entry.place in _line(after, entry.place):
            circle = " -> ".join(name for *_, name in _line(after, entry.place))
            yield _ends_nowhere(entry, "superseded by itself in the end", circle)


def _line(after: Mapping[Place, Place], place: Place) -> list[Place]:
    """Return the successors of an entry, the first that comes twice once."""
    line: list[Place] = []
    while place in after and after[place] not in line:
        place = after[place]
        line.append(place)
    return line


def _ends_nowhere(entry: Entry, what: str, got: str) -> Finding:
    return finding(
        "lifecycle",
        f"the entry is {what}",
        where=entry.yaml_path,
        expected=f"another entry of {entry.split} {entry.size}, active in the end",
        got=got,
        fix="name an entry that is there and replaces it, or set status: withdrawn",
    )
