"""The leaderboard's folder: where its files lie, and nothing outside it.

    submissions/<split>/<size>/<method>.yaml      entries
    scores/<split>/<size>/<method>[_<seed>].nc    their score files
    floors/<split>/<size>/<name>.nc               scores of the reference predictors
    weights/<split>/<size>/<method>_<seed>.safetensors   weights, and their log, .json
    weights/<split>/<size>/<method>_<seed>.onnx   or a model as an ONNX file
    verified.yaml, gates.json, schema.json, index.html, README.md

Symbolic links are never followed: one could lead out of the folder.
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

from lagbench.errors import UsageError
from lagbench.scoring.boards import SUBMISSIONS, require_board
from lagbench.submission.other_files import MODEL_ENDINGS

Place = tuple[str, str, str]  # split, size and method

SCORES = "scores"
REFERENCES = "floors"
WEIGHTS = "weights"
PAGE = "index.html"
SCHEMA = "schema.json"
VERIFIED = "verified.yaml"
GATES = "gates.json"  # what weights do in single steps (python -m studies.gates)
SHIFT = "shift.yaml"  # scores on the subset shift (lagbench leaderboard shift)
README = "README.md"
LOCK = ".lock"  # held while the folder is written
STAGING = ".submit-"  # begins the name of a folder of files that are not in place yet

ENDINGS = {
    SUBMISSIONS: (".yaml",),
    SCORES: (".nc",),
    REFERENCES: (".nc",),
    WEIGHTS: (*MODEL_ENDINGS, ".json"),
}
PLACEHOLDER = ".gitkeep"  # keeps an empty folder in git
GIT = (".git", ".gitignore", ".gitattributes", ".github")
"""What a leaderboard that is the root of a git repository has beside its files."""
PART = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
"""Names of folders and files: nothing that a terminal or a CI log would obey."""

DEPTH = 4  # parts of a path: submissions or scores, split, size, file name


def entry_path(place: Place) -> Path:
    """Return the path of an entry, relative to the folder.

    >>> entry_path(("cavity", "mini", "gns")).as_posix()
    'submissions/cavity/mini/gns.yaml'
    """
    split, size, method = place
    return Path(SUBMISSIONS, split, size, f"{method}.yaml")


def score_paths(place: Place, seeds: Sequence[int | None]) -> tuple[Path, ...]:
    """Return the paths of the score files of an entry, relative to the folder.

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
    paths = []
    for name in names:
        paths.append(Path(SCORES, split, size, f"{name}.nc"))
    return tuple(paths)


def is_place_of_file(path: Path) -> bool:
    """Tell whether a submission may write a file at a relative path.

    >>> is_place_of_file(Path("scores/cavity/mini/gns.nc"))
    True
    >>> is_place_of_file(Path("scores/../../gns.nc"))
    False
    """
    if path in (Path(VERIFIED), Path(SHIFT)):
        return True
    if len(path.parts) != DEPTH or not all(map(PART.fullmatch, path.parts)):
        return False
    return path.suffix in ENDINGS.get(path.parts[0], ())


def weights_path(
    place: Place, seed: int | None, like: str | Path = ".safetensors"
) -> Path:
    """Return the path of the model of a seed, relative to the folder.

    Args:
        place: split, size and method of the entry.
        seed: seed of the training; None, where none is stated, is written as 0.
        like: a file name; the path ends as it does, where models may end so.

    >>> weights_path(("cavity", "mini", "gns"), 3).as_posix()
    'weights/cavity/mini/gns_3.safetensors'
    """
    split, size, method = place
    ending = ".safetensors"
    if Path(like).suffix in MODEL_ENDINGS:
        ending = Path(like).suffix
    return Path(WEIGHTS, split, size, f"{method}_{seed or 0}{ending}")


