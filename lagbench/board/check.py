"""Check a leaderboard's folder: ``lagbench leaderboard check``, for every pull request.

All findings together, each with a name: what, where, expected, got, how to fix it. Nothing that
strangers sent is run; their score files are first read in a child process under limits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from lagbench.data.layout import resolve_root
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import LagbenchError
from lagbench.floors import FLOORS
from lagbench.submission import Finding
from lagbench.work.progress import Progress

from .build import build
from .entry import Entry, Status
from .entry_checks import check_entry, finding, parsed, size_of
from .folder import Folder
from .isolation import unreadable_in_child
from .lives import check_lives
from .rescoring import Rescoring, within_reach
from .score_checks import ScoreChecks
from .standing import is_current

__all__ = ["CHECKS", "CheckResult", "check_board"]

CHECKS: Mapping[str, str] = MappingProxyType(
    {
        "folder": "a file, link or folder that has no place under submissions/ or scores/",
        "readable": "an entry that is no plain YAML of at most 64 kB",
        "schema": "unknown or missing keys, values that do not fit, links that are not http(s)",
        "split": "a split or size that datasets.yaml does not have",
        "place": "an entry whose split, size or method is not that of its path",
        "version": "an active entry that was scored on another data set than that of today",
        "lifecycle": "an entry that is superseded by one that is not there, or in the end by itself",
        "predictions": "predictions said to lie in the folder that do not, or of another length",
        "missing": "a score file that is not there",
        "oversize": "a score file of more than 300 kB",
        "score_file": "a score file that was edited, cannot be read, or belongs to something else",
        "statistics": "a score file without a statistic, or without frames, that the scorer measures",
        "truth": "score files of one data set that disagree about what the truth alone decides",
        "score": "a score block or cost that was edited, or a block that the score files do not give",
        "stray": "a score file that no entry has",
        "rescored": "predictions or floors that, scored again, give something else",
        "page": "a page or schema.json that is not what the submissions give",
    }
)
"""Checks by name."""

Known = tuple[Entry, Size]


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """What the checks say of a leaderboard's folder."""

    folder: Path
    entries: int  # entries that were looked at
    findings: tuple[Finding, ...]  # all that is wrong
    page_checked: bool  # whether the page was compared; it is not while anything else is wrong
    floors_rescored: tuple[str, ...] = ()  # splits and sizes whose floors were predicted and scored anew
    floors_trusted: tuple[str, ...] = ()  # those whose floors' numbers were only aggregated again

    @property
    def exit_code(self) -> int:
        """0 where nothing is wrong, else 1."""
        return 1 if self.findings else 0


def check_board(
    board: str | Path,
    *,
    registry: Registry | None = None,
    page: bool = True,
    isolated: bool = True,
    predictions: Sequence[str | Path] = (),
    floors: bool = False,
    root: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> CheckResult:
    """Check entries, score files, aggregates and page of a leaderboard's folder.

    Args:
        board: the leaderboard's folder.
        registry: where splits are described; ours when None.
        page: whether to compare the page too, once nothing else is wrong.
        isolated: whether to read score files in a child process first.
        predictions: predictions of entries to score again.
        floors: whether to predict and score the floors again, where the data are there.
        root: folder of all data sets, for both.
        progress: told how far that scoring is.

    Raises:
        UsageError: no leaderboard there.
        DataError: the test subset is missing, or predictions were made from another data set.
    """
    folder, described = Folder(board), registry or load()
    folder.require()
    files = [folder.path / path for path in folder.score_files()]
    scores = ScoreChecks(folder, unreadable_in_child(files) if isolated else {})
    found = list(_oddities(folder))
    known = _entries(folder, described, scores, found)
    again = Rescoring(
        folder=folder,
        entries=[entry for entry, _ in known],
        sound=scores.sound,
        registry=described,
        root=root,
        progress=progress,
    )
    found += again.of_files(predictions)
    rescored, trusted = _floors(known, again, found, wanted=floors)
    looked = page and not found
    if looked:
        found += _page_drift(folder, described)
    return CheckResult(
        folder=folder.path,
        entries=len(folder.entries()),
        findings=tuple(found),
        page_checked=looked,
        floors_rescored=rescored,
        floors_trusted=trusted,
    )


def _entries(folder: Folder, registry: Registry, scores: ScoreChecks, found: list[Finding]) -> list[Known]:
    """Return the entries that can be read and their sizes; add what is wrong with any."""
    known: list[Known] = []
    paths = folder.entries()
    # floors first: what other entries say of the truth is compared with them
    for path in sorted(paths, key=lambda path: (path.stem not in FLOORS, path.parts)):
        entry = parsed(folder, path, found)
        size = None if entry is None else size_of(entry, registry, found)
        if entry is None or size is None:
            continue
        known.append((entry, size))
        found += check_entry(folder, path, entry, size)
        found += scores.of(entry, size)
    found += check_lives(folder, [entry for entry, _ in known])
    found += _strays(folder, known)
    return known


def _floors(
    known: Sequence[Known], again: Rescoring, found: list[Finding], *, wanted: bool
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Score floors again where wanted and possible; return the sizes where it was done, and others."""
    floors = [
        (entry, size)
        for entry, size in known
        if entry.floor and entry.status is Status.ACTIVE and is_current(entry.dataset, size)
    ]
    done: dict[str, bool] = {}
    for entry, size in sorted(floors, key=lambda pair: pair[0].place):
        near = wanted and within_reach(size, resolve_root(again.root))
        done[f"{size.split} {size.name}"] = near
        if near:
            found += again.of_floor(entry)
    return tuple(name for name in done if done[name]), tuple(name for name in done if not done[name])


def _oddities(folder: Folder) -> Iterator[Finding]:
    for path, reason in folder.odd():
        yield finding(
            "folder",
            "something that has no place here",
            where=ascii(path.as_posix())[1:-1],
            expected="submissions/<split>/<size>/<method>.yaml and scores/<split>/<size>/<name>.nc",
            got=reason,
            fix="remove it; predictions and code are kept elsewhere",
        )


def _strays(folder: Folder, known: Sequence[Known]) -> Iterator[Finding]:
    """Yield score files that belong to nothing, those of entries that cannot be read aside."""
    named = {path for entry, _ in known for path in entry.score_paths}
    unread = folder.claims() - {entry.place for entry, _ in known}
    for path in folder.score_files():
        split, size, name = *path.parts[1:3], path.stem
        if path not in named and (split, size, name.partition("_")[0]) not in unread:
            yield finding(
                "stray",
                "a score file that no entry has",
                where=path,
                expected="an entry that names these predictions",
                got="none that can be read",
                fix="add its entry, or remove it",
            )


def _page_drift(folder: Folder, registry: Registry) -> Iterator[Finding]:
    try:
        build(folder.path, check=True, registry=registry)
    except LagbenchError as error:
        yield finding(
            "page",
            error.what,
            where=error.where,
            expected=error.expected,
            got=error.got,
            fix=error.fix or "",
        )
