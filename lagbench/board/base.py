"""Compare a leaderboard with the commit at which a change left the base.

A pull request adds. Whoever alters the entries of others has to be seen.
"""

from __future__ import annotations

import subprocess
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import yaml

from lagbench.errors import UsageError
from lagbench.scoring.boards import SUBMISSIONS
from lagbench.submission.issues import ValidationIssue

from .entry_file import MAX_ENTRY_BYTES
from .folder import (
    DEPTH,
    GATES,
    REFERENCES,
    SCORES,
    SHIFT,
    VERIFIED,
    WEIGHTS,
    Folder,
)
from .issues import make_issue
from .shift import MOST_SHIFT_BYTES
from .verified import MOST_LIST_BYTES

STATUS_KEYS = ("status", "superseded_by")
"""Keys of an entry that decide whether and how it stands on the board."""

LONGEST_LISTS = {VERIFIED: MOST_LIST_BYTES, SHIFT: MOST_SHIFT_BYTES}
"""Longest lists of entries by name [bytes]; lines of others may not change."""

MOST_KEYS = 8  # keys that an issue names

VERBS = {"A": "added", "D": "removed", "T": "replaced by a link"}
"""Letters of git for the way in which a file changed; others mean "changed"."""

# settings of the checkout must neither run programs nor quote paths
SAFE_OPTIONS = (
    "-c",
    "core.fsmonitor=false",
    "-c",
    "core.quotePath=false",
    "--no-optional-locks",
)


def check_base(
    folder: Folder, base: str, own_methods: Collection[str]
) -> Iterator[ValidationIssue]:
    """Yield the entries of others that a change touches, removes or supersedes.

    Args:
        folder: the leaderboard.
        base: git revision that the change is compared with.
        own_methods: methods whose entries the change may alter.

    Raises:
        UsageError: git does not know the revision, or the folder is in no repository.
    """
    start = _git(folder, "merge-base", base, "HEAD").decode().strip()
    paths_at_start = _paths_at(folder, start)
    for path, letter in sorted(_changes_since(folder, start).items()):
        verb = VERBS.get(letter, "changed")
        if str(path) in LONGEST_LISTS:
            if not _lost_own_lines_only(folder, path, start, own_methods):
                yield _maintained_issue(path, verb)
        elif path == Path(GATES):
            yield _maintained_issue(path, verb)
        elif path.parts[0] == REFERENCES:
            if path in paths_at_start:
                yield _maintained_issue(path, verb)
        elif path.parts[0] in (SUBMISSIONS, SCORES, WEIGHTS):
            if len(path.parts) != DEPTH:
                continue
            method = path.stem.partition("_")[0]
            entry = Path(SUBMISSIONS, *path.parts[1:3], f"{method}.yaml")
            if entry not in paths_at_start or method in own_methods:
                continue
            if path == entry and letter == "M":
                verb = _describe_change(folder, start, entry)
            yield make_issue(
                "base", path, verb, expected=f"{entry} and its score files, unchanged"
            )


def _maintained_issue(path: Path, verb: str) -> ValidationIssue:
    return make_issue(
        "base", path, verb, expected="a file of the maintainers, unchanged"
    )


def _paths_at(folder: Folder, revision: str) -> set[Path]:
    """Return the files of the folder at a revision, relative to the folder."""
    listing = _git(folder, "ls-tree", "-r", "-z", "--name-only", revision, ".")
    return {Path(name) for name in listing.decode().split("\0") if name}


def _changes_since(folder: Folder, revision: str) -> dict[Path, str]:
    """Return the letter of git for every file that changed, untracked files too."""
    diff = _git(
        folder,
        "diff",
        "--name-status",
        "--no-renames",
        "--relative",
        "-z",
        revision,
        "--",
        ".",
    )
    words = diff.decode("utf-8", "replace").split("\0")[:-1]
    changes = {}
    for letters, name in zip(words[0::2], words[1::2], strict=True):
        changes[Path(name)] = letters[:1]

    # files that git does not follow yet may still take the place of others'
    untracked = _git(folder, "ls-files", "--others", "-z", ".")
    for name in untracked.decode("utf-8", "replace").split("\0"):
        if name:
            changes[Path(name)] = "A"
    return changes


def _lost_own_lines_only(
    folder: Folder, path: Path, start: str, own_methods: Collection[str]
) -> bool:
    """Tell whether a list of entries only lost lines of the submitter's own ones."""
    try:
        before = _parse(_git(folder, "show", f"{start}:./{path}"))
    except UsageError:  # it was not there
        return False
    now = None
    if folder.link_in(path) is None:
        now = _read_small(folder.path / path, longest=LONGEST_LISTS[path.name])
    if not isinstance(before, dict) or not isinstance(now, dict):
        return False

    lost_names = before.keys() - now.keys()
    remaining = {}
    for name, line in before.items():
        if name in now:
            remaining[name] = line
    is_own = all(Path(str(name)).stem in own_methods for name in lost_names)
    return now == remaining and bool(lost_names) and is_own


def _describe_change(folder: Folder, start: str, entry: Path) -> str:
    """Return which keys of an entry differ; keys of its status with both values."""
    before = _parse(_git(folder, "show", f"{start}:./{entry.as_posix()}"))
    now = None
    if folder.reason_unfit(entry) is None:
        now = _read_small(folder.path / entry)
    if not isinstance(before, dict) or not isinstance(now, dict):
        return "another content"

    names = []
    for key in {**before, **now}:
        if before.get(key) != now.get(key):
            names.append(key)
    clauses = []
    for key in STATUS_KEYS:
        if key in names:
            clauses.append(f"{key} {before.get(key)!a:.60} -> {now.get(key)!a:.60}")
    other_keys = []
    for name in names:
        if name not in STATUS_KEYS:
            other_keys.append(ascii(str(name))[1:-1][:40])
    if other_keys:
        clauses.append(f"other {', '.join(other_keys[:MOST_KEYS])}")
    return "; ".join(clauses) or "another wording"


def _read_small(path: Path, *, longest: int = MAX_ENTRY_BYTES) -> Any:  # noqa: ANN401
    """Return the content of a YAML file; None where it is missing or too long."""
    if not path.is_file() or path.stat().st_size > longest:
        return None
    return _parse(path.read_bytes())


def _parse(data: bytes) -> Any:  # noqa: ANN401
    """Return the content of YAML with all values as text; None where it is none.

    The loader that makes text of every value cannot fail on numbers and dates. Aliases
    could expand to any length.
    """
    if b"&" in data and b"*" in data:
        return None
    try:
        return yaml.load(data, Loader=yaml.BaseLoader)
    except (yaml.YAMLError, ValueError, RecursionError):
        return None


def _git(folder: Folder, *words: str) -> bytes:
    """Return the output of a git command in the folder."""
    command = ["git", *SAFE_OPTIONS, "-C", str(folder.path), *words]
    try:
        process = subprocess.run(command, capture_output=True, check=True, timeout=60)
    except (OSError, subprocess.SubprocessError) as error:
        message = getattr(error, "stderr", None) or str(error).encode()
        first_line = message.decode("utf-8", "replace").strip().split("\n")[0]
        raise UsageError(
            "git cannot say what the change alters",
            where=f"--base, {folder.path}",
            expected="a leaderboard in a git repository, and a revision that it "
            "knows, as in origin/main",
            got=ascii(first_line[:200])[1:-1],
            fix="run it in a clone with history (fetch the base), or leave --base out",
        ) from error
    return process.stdout
