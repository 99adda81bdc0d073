"""The leaderboard's folder: where entries and score files lie, and nothing outside it.

``submissions/<split>/<size>/<method>.yaml`` and ``scores/<split>/<size>/<method>[_<seed>].nc``.
Symbolic links are never followed: one could lead out of the folder.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterator, Sequence
from pathlib import Path

from lagbench.errors import UsageError

__all__ = ["PAGE_NAME", "SCORES", "SUBMISSIONS", "Folder", "entry_path", "score_paths"]

SUBMISSIONS, SCORES = "submissions", "scores"
PAGE_NAME = "index.html"

ENDINGS = {SUBMISSIONS: ".yaml", SCORES: ".nc"}
KEPT = ".gitkeep"
PART = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
"""What a folder or file may be called: nothing that a terminal or a CI log would obey."""

DEPTH = 4
"""Parts of a path: submissions or scores, split, size, file name."""


def entry_path(place: tuple[str, str, str]) -> Path:
    """Return where an entry lies, relative to the folder.

    >>> entry_path(("cavity", "mini", "gns")).as_posix()
    'submissions/cavity/mini/gns.yaml'
    """
    split, size, method = place
    return Path(SUBMISSIONS, split, size, f"{method}.yaml")


def score_paths(place: tuple[str, str, str], seeds: Sequence[int | None]) -> tuple[Path, ...]:
    """Return where the score files of an entry lie, relative to the folder.

    The names follow from the entry, so that nothing in it can point elsewhere. An underscore,
    which no method has, parts method and seed.

    >>> [path.name for path in score_paths(("cavity", "mini", "gns"), [0, 3])]
    ['gns_0.nc', 'gns_3.nc']
    """
    split, size, method = place
    names = [method] if len(seeds) == 1 else [f"{method}_{seed}" for seed in seeds]
    return tuple(Path(SCORES, split, size, f"{name}.nc") for name in names)


class Folder:
    """The files of a leaderboard."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    @property
    def page(self) -> Path:
        """The page that ``lagbench leaderboard build`` writes."""
        return self.path / PAGE_NAME

    def require(self) -> None:
        """Refuse a folder that is no leaderboard."""
        if not (self.path / SUBMISSIONS).is_dir():
            raise UsageError(
                "no leaderboard here",
                where=str(self.path),
                expected=f"a folder that holds {SUBMISSIONS}/",
                fix="run it from the root of the repository, or name the folder: --board FOLDER",
            )

    def entries(self) -> tuple[Path, ...]:
        """Return the YAML files of entries, relative to the folder, in the order of their names."""
        return tuple(path for path in self._files(SUBMISSIONS) if self.oddity(path) is None)

    def score_files(self) -> tuple[Path, ...]:
        """Return the score files, relative to the folder, in the order of their names."""
        return tuple(path for path in self._files(SCORES) if self.oddity(path) is None)

    def claims(self) -> set[tuple[str, str, str]]:
        """Return split, size and method of all that lies where an entry would, whatever it is."""
        ends = ENDINGS[SUBMISSIONS]
        files = [
            path for path in self._files(SUBMISSIONS) if len(path.parts) == DEPTH and path.suffix == ends
        ]
        return {(path.parts[1], path.parts[2], path.stem) for path in files}

    def odd(self) -> Iterator[tuple[Path, str]]:
        """Yield what should not lie under submissions and scores, and why."""
        for top in (SUBMISSIONS, SCORES):
            for path in self._files(top):
                reason = self.oddity(path)
                if reason is not None:
                    yield path, reason

    def oddity(self, path: Path) -> str | None:
        """Return why a relative path cannot be an entry or a score file, None if it can."""
        link = self.link_in(path)
        if link is not None:
            return f"{link} is a symbolic link"
        if not stat.S_ISREG((self.path / path).lstat().st_mode):
            return "no regular file"
        ending = ENDINGS.get(path.parts[0])
        if not all(PART.fullmatch(part) for part in path.parts):
            return "a name with other characters than letters, digits, '-', '_' and '.'"
        if path.suffix != ending or len(path.parts) != DEPTH:
            return f"not {path.parts[0]}/<split>/<size>/<name>{ending}"
        return None

    def link_in(self, path: Path) -> Path | None:
        """Return the first part of a relative path that is a symbolic link, None without any."""
        here = Path()
        for part in path.parts:
            here = here / part
            if (self.path / here).is_symlink():
                return here
        return None

    def _files(self, top: str) -> list[Path]:
        """Return everything under a subfolder that is no folder, links to folders included."""
        found: list[Path] = []
        for folder, names, files in os.walk(self.path / top, followlinks=False):
            here = Path(folder)
            links = [name for name in names if (here / name).is_symlink()]
            found += [(here / name).relative_to(self.path) for name in (*links, *files) if name != KEPT]
        if (self.path / top).is_symlink():
            found = [Path(top)]
        return sorted(found, key=lambda path: path.parts)
