"""The checks of a leaderboard by name, what they find, and what is suspect in an entry
by itself.
"""

from __future__ import annotations

import hashlib
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lagbench.errors import LagbenchError, UnreadableFileError
from lagbench.metrics.aggregate import Tally
from lagbench.metrics.metric import Direction
from lagbench.metrics.table import METRICS, STATISTICS
from lagbench.scoring.score_file_checks import (
    MAX_SCORE_BYTES,
    ScoreFile,
    read_score_file,
)
from lagbench.submission.findings import Finding, Severity

from .entry import Entry
from .folder import Folder

# share of the greatest value by which rounding may take one below zero, or above one
ROUNDING = 1e-6

RESCORE = (
    "submit the predictions again: lagbench submit; the score block is not for editing"
)
REFERENCES_ANEW = "remove the file: `lagbench submit` writes the floors anew"


class Check(NamedTuple):
    """A check: what it finds in general, and how a finding puts it."""

    meaning: str
    what: str
    expected: str
    fix: str = RESCORE


CHECKS: Mapping[str, Check] = {
    "folder": Check(
        "a file, link or folder that nothing here knows",
        "something that has no place here",
        "entries, score files, and what README.md names",
        "remove it; predictions and code are kept elsewhere",
    ),
    "readable": Check(
        "an entry that is no plain YAML of at most 64 kB",
        "the entry cannot be read",
        "plain YAML",
        "write it with `lagbench submit`",
    ),
    "schema": Check(
        "unknown or missing keys, values that do not fit, addresses that are no "
        "named host's",
        "the entry does not fit",
        "what leaderboard/schema.json says",
        "docs/submitting.md describes the keys",
    ),
    "split": Check(
        "a split or size that datasets.yaml does not have",
        "no such split and size",
        "a split and size that `lagbench list` shows",
        "name another",
    ),
    "place": Check(
        "an entry whose split, size or method is not that of its path",
        "the entry lies in another place than it says",
        "the path that follows from it",
        "let split, size and method be those of the path",
    ),
    "version": Check(
        "an active entry that was scored on another data set than that of today",
        "the data set is no longer the current one",
        "the version of today",
        "predict from the new data and submit again, or set status: withdrawn",
    ),
    "date": Check(
        "an entry of a day that has not come yet",
        "the entry is of a day to come",
        "at most today",
        "date: the day of the submission",
    ),
    "name": Check(
        "two active entries, or an entry and a floor, whose names look alike",
        "two names look alike",
        "a name of its own",
        "choose another name, or say what differs, as in 'GNS, six terms'",
    ),
    "lifecycle": Check(
        "an entry that is superseded by one that is not there, or in the end by itself",
        "the entry is superseded by none",
        "another entry there, active in the end",
        "name an entry that is there and replaces it, or set status: withdrawn",
    ),
    "predictions": Check(
        "predictions said to lie in the folder that do not, or of another length",
        "the predictions do not lie where the entry says",
        "a file of that length",
        "correct path and bytes, or remove path",
    ),
    "missing": Check(
        "a score file that is not there",
        "a score file is not there",
        "the file that `lagbench submit` wrote beside the entry",
        "add it to the pull request, or submit again",
    ),
    "oversize": Check(
        "a score file of more than 1 MB",
        "a score file is too long",
        f"at most {MAX_SCORE_BYTES} bytes",
    ),
    "score_file": Check(
        "a score file that was edited, cannot be read, or belongs to something else",
        "a score file is not the one that the scorer wrote",
        "the file of the entry, unchanged",
    ),
    "values": Check(
        "a score file with values that no prediction can have",
        "no prediction has such scores",
        "scores of a prediction",
    ),
    "score": Check(
        "a score block that the score files do not give",
        "the score block is not what the score files give",
        "what the score files give",
    ),
    "budget": Check(
        "a budget, or its track, that those of the predictions do not give",
        "the budget is not what those of the predictions give",
        "no track, since the predictions have no budgets",
    ),
    "weights": Check(
        "weights that are missing, edited, out of place, without an entry or of two; "
        "more than 40 MB of"
        " them; a long or broken record of a training",
        "the weights are not those of the entry",
        "the file that `lagbench submit --weights` wrote",
        "submit with the weights again: lagbench submit --weights; or remove what no "
        "entry names",
    ),
    "twin": Check(
        "the same predictions under two names or seeds",
        "the same predictions stand here twice",
        "predictions of its own",
        "submit predictions once; if the method has a new name, supersede the "
        "old entry",
    ),
    "stray": Check(
        "a score file that no entry has",
        "a score file that no entry has",
        "an entry that names these predictions",
        "add its entry, or remove it",
    ),
    "floor": Check(
        "scores of a floor that are unknown, cannot be read, or belong to "
        "something else",
        "no floor of the scorer",
        "scores of a floor that `lagbench submit` wrote",
        REFERENCES_ANEW,
    ),
    "verified": Check(
        "a line of verified.yaml that no entry with these score files has",
        "the list names what is not there",
        "an entry with these score files",
        "remove the line: it holds for nothing any more",
    ),
    "base": Check(
        "an entry that was there before and that the change touches, removes or "
        "alters in status",
        "the change alters what was there before",
        "the same as before",
        "leave it as it was; if it is yours, say so: --own METHOD",
    ),
    "rescored": Check(
        "predictions that, scored again, give something else",
        "scored again, the predictions are not what the leaderboard says",
        "what the scorer gives",
    ),
    "measured": Check(
        "a shipped score of a floor that is not what the data give, measured again",
        "the shipped scores of a floor are not those of the data",
        "the scores that the package ships",
        "lagbench verify; if the data are the recorded ones, python -m "
        "lagbench.scoring.measure_references",
    ),
    "page": Check(
        "a page or schema.json that is not what the submissions give",
        "the page is not what the submissions give",
        "what they give",
        "lagbench leaderboard build",
    ),
}
"""Checks by name."""


