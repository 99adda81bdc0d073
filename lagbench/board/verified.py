"""The list of verified entries, leaderboard/verified.yaml.

The list says how far the maintainers followed the scores of an entry: they scored its
predictions again, they ran its model and measured what it costs, they ran it on data
that nobody could know. It lies apart from the entries, so that no submitter can claim
it: ``leaderboard check --base`` names every change to it. A line holds while the entry
has the very score files and models that the line names. ``leaderboard check
--predictions FILE --record`` and ``leaderboard reproduce`` write it.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version

from pydantic import RootModel

from lagbench.atomic import write_atomically
from lagbench.errors import ChecksFailedError

from .entry import Entry, Level, Verification
from .entry_file import examine, format_issues, load_plain, yaml_bytes
from .folder import VERIFIED, Folder
from .lock import board_lock

MOST_LIST_BYTES = 2_000_000
"""Longest list [bytes]; a line takes about 700."""


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
    content = load_plain(path, longest=MOST_LIST_BYTES)
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
            fix="`lagbench leaderboard check --predictions FILE --record` and "
            "`lagbench leaderboard reproduce` write it",
        )
    return verified.root


def verification_of(
    entry: Entry, verified: Mapping[str, Verification]
) -> Verification | None:
    """Return the line of an entry.

    None without one, and where it is about other score files or models.
    """
    line = verified.get(entry.yaml_path.as_posix())
    if line is None or line.scores != _score_hashes(entry):
        return None
    models = {}
    for prediction in entry.predictions:
        if prediction.weights is not None:
            models[prediction.seed] = prediction.weights.sha256
    for reproduction in line.reproduced:
        if models.get(reproduction.seed) != reproduction.model:
            return None
    return line


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
            remaining[path] = line
    return _list_bytes(remaining)


def record_verified(folder: Folder, entries: Sequence[Entry]) -> None:
    """Add entries whose predictions gave the same scores again, or renew their lines.

    Without any entry the file stays as it is.
    """
    for entry in entries:
        record(folder, entry, _raise_to_scored_again)


def _raise_to_scored_again(line: Verification) -> Verification:
    if line.level.rank >= Level.SCORED_AGAIN.rank:
        return line
    return line.model_copy(update={"level": Level.SCORED_AGAIN})


def record(
    folder: Folder, entry: Entry, change: Callable[[Verification], Verification]
) -> Verification:
    """Change the line of an entry, an empty one where it has none; return it.

    The file is read again under the lock, so that a record of somebody else stays.
    """
    with board_lock(folder):
        verified = dict(read_verified(folder))
        line = verification_of(entry, verified)
        if line is None:
            line = Verification(
                scores=_score_hashes(entry),
                lagbench=version("lagbench"),
                date=today(),
                level=Level.AS_SUBMITTED,
            )
        renewed = {"lagbench": version("lagbench"), "date": today()}
        changed = change(line).model_copy(update=renewed)
        verified[entry.yaml_path.as_posix()] = changed
        data = _list_bytes(dict(sorted(verified.items())))
        write_atomically(folder.path / VERIFIED, data, option="--board")
    return changed


def today() -> datetime.date:
    """Return the date of a record."""
    return datetime.datetime.now(datetime.UTC).date()


def _list_bytes(verified: Mapping[str, Verification]) -> bytes:
    lines = {}
    for path, line in verified.items():
        values = line.model_dump(exclude_defaults=True)
        first_keys = {"scores": line.scores, "lagbench": line.lagbench}
        always = {"date": line.date, "level": line.level}
        lines[path] = first_keys | always | values
    return yaml_bytes(lines)


def _score_hashes(entry: Entry) -> tuple[str, ...]:
    return tuple(file.sha256 for file in entry.score.files)
