"""What a validation found: named checks, their findings, and the exit code they
mean.
"""

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
    "in_domain",
    "max_displacement",
)
"""All checks, in the order in which they are reported."""

MAX_TEXT = 80
"""Longest piece of a stranger's file that a message repeats [characters]."""


def quoted(value: object) -> str:
    """Return a stranger's value as one short printable line.

    >>> quoted("dot" * 50)
    "'dotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotdotd..."
    """
    if isinstance(value, int) and value.bit_length() > 4 * MAX_TEXT:
        return f"an integer of {value.bit_length()} bits"
    try:
        text = ascii(
            value[: MAX_TEXT + 1] if isinstance(value, (str, bytes)) else value
        )
    except ValueError:  # an integer inside, of more digits than Python prints
        return f"a {type(value).__name__}"
    if len(text) <= MAX_TEXT:
        return text
    return f"{text[: MAX_TEXT - 3]}..."


class Severity(enum.StrEnum):
    """Whether a finding rejects a file or only flags it."""

    ERROR = "error"
    WARNING = "warning"


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that is wrong with a file."""

    check: str  # one of CHECKS
    severity: Severity  # errors reject the file, warnings flag it
    what: str  # what is wrong, one clause
    where: str  # variable, attribute, scenario or frame concerned
    expected: str
    got: str
    fix: str

    def __str__(self) -> str:
        """Return the finding as lines for people."""
        labelled = {
            "where": self.where,
            "expected": self.expected,
            "got": self.got,
            "fix": self.fix,
        }
        head = f"{self.severity} [{self.check}] {self.what}"
        return "\n  ".join(
            [head, *(f"{label}: {text}" for label, text in labelled.items())]
        )


@dataclass(frozen=True, kw_only=True)
class ValidationResult:
    """What the checks say about one file."""

    path: Path
    split: str | None  # split that it names; None where it could not be read
    size: str | None  # size that it names
    method: str | None  # method that it names
    findings: tuple[Finding, ...]  # all that is wrong, in the order of CHECKS
    passed: tuple[str, ...]  # checks that found nothing
    skipped: Mapping[str, str]  # check to the reason why it could not be made
    # content hash of the positions; None where they were not all read
    sha256: str | None = None

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that reject the file."""
        return tuple(f for f in self.findings if f.severity is Severity.ERROR)

    @property
    def warnings(self) -> tuple[Finding, ...]:
        """Findings that flag it."""
        return tuple(f for f in self.findings if f.severity is Severity.WARNING)

    @property
    def valid(self) -> bool:
        """Whether nothing rejects the file."""
        return not self.errors

    @property
    def verdict(self) -> str:
        """The word for people: ``not judged`` where the data set is missing, damaged or
        not the file's.
        """
        if self.valid:
            return "valid"
        if {f.check for f in self.errors} == {"dataset"}:
            return "not judged"
        return "not valid"

    @property
    def exit_code(self) -> int:
        """0 valid, 3 unreadable, 4 made from another data set or no data set here, else
        1.
        """
        if self.errors:
            return self._failure().exit_code
        return 0

    def check(self) -> None:
        """Raise unless the file is valid.

        Raises:
            UnreadableFileError: the file cannot be read.
            DataError: it was made from another data set, or the data set needed is
                missing.
            ChecksFailedError: another check failed.
        """
        if not self.errors:
            return
        first = self.errors[0]
        if len(self.errors) > 1:
            others = f" (and {len(self.errors) - 1} more)"
        else:
            others = ""
        what = f"{self.path} is {self.verdict}: [{first.check}] {first.what}{others}"
        where = first.where
        expected = first.expected
        got = first.got
        fix = first.fix
        raise self._failure()(what, where=where, expected=expected, got=got, fix=fix)

    def _failure(self) -> type[LagbenchError]:
        failed = {f.check for f in self.errors}
        if "readable" in failed:
            return UnreadableFileError
        if "dataset" in failed:
            return DataError
        return ChecksFailedError


class Findings:
    """Findings as they are collected."""

    def __init__(self) -> None:
        self._found: list[Finding] = []
        self._made: set[str] = set()
        self._skipped: dict[str, str] = {}

    @property
    def skipped(self) -> Mapping[str, str]:
        """Checks that could not be made, and why."""
        return self._skipped

    def made(self, *checks: str) -> None:
        """Note that checks were made."""
        self._made.update(checks)

    def skip(self, reason: str, *checks: str) -> None:
        """Note that checks could not be made, unless they were."""
        self._skipped.update(
            {check: reason for check in checks if check not in self._made}
        )

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
        """Add a finding that rejects the file, or with another severity flags it."""
        self._made.add(check)
        said = {
            "what": what,
            "where": where,
            "expected": str(expected),
            "got": str(got),
            "fix": fix,
        }
        self._found.append(Finding(check=check, severity=severity, **said))

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
        """Add a finding that flags the file."""
        self.error(
            check,
            what,
            where=where,
            expected=expected,
            got=got,
            fix=fix,
            severity=Severity.WARNING,
        )

    def failed(self, *checks: str) -> str | None:
        """Return the first of some checks that has an error."""
        wrong = {f.check for f in self._found if f.severity is Severity.ERROR}
        return next((check for check in checks if check in wrong), None)

    def result(
        self, path: Path, *, sha256: str | None = None, **names: str
    ) -> ValidationResult:
        """Return all that was collected of a file that names split, size and method."""
        touched = {f.check for f in self._found}
        rest = [check for check in CHECKS if check not in touched]
        return ValidationResult(
            path=path,
            split=names.get("split"),
            size=names.get("size"),
            method=names.get("method"),
            findings=tuple(sorted(self._found, key=lambda f: CHECKS.index(f.check))),
            passed=tuple(
                check
                for check in rest
                if check in self._made and check not in self._skipped
            ),
            skipped={
                check: self._skipped[check] for check in rest if check in self._skipped
            },
            sha256=sha256,
        )

    def raised(self, check: str, error: LagbenchError) -> None:
        """Add the finding that rejects the file for what one of our errors says."""
        where = error.where or "the file"
        expected = error.expected or "an undamaged file"
        fix = error.fix or "make it again"
        self.error(
            check,
            error.what,
            where=where,
            expected=expected,
            got=error.got or "nothing",
            fix=fix,
        )
