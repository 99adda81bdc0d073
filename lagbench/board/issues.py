"""The checks of a leaderboard by name, and the issues that they report."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from lagbench.errors import LagbenchError
from lagbench.submission.issues import Severity, ValidationIssue

RESCORE = (
    "submit the predictions again: lagbench submit; the score block is not for editing"
)
REFERENCES_ANEW = "remove the file: `lagbench submit` writes it anew"


class BoardCheck(NamedTuple):
    """A check: its subject in general, and the words of an issue that it reports."""

    meaning: str
    what: str
    expected: str
    fix: str = RESCORE


CHECKS: Mapping[str, BoardCheck] = {
    "folder": BoardCheck(
        "a file, link or folder that nothing here knows",
        "something that has no place here",
        "entries, score files, and what README.md names",
        "remove it; predictions and code are kept elsewhere",
    ),
    "readable": BoardCheck(
        "an entry that is no plain YAML of at most 64 kB",
        "the entry cannot be read",
        "plain YAML",
        "write it with `lagbench submit`",
    ),
    "schema": BoardCheck(
        "unknown or missing keys, values that do not fit, addresses that are no "
        "named host's",
        "the entry does not fit",
        "what leaderboard/schema.json says",
        "docs/submitting.md describes the keys",
    ),
    "split": BoardCheck(
        "a split or size that datasets.yaml does not have",
        "no such split and size",
        "a split and size that `lagbench list` shows",
        "name another",
    ),
    "place": BoardCheck(
        "an entry whose split, size or method is not that of its path",
        "the entry lies in another place than it says",
        "the path that follows from it",
        "let split, size and method be those of the path",
    ),
    "version": BoardCheck(
        "an active entry that was scored on another data set than that of today",
        "the data set is no longer the current one",
        "the version of today",
        "predict from the new data and submit again, or set status: withdrawn",
    ),
    "date": BoardCheck(
        "an entry of a day that has not come yet",
        "the entry is of a day to come",
        "at most today",
        "date: the day of the submission",
    ),
    "name": BoardCheck(
        "two active entries, or an entry and a reference predictor, whose names "
        "look alike",
        "two names look alike",
        "a name of its own",
        "choose another name, or say what differs, as in 'GNS, six terms'",
    ),
    "lifecycle": BoardCheck(
        "an entry that is superseded by one that is not there, or in the end by itself",
        "the entry is superseded by none",
        "another entry there, active in the end",
        "name an entry that is there and replaces it, or set status: withdrawn",
    ),
    "predictions": BoardCheck(
        "predictions said to lie in the folder that do not, or of another length",
        "the predictions do not lie where the entry says",
        "a file of that length",
        "correct path and bytes, or remove path",
    ),
    "missing": BoardCheck(
        "a score file that is not there",
        "a score file is not there",
        "the file that `lagbench submit` wrote beside the entry",
        "add it to the pull request, or submit again",
    ),
    "oversize": BoardCheck(
        "a score file of more than 1 MB",
        "a score file is too long",
        "at most 1,000,000 bytes",
    ),
    "score_file": BoardCheck(
        "a score file that was edited, cannot be read, or belongs to something else",
        "a score file is not the one that the scorer wrote",
        "the file of the entry, unchanged",
    ),
    "values": BoardCheck(
        "a score file with values that no prediction can have",
        "no prediction has such scores",
        "scores of a prediction",
    ),
    "score": BoardCheck(
        "a score block that the score files do not give",
        "the score block is not what the score files give",
        "what the score files give",
    ),
    "budget": BoardCheck(
        "a budget, or its track, that those of the predictions do not give",
        "the budget is not what those of the predictions give",
        "no track, since the predictions have no budgets",
    ),
    "weights": BoardCheck(
        "weights that are missing, edited, out of place, without an entry or of two; "
        "more than 40 MB of"
        " them; a long or broken log of a training",
        "the weights are not those of the entry",
        "the file that `lagbench submit --weights` wrote",
        "submit with the weights again: lagbench submit --weights; or remove what no "
        "entry names",
    ),
    "twin": BoardCheck(
        "the same predictions under two names or seeds",
        "the same predictions stand here twice",
        "predictions of its own",
        "submit predictions once; if the method has a new name, supersede the "
        "old entry",
    ),
    "stray": BoardCheck(
        "a score file that no entry has",
        "a score file that no entry has",
        "an entry that names these predictions",
        "add its entry, or remove it",
    ),
    "floor": BoardCheck(
        "scores of a reference predictor that are unknown, cannot be read, or "
        "belong to something else",
        "no reference predictor of the scorer",
        "scores of a reference predictor that `lagbench submit` wrote",
        REFERENCES_ANEW,
    ),
    "verified": BoardCheck(
        "a line of verified.yaml that no entry with these score files has",
        "the list names what is not there",
        "an entry with these score files",
        "remove the line: it holds for nothing any more",
    ),
    "base": BoardCheck(
        "an entry that was there before and that the change touches, removes or "
        "alters in status",
        "the change alters what was there before",
        "the same as before",
        "leave it as it was; if it is yours, say so: --own METHOD",
    ),
    "rescored": BoardCheck(
        "predictions that, scored again, give something else",
        "scored again, the predictions are not what the leaderboard says",
        "what the scorer gives",
    ),
    "measured": BoardCheck(
        "a shipped score of a reference predictor that is not what the data give, "
        "measured again",
        "the shipped scores of a reference predictor are not those of the data",
        "the scores that the package ships",
        "lagbench verify; if the data are the recorded ones, python -m "
        "lagbench.scoring.measure_references",
    ),
    "page": BoardCheck(
        "a page or schema.json that is not what the submissions give",
        "the page is not what the submissions give",
        "what they give",
        "lagbench leaderboard build",
    ),
}
"""Checks by name."""


def make_issue(
    check: str,
    where: object,
    got: object,
    *,
    what: str | None = None,
    expected: object = None,
    fix: str | None = None,
) -> ValidationIssue:
    """Return an issue that rejects a pull request.

    Words that are not given are those of the check.
    """
    defaults = CHECKS[check]
    if expected is None:
        expected = defaults.expected
    return ValidationIssue(
        check=check,
        severity=Severity.ERROR,
        what=what or defaults.what,
        where=str(where),
        expected=str(expected),
        got=str(got),
        fix=fix or defaults.fix,
    )


def issue_from_error(
    check: str, error: LagbenchError, where: object
) -> ValidationIssue:
    """Return an error as an issue."""
    return make_issue(
        check, where, error.got, what=error.what, expected=error.expected, fix=error.fix
    )
