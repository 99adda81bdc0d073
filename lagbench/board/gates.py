"""The gates of trained weights, leaderboard/gates.json: which weights failed which.

``python -m studies.gates`` measures them; docs/baselines.md says what they are.
"""

from __future__ import annotations

import json
from collections.abc import Mapping

from lagbench.errors import UnreadableFileError

from .entry import Entry
from .folder import GATES, Folder


def read_failed_gates(folder: Folder) -> Mapping[str, tuple[str, ...]]:
    """Return the gates that weights failed, by SHA-256 of the weights.

    Weights that passed all have none; weights that were not measured are absent.

    Raises:
        UnreadableFileError: the file is not what ``python -m studies.gates`` writes.
    """
    path = folder.path / GATES
    if not path.is_file():
        return {}
    failed = {}
    try:
        for row in json.loads(path.read_bytes())["weights"]:
            failed[row["weights_sha256"]] = tuple(row["failed"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise UnreadableFileError(
            f"{path} cannot be read: {error}; write it anew: python -m studies.gates"
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
