"""What a change does to entries that were there before it: ``lagbench leaderboard check --base``.

A pull request adds; whoever alters what others submitted has to be seen. The folder as it is
is compared with the commit at which the change left the base.
"""

from __future__ import annotations

import subprocess
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import yaml

from lagbench.errors import UsageError
from lagbench.submission.findings import Finding

from .entry_file import MAX_ENTRY_BYTES
from .findings import finding
from .folder import FLOORS, SCORES, SUBMISSIONS, VERIFIED, WEIGHTS, Folder

__all__ = ["check_base"]

KEYS = ("status", "superseded_by")
"""Keys of an entry that decide whether and how it stands on the board."""


def check_base(folder: Folder, base: str, own: Collection[str]) -> Iterator[Finding]:
    """Yield the entries of others that a change touches, removes, supersedes or alters in status."""
    start = _git(folder, "merge-base", base, "HEAD").decode().strip()
    told = _git(folder, "diff", "--name-status", "--no-renames", "--relative", "-z", start, "--", ".")
    words = told.decode("utf-8", "replace").split("\0")[:-1]
    before = set(_git(folder, "ls-tree", "-r", "-z", "--name-only", start, ".").decode().split("\0"))
    changes = dict(zip(map(Path, words[1::2]), words[0::2], strict=True))
    # files that git does not follow yet may still take the place of others'
    untracked = _git(folder, "ls-files", "--others", "-z", ".").decode("utf-8", "replace").split("\0")
    changes |= {Path(name): "A" for name in untracked if name}
    for path, how in sorted(changes.items()):
        if path == Path(VERIFIED) or path.parts[0] == FLOORS:
            if path.as_posix() in before or path == Path(VERIFIED):
                yield finding("base", path, _verb(how), expected="what the maintainers keep, unchanged")
        elif path.parts[0] in (SUBMISSIONS, SCORES, WEIGHTS) and len(path.parts) == 4:
            method = path.stem.partition("_")[0]
            entry = Path(SUBMISSIONS, *path.parts[1:3], f"{method}.yaml")
            if entry.as_posix() not in before or method in own:
                continue
            got = _verb(how)
            if path == entry and how == "M":
                got = _altered(_at(folder, start, entry), _now(folder, entry))
            yield finding("base", path, got, expected=f"{entry} and its score files, unchanged")


def _verb(how: str) -> str:
    return {"A": "added", "D": "removed", "T": "replaced by a link"}.get(how[:1], "changed")


def _altered(before: Any, now: Any) -> str:  # noqa: ANN401
    """Return which keys differ; those that decide how the entry stands with both values."""
    if not isinstance(before, dict) or not isinstance(now, dict):
        return "another content"
    names = [str(key) for key in {**before, **now} if before.get(key) != now.get(key)]
    said = [f"{key} {before.get(key)!a:.60} -> {now.get(key)!a:.60}" for key in KEYS if key in names]
    others = [ascii(name)[1:-1][:40] for name in names if name not in KEYS][:8]
    return "; ".join(said + ([f"other {', '.join(others)}"] if others else [])) or "another wording"


def _at(folder: Folder, revision: str, path: Path) -> Any:  # noqa: ANN401
    """Return what an entry held at a revision, None where that was no YAML."""
    return _plain(_git(folder, "show", f"{revision}:./{path.as_posix()}"))


def _now(folder: Folder, path: Path) -> Any:  # noqa: ANN401
    if folder.oddity(path) is not None or (folder.path / path).stat().st_size > MAX_ENTRY_BYTES:
        return None
    return _plain((folder.path / path).read_bytes())


def _plain(data: bytes) -> Any:  # noqa: ANN401
    # the loader that makes text of every value: it cannot fail on numbers and dates
    try:
        return None if b"&" in data and b"*" in data else yaml.load(data, Loader=yaml.BaseLoader)
    except (yaml.YAMLError, ValueError, RecursionError):
        return None


def _git(folder: Folder, *words: str) -> bytes:
    # settings of the checkout must neither run programs nor quote paths
    safe = ("-c", "core.fsmonitor=false", "-c", "core.quotePath=false", "--no-optional-locks")
    try:
        done = subprocess.run(
            ["git", *safe, "-C", str(folder.path), *words], capture_output=True, check=True, timeout=60
        )
    except (OSError, subprocess.SubprocessError) as error:
        said = getattr(error, "stderr", None) or str(error).encode()
        raise UsageError(
            "git cannot say what the change alters",
            where=f"--base, {folder.path}",
            expected="a leaderboard in a git repository, and a revision that it knows, as in origin/main",
            got=ascii(said.decode("utf-8", "replace").strip().split("\n")[0][:200])[1:-1],
            fix="run it in a clone with history (fetch the base), or leave --base out",
        ) from error
    return done.stdout
