"""The gates of trained weights, leaderboard/gates.json: which weights failed which.

``python -m studies.gates`` measures them; docs/baselines.md says what they are.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from lagbench.errors import UnreadableFileError

from .entry import Entry
from .folder import GATES, Folder

MOST_BYTES = 1_000_000


def read_failed_gates(folder: Folder) -> Mapping[str, tuple[str, ...]]:
    """Return the gates that weights failed, by SHA-256 of the weights.

    Weights that passed all have none; weights that were not measured are absent.

    Raises:
        UnreadableFileError: the file is not what ``python -m studies.gates`` writes.
    """
    path = folder.path / GATES
    if path.is_symlink() or not path.is_file():
        return {}
    failed = {}
    try:
        with path.open("rb") as file:
            content = json.loads(file.read(MOST_BYTES))
        rows = content["weights"]
        if not isinstance(rows, list):
            raise TypeError(f"weights is no list: {ascii(rows)[:80]}")
        for row in rows:
            gates = row["failed"]
            if not isinstance(gates, list):
                raise TypeError(f"failed is no list: {ascii(gates)[:80]}")
            failed[str(row["weights_sha256"])] = tuple(map(str, gates))
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise UnreadableFileError(
            "the gates cannot be read",
            where=str(path),
            expected="the JSON that `python -m studies.gates` writes",
            got=error,
            fix="write them anew: python -m studies.gates",
        ) from error
    return failed


def gates_failed_by(
    entry: Entry, failed: Mapping[str, tuple[str, ...]]
) -> tuple[str, ...]:
    """Return the gates that any weights of an entry failed."""
    names: dict[str, None] = {}
    for prediction in entry.predictions:
        if prediction.weights is not None:
            names.update(dict.fromkeys(failed.get(prediction.weights.sha256, ())))
    return tuple(names)