def finding(
    check: str,
    where: object,
    got: object,
    *,
    what: str | None = None,
    expected: object = None,
    fix: str | None = None,
) -> Finding:
    """Return something that rejects a pull request; what is not said is the check's own
    wording.
    """
    own = CHECKS[check]
    return Finding(
        check=check,
        severity=Severity.ERROR,
        what=what or own.what,
        where=str(where),
        expected=str(own.expected if expected is None else expected),
        got=str(got),
        fix=fix or own.fix,
    )


def finding_of(check: str, error: LagbenchError, where: object) -> Finding:
    """Return an error as a finding."""
    return finding(
        check, where, error.got, what=error.what, expected=error.expected, fix=error.fix
    )


def print_of(tallies: Mapping[int, Tally]) -> str:
    """Return what only the same predictions share: their errors in every scenario and
    frame.

    Those that lagbench measures: what a package measures beside them tells nothing
    apart. What is changed by hand, scoring again tells.
    """
    digest = hashlib.sha256()
    for scenario, tally in sorted(tallies.items()):
        names = [name for name in STATISTICS if name in tally.names]
        digest.update(f"{scenario} {names} {tally.frames}".encode())
        total = tally.total[[tally.names.index(name) for name in names]]
        digest.update(np.ascontiguousarray(total.astype(np.float32)).tobytes())
    return digest.hexdigest()


def prints_of(folder: Folder, others: Mapping[Path, Entry]) -> dict[str, str]:
    """Return what only the same predictions share, whatever they are called, and
    where.
    """
    found = {}
    for path in (path for entry in others.values() for path in entry.score_paths):
        with suppress(UnreadableFileError):  # `leaderboard check` tells of those
            found[print_of(read_score_file(folder.path / path).scores.tallies)] = str(
                path
            )
    return found


def impossible(held: ScoreFile) -> Iterator[str]:
    """Yield values that no prediction can have, whoever wrote them.

    Errors and distances are never negative, correlations never above one; and where one
    error of a scenario is zero at all frames, so are the others: the prediction is the
    truth.
    """
    for scenario, tally in sorted(held.scores.tallies.items()):
        errors = {}
        for name in tally.names:
            metric = METRICS.get(name)
            series = tally.series(name)
            known = series[~np.isnan(series)]
            if metric is None or not known.size:
                continue
            room = ROUNDING * np.abs(known).max()
            low = (
                metric.direction is Direction.LOWER
                and metric.perfect == 0.0
                and known.min() < -room
            )
            high = (
                metric.direction is Direction.HIGHER
                and metric.perfect == 1.0
                and known.max() > 1.0 + room
            )
            if low or high:
                yield f"{name} {known.min() if low else known.max():.6g} in scenario {scenario}"
            if name.endswith(("_mse", "_mae")):
                errors[name] = bool(np.any(known != 0.0))
        for name in [
            name for name, some in errors.items() if not some and any(errors.values())
        ]:
            yield f"{name} 0 at all frames of scenario {scenario}, though the prediction is not the truth"


LOOKALIKES = str.maketrans(
    "авекмнорстухіјѕԁһӏԛԝгпαβεηικνορτυχζγω01",  # noqa: RUF001 (that is the point)
    "abekmhopctyxijsdhlqwrnabehlkvoptuxzywol",
)
"""Letters of other scripts, and digits, beside the Latin letters that they look like.
"""


def skeleton(name: str) -> str:
    """Return what is left of a name when all is taken away that readers do not see.

    >>> skeleton("GN\u0405 1") == skeleton("gns-l")
    True
    """
    folded = unicodedata.normalize(
        "NFKD", unicodedata.normalize("NFKD", name).casefold()
    )
    plain = "".join(letter for letter in folded if letter.isalnum()).translate(
        LOOKALIKES
    )
    return plain.replace("i", "l")
