"""The checks by name, what they find, and the exit code that follows."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from lagbench.errors import (
    ChecksFailedError,
    DataError,
    LagbenchError,
    UnreadableFileError,
    escape_line,
    format_count,
)

CHECKS = (
    "readable",
    "format",
    "split",
    "dataset",
    "dims",
    "scenarios",
    "frames",
    "particles",
    "dtype",
    "finite",
    "diverged_at",
    "start",
    "discontinuous_start",
    "shifted",
    "in_domain",
    "max_displacement",
)
"""All checks, in the order in which they are reported."""

ERROR_CLASSES: Mapping[str, type[LagbenchError]] = {
    "readable": UnreadableFileError,
    "dataset": DataError,
}
"""Classes of the errors of some checks, those first that decide before others.

All other checks have ChecksFailedError.
"""

MAX_TEXT = 80
"""Longest piece of a stranger's file that a message repeats [characters]."""


def quote(value: object) -> str:
    """Return a stranger's value as one short printable line.

    >>> quote("dot" * 50)
    "'dotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotd..."
    """
    if isinstance(value, (str, bytes)):
        value = value[: MAX_TEXT + 1]
    try:
        text = ascii(value)
    except ValueError:  # an integer of more digits than Python prints
        return f"a {type(value).__name__}"
    text = " ".join(text.split())  # arrays have several lines
    if len(text) <= MAX_TEXT:
        return text
    return f"{text[: MAX_TEXT - 3]}..."