class Folder:
    """The files of a leaderboard."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def require(self, fix: str | None = None) -> None:
        """Refuse a folder that is no leaderboard."""
        require_board(self.path, fix=fix)

    def require_room(self) -> None:
        """Refuse to begin a leaderboard among other files: its page could replace
        them.
        """
        if (self.path / SUBMISSIONS).is_dir() or not self.path.exists():
            return
        other_names = []
        for name in sorted(os.listdir(self.path)):
            if not name.startswith(".") and name != README:
                other_names.append(name)
        if not other_names:
            return

        shown = ", ".join(ascii(name) for name in other_names[:3])
        if len(other_names) > 3:
            shown += " and more"
        raise UsageError(
            "a new leaderboard cannot be made here",
            where=str(self.path),
            expected="a folder that is not there yet, or is empty",
            got=shown,
            fix="name another: --board FOLDER",
        )

    def entries(self) -> tuple[Path, ...]:
        """Return the YAML files of entries, relative to the folder, ordered by name."""
        return self._fit_files(SUBMISSIONS)

    def data_sets(self) -> tuple[tuple[str, str], ...]:
        """Return the (split, size) that have entries."""
        self.require()
        data_sets: dict[tuple[str, str], None] = {}
        for path in self.entries():
            data_sets[(path.parts[1], path.parts[2])] = None
        return tuple(data_sets)

    def score_files(self) -> tuple[Path, ...]:
        """Return the score files, relative to the folder, ordered by name."""
        return self._fit_files(SCORES)

    def reference_files(self, split: str = "", size: str = "") -> tuple[Path, ...]:
        """Return the score files of reference predictors of a data set, or of all."""
        paths = self._fit_files(REFERENCES)
        if not split:
            return paths
        matching_paths = []
        for path in paths:
            if path.parts[1:3] == (split, size):
                matching_paths.append(path)
        return tuple(matching_paths)

    def weight_files(self) -> tuple[Path, ...]:
        """Return weights and the logs of their trainings, ordered by name."""
        return self._fit_files(WEIGHTS)

    def claimed_places(self) -> set[Place]:
        """Return split, size and method of every path that has the name of an entry.

        The path may also be a link, or a file that cannot be read.
        """
        places = set()
        for path in self._files(SUBMISSIONS):
            if len(path.parts) == DEPTH and path.suffix in ENDINGS[SUBMISSIONS]:
                places.add((path.parts[1], path.parts[2], path.stem))
        return places

    def find_misplaced(
        self, expected_paths: Collection[Path]
    ) -> Iterator[tuple[Path, str]]:
        """Yield the files that should not lie in the folder, and why."""
        names = (PAGE, SCHEMA, VERIFIED, GATES, SHIFT, README)
        known_paths = {Path(name) for name in names} | set(expected_paths)
        for path in self._files(""):
            reason = self._reason_irregular(path)
            if reason is None and path not in known_paths:
                reason = self._reason_misnamed(path)
            if reason is not None:
                yield path, reason

    def staging_folders(self) -> tuple[Path, ...]:
        """Return the folders that killed submissions left behind."""
        return tuple(sorted(self.path.glob(f"{STAGING}*")))

    def reason_unfit(self, path: Path) -> str | None:
        """Return why a relative path cannot be an entry or a score file, else None."""
        return self._reason_irregular(path) or self._reason_misnamed(path)

    def _reason_irregular(self, path: Path) -> str | None:
        """Return why a relative path is no regular file in the folder, else None."""
        link = self.link_in(path)
        if link is not None:
            return f"{link} is a symbolic link"
        if not stat.S_ISREG((self.path / path).lstat().st_mode):
            return "no regular file"
        return None

    def _reason_misnamed(self, path: Path) -> str | None:
        """Return why a relative path has no name of a submission's file, else None."""
        top = path.parts[0]
        if top not in ENDINGS:
            return "no file of a leaderboard has this name"
        if not all(PART.fullmatch(part) for part in path.parts):
            return (
                "a name that does not consist of 1 to 100 letters, digits, '-', '_' "
                "and '.', a letter or digit first"
            )
        endings = ENDINGS[top]
        if path.suffix not in endings or len(path.parts) != DEPTH:
            return f"not {top}/<split>/<size>/<name>{' or '.join(endings)}"
        return None

    def link_in(self, path: Path) -> Path | None:
        """Return the shortest beginning of a path that is a symbolic link, else None.

        Args:
            path: relative to the board.
        """
        parts_from_top = [*reversed(path.parents), path][1:]
        for part in parts_from_top:
            if (self.path / part).is_symlink():
                return part
        return None

    def require_unlinked(self, paths: Iterable[Path]) -> None:
        """Refuse to write to places behind symbolic links, which may lie anywhere."""
        for path in paths:
            link = self.link_in(path)
            if link is not None:
                raise UsageError(
                    "a leaderboard holds no links",
                    where=str(self.path / link),
                    expected="a folder or a file",
                    got="a symbolic link",
                    fix="put the folder or file itself in its place",
                )

    def _fit_files(self, top: str) -> tuple[Path, ...]:
        fit_paths = []
        for path in self._files(top):
            if self.reason_unfit(path) is None:
                fit_paths.append(path)
        return tuple(fit_paths)

    def _files(self, top: str) -> list[Path]:
        """Return everything under a subfolder that is no folder.

        Links to folders are included and not followed.
        """
        if top and (self.path / top).is_symlink():
            return [Path(top)]
        paths: list[Path] = []
        for folder, folder_names, file_names in os.walk(self.path / top):
            here = Path(folder)
            if here == self.path:
                passed_over = {LOCK, *GIT}
                folder_names[:] = sorted(set(folder_names) - passed_over)
                file_names = sorted(set(file_names) - passed_over)
            links = []
            for name in folder_names:
                if (here / name).is_symlink():
                    links.append(name)
            for name in (*links, *file_names):
                if name != PLACEHOLDER:
                    paths.append((here / name).relative_to(self.path))
        return sorted(paths, key=lambda path: path.parts)
