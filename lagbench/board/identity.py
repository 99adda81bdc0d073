"""Tell equal predictions and look-alike names apart, and find impossible scores.

A fingerprint is a hash of the errors of predictions: only the same predictions share
it, whatever their label. Two names with the same confusable key look alike to readers
(compare Unicode Technical Standard 39, Unicode Security Mechanisms).
"""

from __future__ import annotations

import hashlib
import unicodedata
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from lagbench.errors import UnreadableFileError
from lagbench.metrics.aggregate import Tally
from lagbench.metrics.metric import Direction
from lagbench.metrics.table import METRICS, STATISTICS
from lagbench.scoring.score_file_checks import ScoreFile, read_score_file

from .entry import Entry
from .folder import Folder
from .model import Floats

# share of the greatest value by which rounding may take one below zero, or above one
ROUNDING = 1e-6


def fingerprint_of(tallies: Mapping[int, Tally]) -> str:
    """Return a hash of the errors of predictions in every scenario and frame.

    Only statistics of lagbench count: what a package measures beside them tells nothing
    apart.
    """
    digest = hashlib.sha256()
    for scenario, tally in sorted(tallies.items()):
        names = []
        for name in STATISTICS:
            if name in tally.names:
                names.append(name)
        rows = [tally.names.index(name) for name in names]
        totals = tally.total[rows].astype(np.float32)
        digest.update(f"{scenario} {names} {tally.frames}".encode())
        digest.update(np.ascontiguousarray(totals).tobytes())
    return digest.hexdigest()


def fingerprints_of_entries(
    folder: Folder, entries: Mapping[Path, Entry]
) -> dict[str, str]:
    """Return the score file of every fingerprint that entries have.

    Score files that cannot be read are passed over: `lagbench leaderboard check`
    reports them.
    """
    score_files = {}
    for entry in entries.values():
        for path in entry.score_paths:
            with suppress(UnreadableFileError):
                tallies = read_score_file(folder.path / path).scores.tallies
                score_files[fingerprint_of(tallies)] = str(path)
    return score_files


def find_impossible_values(stored: ScoreFile) -> Iterator[str]:
    """Yield values that no prediction can have, whoever wrote them.

    Errors and distances are never negative, correlations never above one. Where one
    error of a scenario is zero at all frames, the others are, too: the prediction is
    the truth. The ranking metric has a value at some frame.
    """
    if _lacks_ranking_values(stored):
        yield f"no value of {stored.scores.ranking} in any scenario"
    for scenario, tally in sorted(stored.scores.tallies.items()):
        rows = []
        names = []
        for row, name in enumerate(tally.names):
            if name in METRICS:
                rows.append(row)
                names.append(name)
        if not names:
            continue
        values = tally.values[rows]
        for name, outlier in _values_out_of_range(names, values):
            yield f"{name} {outlier:.6g} in scenario {scenario}"
        for name in _false_zeros(names, values):
            yield (
                f"{name} 0 at all frames of scenario {scenario}, though the "
                "prediction is not the truth"
            )


def _lacks_ranking_values(stored: ScoreFile) -> bool:
    """Tell whether the ranking metric is undefined at all frames of all scenarios."""
    ranking = stored.scores.ranking
    if ranking not in METRICS:
        return False

    statistics = METRICS[ranking].of
    for tally in stored.scores.tallies.values():
        if not set(statistics).issubset(tally.names):
            return False
        rows = [tally.names.index(name) for name in statistics]
        is_defined = ~np.isnan(tally.values[rows]).any(axis=0)  # [frame]
        if is_defined.any():
            return False
    return True


def _values_out_of_range(
    names: Sequence[str], values: Floats
) -> Iterator[tuple[str, float]]:
    """Yield metrics with a value below the perfect 0 or above the perfect 1.

    Args:
        names: the metrics.
        values: NaN where undefined, shape [metric, frame].
    """
    is_defined = ~np.isnan(values)
    lowest = np.min(values, axis=1, where=is_defined, initial=np.inf)
    highest = np.max(values, axis=1, where=is_defined, initial=-np.inf)
    # metrics without any value stay within both bounds
    margin = ROUNDING * np.maximum(np.abs(lowest), np.abs(highest))
    is_below = lowest < -margin
    is_above = highest > 1.0 + margin
    for i in np.flatnonzero(is_below | is_above).tolist():
        metric = METRICS[names[i]]
        is_error = metric.direction is Direction.LOWER and metric.perfect == 0.0
        is_correlation = metric.direction is Direction.HIGHER and metric.perfect == 1.0
        if is_error and is_below[i]:
            yield names[i], float(lowest[i])
        elif is_correlation and is_above[i]:
            yield names[i], float(highest[i])


def _false_zeros(names: Sequence[str], values: Floats) -> list[str]:
    """Return errors that are 0 at all frames where another error is not.

    Args:
        names: the metrics.
        values: NaN where undefined, shape [metric, frame].
    """
    errors = [i for i, name in enumerate(names) if name.endswith(("_mse", "_mae"))]
    error_values = values[errors]
    is_defined = ~np.isnan(error_values)
    is_error = (error_values != 0.0) & is_defined
    if not is_error.any():  # the prediction is the truth
        return []
    is_zero = is_defined.any(axis=1) & ~is_error.any(axis=1)
    return [names[errors[i]] for i in np.flatnonzero(is_zero).tolist()]


LOOKALIKES = str.maketrans(
    "авекмнорстухіјѕԁһӏԛԝгпαβεηικμνορτυχζγωıɑɡ01",  # noqa: RUF001 (that is the point)
    "abekmhopctyxijsdhlqwrnabenlkuvoptuxzywiagol",
)
"""Letters of other scripts, and digits, beside the Latin letters that they look like.
"""

CAPITALS = str.maketrans("ΗΜΝΥ", "HMNY")  # noqa: RUF001
"""Greek capitals that look like other Latin letters than their small letters do."""


def confusable_key(name: str) -> str:
    """Return a key that names share which look alike to readers.

    >>> confusable_key("GN\u0405 1") == confusable_key("gns-l")
    True
    """
    capitals = unicodedata.normalize("NFKD", name).translate(CAPITALS)
    folded = capitals.casefold()
    decomposed = unicodedata.normalize("NFKD", folded)
    letters = "".join(letter for letter in decomposed if letter.isalnum())
    return letters.translate(LOOKALIKES).replace("i", "l")