class Severity(enum.StrEnum):
    """Whether an issue rejects a file or only flags it."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True, kw_only=True)
class ValidationIssue:
    """One thing that is wrong with a file."""

    check: str  # one of CHECKS
    severity: Severity  # errors reject the file, warnings flag it
    what: str  # what is wrong; what to do
    where: str  # variable, attribute, scenario or frame concerned
    share: float | None = None  # of the positions that are concerned, where it counts

    def __str__(self) -> str:
        """Return the issue as a line for people."""
        return escape_line(f"{self.severity} [{self.check}] {self.where}: {self.what}")


@dataclass(frozen=True, kw_only=True)
class ValidationResult:
    """What the checks say about one file."""

    path: Path
    split: str | None  # split that it names; None where it could not be read
    size: str | None  # size that it names
    method: str | None  # method that it names
    findings: tuple[ValidationIssue, ...]  # all that is wrong, in the order of CHECKS
    passed: tuple[str, ...]  # checks that found nothing
    skipped: Mapping[str, str]  # check to the reason why it could not be made
    # content hash of the positions; None where they were not all read
    sha256: str | None = None

    def __repr__(self) -> str:
        """Return the verdict on the file, and how much is wrong with it."""
        return f"<ValidationResult of {self.path}: {self._summary}>"

    def __str__(self) -> str:
        """Return all issues, the checks that were not made, and the verdict."""
        lines = [str(issue) for issue in self.findings]
        skipped_checks: dict[str, list[str]] = {}
        for check, reason in self.skipped.items():
            skipped_checks.setdefault(reason, []).append(check)
        for reason, checks in skipped_checks.items():
            lines.append(f"not made, since {reason}: {', '.join(checks)}")
        passed = format_count(len(self.passed), "check")
        lines.append(f"{escape_line(str(self.path))}: {self._summary}, {passed} passed")
        return "\n".join(lines)

    @property
    def _summary(self) -> str:
        errors = format_count(len(self.errors), "error")
        warnings = format_count(len(self.warnings), "warning")
        return f"{self.verdict}, {errors}, {warnings}"

    @property
    def errors(self) -> tuple[ValidationIssue, ...]:
        """Issues that reject the file."""
        return tuple(one for one in self.findings if one.severity is Severity.ERROR)

    @property
    def warnings(self) -> tuple[ValidationIssue, ...]:
        """Issues that flag the file."""
        return tuple(one for one in self.findings if one.severity is Severity.WARNING)

    @property
    def valid(self) -> bool:
        """Whether nothing rejects the file."""
        return not self.errors

    @property
    def verdict(self) -> str:
        """The word for people.

        ``not judged`` where the data set is missing, damaged, or not the one that the
        predictions were made from.
        """
        if self.valid:
            return "valid"
        if all(issue.check == "dataset" for issue in self.errors):
            return "not judged"
        return "not valid"

    @property
    def exit_code(self) -> int:
        """0 valid, 3 unreadable, 4 wrong or missing data set, else 1."""
        try:
            self.check()
        except LagbenchError as error:
            return error.exit_code
        return 0

    @property
    def deciding(self) -> ValidationIssue | None:
        """The error that the message of :meth:`check` describes; None of a valid file.

        The first error of ``readable``, else of ``dataset``, else of all.
        """
        for check in ERROR_CLASSES:
            for issue in self.errors:
                if issue.check == check:
                    return issue
        return next(iter(self.errors), None)

    def check(self) -> None:
        """Raise unless the file is valid.

        The message describes the deciding error.

        Raises:
            UnreadableFileError: the file cannot be read.
            DataError: it was made from another data set, or the data set needed is
                missing.
            ChecksFailedError: another check failed.
        """
        deciding = self.deciding
        if deciding is None:
            return
        place = ""
        if deciding.where != str(self.path):
            place = f" {escape_line(deciding.where)}:"
        more = ""
        if len(self.errors) > 1:
            more = f" (and {len(self.errors) - 1} more)"
        raise ERROR_CLASSES.get(deciding.check, ChecksFailedError)(
            f"{self.verdict}: [{deciding.check}]{place} {deciding.what}{more}",
            where=escape_line(str(self.path)),
        )


class IssueCollector:
    """Collect issues, and note which checks were skipped."""

    def __init__(self) -> None:
        self.issues: list[ValidationIssue] = []
        self.skipped: dict[str, str] = {}

    def skip(self, reason: str, *checks: str) -> None:
        """Note that checks could not be made; the first reason counts."""
        for check in checks:
            self.skipped.setdefault(check, reason)

    def error(self, check: str, what: str, *, where: str) -> None:
        """Add an issue that rejects the file."""
        self.issues.append(
            ValidationIssue(
                check=check, severity=Severity.ERROR, what=what, where=where
            )
        )

    def warning(
        self, check: str, what: str, *, where: str, share: float | None = None
    ) -> None:
        """Add an issue that flags the file."""
        self.issues.append(
            ValidationIssue(
                check=check,
                severity=Severity.WARNING,
                what=what,
                where=where,
                share=share,
            )
        )

    def add_exception(self, check: str, error: LagbenchError) -> None:
        """Add the issue that one of our exceptions describes; it rejects the file."""
        self.error(check, error.text, where=error.where or "the file")

    def first_failed(self, *checks: str) -> str | None:
        """Return the first of some checks that has an error; None where none has."""
        failed = {one.check for one in self.issues if one.severity is Severity.ERROR}
        return next((check for check in checks if check in failed), None)

    def result(
        self, path: Path, *, sha256: str | None = None, **names: str
    ) -> ValidationResult:
        """Return all that was collected of a file.

        ``names`` holds the split, the size and the method that the file names.
        """
        found = {issue.check for issue in self.issues}
        passed = []
        skipped = {}
        for check in CHECKS:
            if check in self.skipped and check not in found:
                skipped[check] = self.skipped[check]
            elif check not in found:
                passed.append(check)
        return ValidationResult(
            path=path,
            split=names.get("split"),
            size=names.get("size"),
            method=names.get("method"),
            findings=tuple(
                sorted(self.issues, key=lambda issue: CHECKS.index(issue.check))
            ),
            passed=tuple(passed),
            skipped=skipped,
            sha256=sha256,
        )
