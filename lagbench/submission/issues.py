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
    compose_message,
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

LARGEST_PRINTED_INTEGER = 4 * MAX_TEXT
"""Length beyond which an integer is described, not printed [bits]."""


def quote(value: object) -> str:
    """Return a stranger's value as one short printable line.

    >>> quote("dot" * 50)
    "'dotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotd..."
    """
    if isinstance(value, int) and value.bit_length() > LARGEST_PRINTED_INTEGER:
        return f"an integer of {value.bit_length()} bits"

    if isinstance(value, (str, bytes)):
        value = value[: MAX_TEXT + 1]
    try:
        text = ascii(value)
    except ValueError:  # an integer inside, of more digits than Python prints
        return f"a {type(value).__name__}"
    if not isinstance(value, (str, bytes)):
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
    what: str  # what is wrong, one clause
    where: str  # variable, attribute, scenario or frame concerned
    expected: str
    got: str
    fix: str

    def __str__(self) -> str:
        """Return the issue as lines for people."""
        return compose_message(
            f"{self.severity} [{self.check}] {self.what}",
            where=self.where,
            expected=self.expected,
            got=self.got,
            fix=self.fix,
        )


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
        counts = [
            format_count(len(self.errors), "error"),
            format_count(len(self.warnings), "warning"),
        ]
        return f"<ValidationResult of {self.path}: {self.verdict}, {', '.join(counts)}>"

    def __str__(self) -> str:
        """Return all issues, the checks that were not made, and the verdict."""
        lines = [str(issue) for issue in self.findings]

        skipped_checks: dict[str, list[str]] = {}
        for check, reason in self.skipped.items():
            skipped_checks.setdefault(reason, []).append(check)
        for reason, checks in skipped_checks.items():
            names = ", ".join(checks)
            if len(checks) == len(CHECKS) - 1:
                names = "all other checks"
            lines.append(f"not made, since {reason}: {names}")

        error_count = format_count(len(self.errors), "error")
        warning_count = format_count(len(self.warnings), "warning")
        check_count = format_count(len(self.passed), "check")
        counts = f"{error_count}, {warning_count}, {check_count} passed"
        path = escape_line(str(self.path))
        lines.append(f"{path}: {self.verdict}, {counts}")
        return "\n".join(lines)

    @property
    def errors(self) -> tuple[ValidationIssue, ...]:
        """Issues that reject the file."""
        return self._of_severity(Severity.ERROR)

    @property
    def warnings(self) -> tuple[ValidationIssue, ...]:
        """Issues that flag the file."""
        return self._of_severity(Severity.WARNING)

    def _of_severity(self, severity: Severity) -> tuple[ValidationIssue, ...]:
        return tuple(issue for issue in self.findings if issue.severity is severity)

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
        failed_checks = {issue.check for issue in self.errors}
        if failed_checks == {"dataset"}:
            return "not judged"
        return "not valid"

    @property
    def exit_code(self) -> int:
        """0 valid, 3 unreadable, 4 wrong or missing data set, else 1."""
        if self.valid:
            return 0
        return self._error_class().exit_code

    def check(self) -> None:
        """Raise unless the file is valid.

        The message describes the first error of the check that decides the class:
        ``readable`` before ``dataset``, and both before all other checks.

        Raises:
            UnreadableFileError: the file cannot be read.
            DataError: it was made from another data set, or the data set needed is
                missing.
            ChecksFailedError: another check failed.
        """
        if self.valid:
            return
        issue = self._deciding_error()
        path = escape_line(str(self.path))
        what = f"{path} is {self.verdict}: [{issue.check}] {issue.what}"
        if len(self.errors) > 1:
            what += f" (and {len(self.errors) - 1} more)"
        raise self._error_class()(
            what,
            where=issue.where,
            expected=issue.expected,
            got=issue.got,
            fix=issue.fix,
        )

    def _error_class(self) -> type[LagbenchError]:
        return ERROR_CLASSES.get(self._deciding_error().check, ChecksFailedError)

    def _deciding_error(self) -> ValidationIssue:
        """Return the error that decides the class and the message of :meth:`check`."""
        for check in ERROR_CLASSES:
            for issue in self.errors:
                if issue.check == check:
                    return issue
        return self.errors[0]


class IssueCollector:
    """Collect issues, and note which checks were made and which were skipped."""

    def __init__(self) -> None:
        self._issues: list[ValidationIssue] = []
        self._completed: set[str] = set()
        self._skipped: dict[str, str] = {}

    @property
    def skipped(self) -> Mapping[str, str]:
        """Checks that could not be made, and why."""
        return self._skipped

    def complete(self, *checks: str) -> None:
        """Note that checks were made."""
        self._completed.update(checks)

    def skip(self, reason: str, *checks: str) -> None:
        """Note that checks could not be made, unless they were."""
        for check in checks:
            if check not in self._completed:
                self._skipped[check] = reason

    def error(
        self,
        check: str,
        what: str,
        *,
        where: str,
        expected: object,
        got: object,
        fix: str,
        severity: Severity = Severity.ERROR,
    ) -> None:
        """Add an issue that rejects the file, or with another severity flags it."""
        self._completed.add(check)
        issue = ValidationIssue(
            check=check,
            severity=severity,
            what=what,
            where=where,
            expected=str(expected),
            got=str(got),
            fix=fix,
        )
        self._issues.append(issue)

    def warning(
        self,
        check: str,
        what: str,
        *,
        where: str,
        expected: object,
        got: object,
        fix: str,
    ) -> None:
        """Add an issue that flags the file."""
        self.error(
            check,
            what,
            where=where,
            expected=expected,
            got=got,
            fix=fix,
            severity=Severity.WARNING,
        )

    def add_exception(self, check: str, error: LagbenchError) -> None:
        """Add the issue that one of our exceptions describes; it rejects the file."""
        expected = error.expected
        if expected is None:
            expected = "an undamaged file"
        got = error.got
        if got is None:
            got = "nothing"
        self.error(
            check,
            error.what,
            where=error.where or "the file",
            expected=expected,
            got=got,
            fix=error.fix or "make it again",
        )

    def first_failed(self, *checks: str) -> str | None:
        """Return the first of some checks that has an error; None where none has."""
        failed_checks = set()
        for issue in self._issues:
            if issue.severity is Severity.ERROR:
                failed_checks.add(issue.check)
        for check in checks:
            if check in failed_checks:
                return check
        return None

    def result(
        self, path: Path, *, sha256: str | None = None, **names: str
    ) -> ValidationResult:
        """Return all that was collected of a file.

        ``names`` holds the split, the size and the method that the file names.
        """
        checks_with_issues = {issue.check for issue in self._issues}
        passed = []
        skipped = {}
        for check in CHECKS:
            if check in checks_with_issues:
                continue
            if check in self._skipped:
                skipped[check] = self._skipped[check]
            elif check in self._completed:
                passed.append(check)
        return ValidationResult(
            path=path,
            split=names.get("split"),
            size=names.get("size"),
            method=names.get("method"),
            findings=sort_issues(self._issues),
            passed=tuple(passed),
            skipped=skipped,
            sha256=sha256,
        )


def sort_issues(issues: list[ValidationIssue]) -> tuple[ValidationIssue, ...]:
    """Return issues in the order of :data:`CHECKS`."""
    return tuple(sorted(issues, key=lambda issue: CHECKS.index(issue.check)))
