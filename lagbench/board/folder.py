"""The leaderboard's folder: where its files lie, and nothing outside it.

    submissions/<split>/<size>/<method>.yaml      entries
    scores/<split>/<size>/<method>[_<seed>].nc    their score files
    floors/<split>/<size>/<name>.nc               scores of the floors
    weights/<split>/<size>/<method>_<seed>.pt     weights, with the .json that their trainings recorded
    verified.yaml, schema.json, index.html, README.md

Symbolic links are never followed: one could lead out of the folder.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

from lagbench.errors import UsageError

Place = tuple[str, str, str]  # split, size and method

SUBMISSIONS = "submissions"
SCORES = "scores"
REFERENCES = "floors"
WEIGHTS = "weights"
PAGE = "index.html"
SCHEMA = "schema.json"
VERIFIED = "verified.yaml"
README = "README.md"

ENDINGS = {
    SUBMISSIONS: (".yaml",),
    SCORES: (".nc",),
    REFERENCES: (".nc",),
    WEIGHTS: (".pt", ".json"),
}
KEPT = ".gitkeep"
PART = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
"""What a folder or file may be called: nothing that a terminal or a CI log would obey.
"""

DEPTH = 4  # parts of a path: submissions or scores, split, size, file name


def entry_path(place: Place) -> Path:
    """Return where an entry lies, relative to the folder.

    >>> entry_path(("cavity", "mini", "gns")).as_posix()
    'submissions/cavity/mini/gns.yaml'
    """
    split, size, method = place
    return Path(SUBMISSIONS, split, size, f"{method}.yaml")


def score_paths(place: Place, seeds: Sequence[int | None]) -> tuple[Path, ...]:
    """Return where the score files of an entry lie, relative to the folder.

    The names follow from the entry, so that nothing in it can point elsewhere. An
    underscore, which no method has, parts method and seed.

    >>> [path.name for path in score_paths(("cavity", "mini", "gns"), [0, 3])]
    ['gns_0.nc', 'gns_3.nc']
    """
    split, size, method = place
    if len(seeds) == 1:
        names = [method]
    else:
        names = [f"{method}_{seed}" for seed in seeds]
    return tuple(Path(SCORES, split, size, f"{name}.nc") for name in names)


def weights_path(place: Place, seed: int | None) -> Path:
    """Return where the weights of a seed lie, relative to the folder.

    >>> weights_path(("cavity", "mini", "gns"), 3).as_posix()
    'weights/cavity/mini/gns_3.pt'
    """
    split, size, method = place
    return Path(WEIGHTS, split, size, f"{method}_{seed or 0}.pt")


class Folder:
    """The files of a leaderboard."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def require(
        self,
        fix: str = "run it from the root of the repository, or name it: --board FOLDER",
    ) -> None:
        """Refuse a folder that is no leaderboard."""
        if not (self.path / SUBMISSIONS).is_dir():
            expected = f"a folder that holds {SUBMISSIONS}/"
            raise UsageError(
                "no leaderboard here", where=str(self.path), expected=expected, fix=fix
            )

    def require_room(self) -> None:
        """Refuse to begin a leaderboard among other files, which its page could
        replace.
        """
        if (self.path / SUBMISSIONS).is_dir() or not self.path.exists():
            return
        others = sorted(
            name for name in os.listdir(self.path) if name[0] != "." and name != README
        )
        if others:
            raise UsageError(
                "no room for a leaderboard",
                where=str(self.path),
                expected="a folder that is not there yet, or is empty",
                got=", ".join(map(ascii, others[:3]))
                + (" and more" if len(others) > 3 else ""),
                fix="name another: --board FOLDER",
            )

    def entries(self) -> tuple[Path, ...]:
        """Return the YAML files of entries, relative to the folder, in the order of
        their names.
        """
        return self._sound(SUBMISSIONS)

    def data_sets(self) -> tuple[tuple[str, str], ...]:
        """Return the (split, size) that have entries."""
        self.require()
        return tuple(
            dict.fromkeys((path.parts[1], path.parts[2]) for path in self.entries())
        )

    def score_files(self) -> tuple[Path, ...]:
        """Return the score files, relative to the folder, in the order of their
        names.
        """
        return self._sound(SCORES)

    def reference_files(self, split: str = "", size: str = "") -> tuple[Path, ...]:
        """Return the scores of floors, of one split and size or all, in the order of
        their names.
        """
        return tuple(
            path
            for path in self._sound(REFERENCES)
            if path.parts[1:3] == (split, size) or not split
        )

    def weight_files(self) -> tuple[Path, ...]:
        """Return weights and records of their trainings, in the order of their
        names.
        """
        return self._sound(WEIGHTS)

    def claims(self) -> set[Place]:
        """Return split, size and method of all that lies where an entry would, whatever
        it is.
        """
        ends = ENDINGS[SUBMISSIONS]
        files = [
            p
            for p in self._files(SUBMISSIONS)
            if len(p.parts) == DEPTH and p.suffix in ends
        ]
        return {(path.parts[1], path.parts[2], path.stem) for path in files}

    def odd(self, expected: Collection[Path]) -> Iterator[tuple[Path, str]]:
        """Yield what should not lie in the folder, and why."""
        known = {Path(name) for name in (PAGE, SCHEMA, VERIFIED, README)} | set(
            expected
        )
        for path in self._files(""):
            if path.parts[0] in ENDINGS:
                reason = self.oddity(path)
            else:
                reason = "nothing here knows it"
            if path in known:
                if path == self.link_in(path):
                    reason = f"{path} is a symbolic link"
                else:
                    reason = None
            if reason is not None:
                yield path, reason

    def oddity(self, path: Path) -> str | None:
        """Return why a relative path cannot be an entry or a score file, None if it
        can.
        """
        if (link := self.link_in(path)) is not None:
            return f"{link} is a symbolic link"
        if not stat.S_ISREG((self.path / path).lstat().st_mode):
            return "no regular file"
        endings = ENDINGS[path.parts[0]]
        if not all(PART.fullmatch(part) for part in path.parts):
            return "a name with other characters than letters, digits, '-', '_' and '.'"
        if path.suffix not in endings or len(path.parts) != DEPTH:
            return f"not {path.parts[0]}/<split>/<size>/<name>{' or '.join(endings)}"
        return None

    def link_in(self, path: Path) -> Path | None:
        """Return the first part of a relative path that is a symbolic link, None
        without any.
        """
        whole = [*reversed(path.parents), path][1:]
        return next((part for part in whole if (self.path / part).is_symlink()), None)

    def require_unlinked(self, paths: Iterable[Path]) -> None:
        """Refuse to write to places behind symbolic links, which may lie anywhere."""
        for path in paths:
            if (link := self.link_in(path)) is not None:
                fix = "put the folder or file itself in its place"
                raise UsageError(
                    "a leaderboard holds no links", where=str(self.path / link), fix=fix
                )

    def _sound(self, top: str) -> tuple[Path, ...]:
        return tuple(path for path in self._files(top) if self.oddity(path) is None)

    def _files(self, top: str) -> list[Path]:
        """Return everything under a subfolder that is no folder, links to folders
        included.
        """
        if top and (self.path / top).is_symlink():
            return [Path(top)]
        found: list[Path] = []
        for folder, names, files in os.walk(self.path / top, followlinks=False):
            here = Path(folder)
            links = [name for name in names if (here / name).is_symlink()]
            found += [
                (here / name).relative_to(self.path)
                for name in (*links, *files)
                if name != KEPT
            ]
        return sorted(found, key=lambda path: path.parts)
