"""The gates of graph networks: what their weights must do to support a claim.

``python -m studies.gates`` measures the gates of single steps and short rollouts, and
leaderboard/gates.json holds which weights failed which. The error after twenty frames
is in the scores. docs/baselines.md says what the gates are.
"""

from __future__ import annotations

import json
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace

from lagbench.errors import UnreadableFileError

from .entry import Entry
from .folder import GATES, Folder
from .rows import Row

EARLY_ERROR = "position_rmse_20"
EARLY_GATE = "twenty_frames"
YARDSTICK = "neuralmpm"
MOST_EARLY_ERROR = 3.0
"""Error of the first twenty frames that a graph network may have, over NeuralMPM's."""


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


def with_early_gate(rows: Sequence[Row], measured: Container[str]) -> list[Row]:
    """Return the rows of a data set with the gate of twenty frames.

    Args:
        rows: all rows.
        measured: SHA-256 of all weights that have gates; they are graph networks.
    """
    errors = {}
    for row in rows:
        if EARLY_ERROR in row.metrics:  # not where the horizon is shorter
            errors[row.id] = row.metrics[EARLY_ERROR].mean
    if YARDSTICK not in errors:
        return list(rows)

    limit = MOST_EARLY_ERROR * errors[YARDSTICK]
    judged = []
    for row in rows:
        is_graph_network = row.entry is not None and any(
            one.weights is not None and one.weights.sha256 in measured
            for one in row.entry.predictions
        )
        if is_graph_network and errors[row.id] > limit:
            row = replace(row, failed_gates=(*row.failed_gates, EARLY_GATE))
        judged.append(row)
    return judged
