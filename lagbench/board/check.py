"""Check a leaderboard's folder: ``lagbench leaderboard check``, for every pull request.

All findings together, each with a name: what, where, expected, got, how to fix it. Nothing that
strangers sent is run; their score files are first read in a child process under limits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from lagbench.errors import LagbenchError
from lagbench.progress import Progress
from lagbench.registry import Registry, load
from lagbench.submission import Finding

from .build import build
from .entry_checks import check_entry, finding, parsed, size_of
from .folder import Folder
from .isolation import unreadable_in_child
from .rescoring import check_predictions
from .score_checks import check_scores

__all__ = ["CHECKS", "CheckResult", "check_board"]

CHECKS: Mapping[str, str] = MappingProxyType(
    {
        "folder": "a file, link or folder that has no place under submissions/ or scores/",
        "readable": "an entry that is no plain YAML of at most 64 kB",
        "schema": "unknown or missing keys, values that do not fit, links that are not http(s)",
        "split": "a split or size that datasets.yaml does not have",
        "place": "an entry whose split, size or method is not that of its path",
        "version": "an active entry that was scored on another data set than that of today",
        "lifecycle": "an entry that is superseded by one that is not there, or by itself",
        "predictions": "predictions said to lie in the folder that do not, or of another length",
        "missing": "a score file that is not there",
        "oversize": "a score file of more than 300 kB",
        "score_file": "a score file that was edited, cannot be read, or belongs to something else",
        "score": "a score block that was edited, or is not what the score files give",
        "stray": "a score file that no entry has",
        "rescored": "predictions that, scored again, give something else (with --predictions)",
        "page": "a page or schema.json that is not what the submissions give",
    }
)
"""Checks by name."""


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """What the checks say of a leaderboard's folder.

    Attributes:
        folder: the folder.
        entries: entries that were looked at.
        findings: all that is wrong.
        page_checked: whether the page was compared; it is not while anything else is wrong.
    """

    folder: Path
    entries: int
    findings: tuple[Finding, ...]
    page_checked: bool

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
        root: folder of all data sets, for these.
        progress: told how far that scoring is.

    Raises:
        UsageError: no leaderboard there.
        UnreadableFileError: predictions cannot be read.
        ChecksFailedError: they are not valid.
        DataError: the test subset is missing, or they were made from another data set.
    """
    folder, described = Folder(board), registry or load()
    folder.require()
    files = [folder.path / path for path in folder.score_files()]
    broken = unreadable_in_child(files) if isolated else {}
    found, named = list(_oddities(folder)), set[Path]()
    paths = folder.entries()
    for path in paths:
        entry = parsed(folder, path, found)
        if entry is None:
            continue
        named.update(entry.score_paths)
        size = size_of(entry, described, found)
        if size is not None:
            found += check_entry(folder, path, entry, size)
            found += check_scores(folder, entry, size, broken)
    found += _strays(folder, named)
    if predictions:
        found += check_predictions(folder, predictions, root=root, registry=described, progress=progress)
    looked = page and not found
    if looked:
        found += _page_drift(folder, described)
    return CheckResult(folder=folder.path, entries=len(paths), findings=tuple(found), page_checked=looked)


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


def _strays(folder: Folder, named: set[Path]) -> Iterator[Finding]:
    for path in folder.score_files():
        if path not in named:
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
