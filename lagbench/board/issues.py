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
        "a file, link or folder that is not part of a leaderboard",
        "not part of a leaderboard",
        "entries, score files, and what README.md names",
        "remove it; predictions and code are kept elsewhere",
    ),
    "readable": BoardCheck(
        "an entry that is not a plain YAML file of at most 64 kB",
        "the entry cannot be read",
        "plain YAML",
        "write it with `lagbench submit`",
    ),
    "schema": BoardCheck(
        "a missing key, an unknown key, or a value that does not fit",
        "the entry does not fit",
        "what leaderboard/schema.json says",
        "docs/submitting.md describes the keys",
    ),
    "split": BoardCheck(
        "an entry for an unknown split or size",
        "no such split and size",
        "a split and size that `lagbench list` shows",
        "name another",
    ),
    "place": BoardCheck(
        "an entry whose split, size or method differs from its path",
        "the entry lies in another place than it says",
        "the path that follows from it",
        "let split, size and method be those of the path",
    ),
    "version": BoardCheck(
        "an active entry whose data set has a newer version",
        "the data set is no longer the current one",
        "the version of today",
        "predict from the new data and submit again, or set status: withdrawn",
    ),
    "date": BoardCheck(
        "an entry whose date lies in the future",
        "the date of the entry lies in the future",
        "at most today",
        "date: the day of the submission",
    ),
    "name": BoardCheck(
        "two active entries with similar names, or an entry with the name of a "
        "reference predictor",
        "two names look alike",
        "a name of its own",
        "choose another name, or say what differs, as in 'GNS, six terms'",
    ),
    "lifecycle": BoardCheck(
        "a superseded entry whose successor is missing or leads back to the entry",
        "the entry is superseded by an entry that is not there",
        "another entry there, active in the end",
        "name an entry that is there and replaces it, or set status: withdrawn",
    ),
    "predictions": BoardCheck(
        "a file of predictions that is missing, or is not the one that the entry "
        "describes",
        "the predictions do not lie where the entry says",
        "a file of that length",
        "correct path and bytes, or remove path",
    ),
    "missing": BoardCheck(
        "an entry whose score file is missing",
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
        "a score file that was edited, cannot be read, or belongs to another entry",
        "a score file is not the one that the scorer wrote",
        "the file of the entry, unchanged",
    ),
    "values": BoardCheck(
        "a score file with impossible values, such as a negative error",
        "impossible scores",
        "scores that a prediction can have",
    ),
    "score": BoardCheck(
        "a score in the entry that disagrees with its score files",
        "the score block is not what the score files give",
        "what the score files give",
    ),
    "budget": BoardCheck(
        "a budget or track that disagrees with the predictions or contradicts itself",
        "the budget is not what those of the predictions give",
        "no track, since the predictions have no budgets",
    ),
    "training": BoardCheck(
        "a training on `test`, on `shift` or on another data set; a trained model "
        "of the kind `classical`",
        "the entry states a training that cannot be",
        "a training on other subsets; kind: learned or hybrid where something is "
        "learned",
        "correct kind, or predict with a model that was not trained on scored "
        "scenarios",
    ),
    "weights": BoardCheck(
        "weights that are missing, edited, too large or unused; two active entries "
        "with the same weights and options",
        "the weights are not those of the entry",
        "the file that `lagbench submit --weights` wrote",
        "submit with the weights again: lagbench submit --weights; or remove what no "
        "entry names",
    ),
    "duplicate": BoardCheck(
        "the same predictions submitted twice, under two names or two seeds",
        "the same predictions stand here twice",
        "predictions of its own",
        "submit predictions once; if the method has a new name, supersede the "
        "old entry",
    ),
    "stray": BoardCheck(
        "a score file that belongs to no entry",
        "a score file that no entry has",
        "an entry that names these predictions",
        "add its entry, or remove it",
    ),
    "reference": BoardCheck(
        "a score file of a reference predictor that is unknown or cannot be read",
        "no reference predictor of the scorer",
        "scores of a reference predictor that `lagbench submit` wrote",
        REFERENCES_ANEW,
    ),
    "verified": BoardCheck(
        "a line of verified.yaml that does not fit its entry or its records",
        "verified.yaml has a line about no entry",
        "an entry with these score files",
        "remove the line: it holds for nothing any more",
    ),
    "shift": BoardCheck(
        "a line of shift.yaml that does not fit its entry",
        "shift.yaml has scores that belong to no entry",
        "scores of the entry's own models on the present data",
        "remove the line, and score anew: lagbench leaderboard shift ENTRY",
    ),
    "gates": BoardCheck(
        "a gates.json that cannot be read",
        "the gates cannot be read",
        "the JSON that `python -m studies.gates` writes",
        "restore the file, or write it anew: python -m studies.gates",
    ),
    "base": BoardCheck(
        "a change to an existing entry, or to a file of the maintainers",
        "the change alters what was there before",
        "the same as before",
        "leave it as it was; if it is yours, say so: --own METHOD",
    ),
    "rescored": BoardCheck(
        "predictions whose scores, computed again, differ from the entry",
        "scored again, the predictions have other scores",
        "what the scorer gives",
    ),
    "measured": BoardCheck(
        "a shipped score of a reference predictor that differs from a new measurement",
        "the shipped scores of a reference predictor are not those of the data",
        "the scores that the package ships",
        "lagbench verify; if the data are the recorded ones, python -m "
        "lagbench.scoring.measure_references",
    ),
    "page": BoardCheck(
        "an index.html or schema.json that is out of date",
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
