"""The leaderboard's folder: where its files lie.

submissions/<split>/<size>/<method>.yaml      entries
scores/<split>/<size>/<method>[_<seed>].nc    their score files
weights/<split>/<size>/<method>_<seed>.safetensors   weights, or .onnx; a log .json
design/<name>.json                            judged entries of the design track
verified.yaml, shift.yaml, gates.json, schema.json, index.html, README.md
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import filelock

from lagbench.errors import UsageError, WorkFailedError
from lagbench.scoring.boards import SUBMISSIONS, find_board

Place = tuple[str, str, str]  # split, size and method

SCORES = "scores"
WEIGHTS = "weights"
DESIGN = "design"
PAGE = "index.html"
SCHEMA = "schema.json"
VERIFIED = "verified.yaml"
GATES = "gates.json"  # what weights do in single steps (python -m studies.gates)
SHIFT = "shift.yaml"  # scores on the subset shift (lagbench leaderboard shift)
README = "README.md"

TOP_FILES = (PAGE, SCHEMA, VERIFIED, GATES, SHIFT, README)

ENDINGS = {
    SUBMISSIONS: (".yaml",),
    SCORES: (".nc",),
    WEIGHTS: (".onnx", ".safetensors", ".json"),
}

DEPTH = 4  # parts of a path: submissions or scores, split, size, file name

LONGEST_WAIT = 120.0
"""Longest wait for another writer [s]; it holds the lock for seconds."""


def entry_path(place: Place) -> Path:
    """Return the path of an entry, relative to the folder.

    >>> entry_path(("cavity", "mini", "gns")).as_posix()
    'submissions/cavity/mini/gns.yaml'
    """
    split, size, method = place
    return Path(SUBMISSIONS, split, size, f"{method}.yaml")


def score_paths(place: Place, seeds: Sequence[int | None]) -> tuple[Path, ...]:
    """Return the paths of the score files of an entry, relative to the folder.

    >>> [path.name for path in score_paths(("cavity", "mini", "gns"), [0, 3])]
    ['gns_0.nc', 'gns_3.nc']
    """
    split, size, method = place
    names = [method]
    if len(seeds) > 1:
        names = [f"{method}_{seed}" for seed in seeds]
    return tuple(Path(SCORES, split, size, f"{name}.nc") for name in names)


def weights_path(place: Place, seed: int | None, like: str | Path) -> Path:
    """Return the path of the model of a seed, relative to the folder.

    Args:
        place: split, size and method of the entry.
        seed: seed of the training; None, where none is stated, is written as 0.
        like: a file name; the path ends as it does.

    >>> weights_path(("cavity", "mini", "gns"), 3, "weights.safetensors").as_posix()
    'weights/cavity/mini/gns_3.safetensors'
    """
    split, size, method = place
    return Path(WEIGHTS, split, size, f"{method}_{seed or 0}{Path(like).suffix}")


class Folder:
    """The files of a leaderboard."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def require(self) -> None:
        """Refuse a folder that is no leaderboard."""
        find_board(self.path)

    def require_room(self) -> None:
        """Refuse to begin a leaderboard among other files."""
        if (self.path / SUBMISSIONS).is_dir() or not self.path.exists():
            return
        names = [path.name for path in self.path.iterdir() if path.name[0] != "."]
        if names and names != [README]:
            raise UsageError(
                f"{self.path} is no empty folder; name another: --board FOLDER"
            )

    def entries(self) -> tuple[Path, ...]:
        """Return the YAML files of entries, relative to the folder, ordered by name."""
        return self.files(SUBMISSIONS)

    def data_sets(self) -> tuple[tuple[str, str], ...]:
        """Return the (split, size) that have entries."""
        self.require()
        data_sets: dict[tuple[str, str], None] = {}
        for path in self.entries():
            data_sets[(path.parts[1], path.parts[2])] = None
        return tuple(data_sets)

    def files(self, top: str) -> tuple[Path, ...]:
        """Return the files <top>/<split>/<size>/<name> of their endings, by name."""
        paths = []
        for path in sorted((self.path / top).glob("*/*/*")):
            if path.is_file() and path.suffix in ENDINGS[top]:
                paths.append(path.relative_to(self.path))
        return tuple(paths)

    def design_files(self) -> tuple[Path, ...]:
        """Return the files of the design track, relative to the folder, by name."""
        paths = sorted((self.path / DESIGN).glob("*.json"))
        return tuple(path.relative_to(self.path) for path in paths)

    def misplaced(self) -> Iterator[Path]:
        """Yield links, and files that are not part of a leaderboard.

        What begins with a dot at the top is left out, as .git is.
        """
        for path in sorted(self.path.rglob("*")):
            inner = path.relative_to(self.path)
            if inner.parts[0].startswith(".") or path.name == ".gitkeep":
                continue
            if path.is_symlink():
                yield inner
            elif not path.is_dir():
                is_known = inner.as_posix() in TOP_FILES
                is_in_place = len(inner.parts) == DEPTH and (
                    inner.suffix in ENDINGS.get(inner.parts[0], ())
                )
                is_design = inner in self.design_files()
                if not (is_known or is_in_place or is_design):
                    yield inner

    @contextmanager
    def lock(self, timeout: float = LONGEST_WAIT) -> Iterator[None]:
        """Be the only writer of the leaderboard; its folder is made if there is none.

        Raises:
            WorkFailedError: another process writes, or the folder cannot be written.
        """
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            lock = filelock.FileLock(self.path / ".lock")
            lock.acquire(timeout=timeout)
        except filelock.Timeout:
            raise WorkFailedError(
                f"another process writes to {self.path}; try again when it has ended"
            ) from None
        except OSError as error:
            raise WorkFailedError(
                f"cannot write to {self.path}: {error.strerror}; name another: --board"
            ) from error
        try:
            yield
        finally:
            lock.release()
