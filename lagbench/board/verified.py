"""The list of verified entries, leaderboard/verified.yaml.

The list names the entries whose predictions the maintainers scored again. It lies apart
from the entries, so that no submitter can claim it: ``leaderboard check --base`` names
every change to it. A line holds while the entry has the very score files that the line
names; ``leaderboard check --predictions FILE --record`` writes it.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from importlib.metadata import version

from pydantic import RootModel

from lagbench.atomic import write_atomically
from lagbench.errors import ChecksFailedError

from .entry import Entry, Verification
from .entry_file import examine, format_issues, load_plain, yaml_bytes
from .folder import VERIFIED, Folder


class VerifiedList(RootModel[dict[str, Verification]]):
    """Entries by path, relative to the leaderboard's folder."""


def read_verified(folder: Folder) -> Mapping[str, Verification]:
    """Return the list; empty where there is none.

    Raises:
        UnreadableFileError: the file cannot be read.
        ChecksFailedError: it holds something else.
    """
    path = folder.path / VERIFIED
    if not path.exists() and not path.is_symlink():
        return {}
    content = load_plain(path)
    if content is None:
        content = {}
    verified, issues = examine(VerifiedList, content)
    if verified is None:
        raise ChecksFailedError(
            "the list of verified entries does not fit",
            where=str(path),
            expected="entry path: {scores: [SHA-256, ...], lagbench: VERSION, date: "
            "YYYY-MM-DD}",
            got=format_issues(issues),
            fix="`lagbench leaderboard check --predictions FILE --record` writes it",
        )
    return verified.root


def verification_of(
    entry: Entry, verified: Mapping[str, Verification]
) -> Verification | None:
    """Return the line of an entry; None without one, and for other score files."""
    line = verified.get(entry.yaml_path.as_posix())
    if line is not None and line.scores == _score_hashes(entry):
        return line
    return None


def list_without_stale_line(folder: Folder, entry: Entry) -> bytes | None:
    """Return verified.yaml without an entry's line for other score files.

    None where the list has no such line.
    """
    verified = read_verified(folder)
    name = entry.yaml_path.as_posix()
    if name not in verified or verification_of(entry, verified) is not None:
        return None
    remaining = {}
    for path, line in verified.items():
        if path != name:
            remaining[path] = line.model_dump()
    return yaml_bytes(remaining)


def record_verified(folder: Folder, entries: Sequence[Entry]) -> None:
    """Add entries to the list, or renew their lines.

    Without any entry the file stays as it is.
    """
    if not entries:
        return
    lines: dict[str, object] = {}
    for path, line in read_verified(folder).items():
        lines[path] = line.model_dump()
    for entry in entries:
        lines[entry.yaml_path.as_posix()] = {
            "scores": _score_hashes(entry),
            "lagbench": version("lagbench"),
            "date": datetime.datetime.now(datetime.UTC).date(),
        }
    data = yaml_bytes(dict(sorted(lines.items())))
    write_atomically(folder.path / VERIFIED, data, option="--board")


def _score_hashes(entry: Entry) -> tuple[str, ...]:
    return tuple(file.sha256 for file in entry.score.files)
