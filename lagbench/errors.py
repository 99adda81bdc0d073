"""Errors that say what, where, expected, got and how to fix it.

Every error a user can cause is a :class:`LagbenchError`; its ``exit_code`` is what the
command line returns. Codes: 1 checks failed, 2 usage, 3 a file the user gave is
unreadable, 4 data set missing, damaged or of another hash, 5 the work itself failed.

Files that a user names: refused unless they are regular and of bounded length. Optional
dependencies: import one, or say which extra installs it. Packages that add something:
import them.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import stat
import traceback
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


class LagbenchError(Exception):
    """Base of every error that lagbench raises on purpose."""

    exit_code: ClassVar[int] = 1

    def __init__(
        self,
        what: str,
        *,
        where: str | None = None,
        expected: object = None,
        got: object = None,
        fix: str | None = None,
    ) -> None:
        self.what = what  # what is wrong, one clause without a full stop
        self.where = where  # file, key, variable or flag concerned
        self.expected = expected  # what would have been right
        self.got = got  # what was found
        self.fix = fix  # what the user can do about it
        super().__init__(self._compose())

    def _compose(self) -> str:
        parts = [self.what]
        labelled = {
            "where": self.where,
            "expected": self.expected,
            "got": self.got,
            "fix": self.fix,
        }
        parts += [
            f"{label}: {text}" for label, text in labelled.items() if text is not None
        ]
        return printable("\n  ".join(parts))

    def add_note(self, note: str, /) -> None:
        """Say more of where it is, in place of Python's notes, which no message of ours
        shows.
        """
        if self.where is None:
            self.where = note
        else:
            self.where = f"{self.where}, {note}"
        self.args = (self._compose(),)

    def __reduce__(self) -> tuple[object, ...]:
        """Rebuild with keyword arguments, so that errors cross process borders."""
        return _rebuild, (
            type(self),
            self.what,
            self.where,
            self.expected,
            self.got,
            self.fix,
        )


def printable(text: str) -> str:
    r"""Spell out what is no printable character: in a stranger's words it would command
    the terminal.

    >>> print(printable("a\x1b[2J\nb"))
    a\x1b[2J
    b
    """
    return "".join(
        letter
        if letter.isprintable() or letter == "\n"
        else letter.encode("unicode_escape").decode("ascii")
        for letter in text
    )


def _rebuild(
    kind: type[LagbenchError],
    what: str,
    where: str | None,
    expected: object,
    got: object,
    fix: str | None,
) -> LagbenchError:
    return kind(what, where=where, expected=expected, got=got, fix=fix)


class ChecksFailedError(LagbenchError):
    """Something was checked and did not hold."""

    exit_code = 1


class UsageError(LagbenchError):
    """A name, option or value that the caller gave does not exist or does not fit."""

    exit_code = 2


class Mistakes:
    """Usage errors gathered from several ``with`` blocks, to be told together."""

    def __init__(self) -> None:
        self._found: list[UsageError] = []

    def __enter__(self) -> None:
        """Begin what may be a mistake."""

    def __exit__(
        self, kind: object, error: BaseException | None, trace: object
    ) -> bool:
        """Keep a usage error and go on after the block; anything else is raised."""
        if not isinstance(error, UsageError):
            return False
        self._found.append(error)
        return True

    def tell(self) -> None:
        """Raise what was found, if anything.

        Raises:
            UsageError: the one mistake, or all of them numbered.
        """
        if len(self._found) == 1:
            raise self._found[0]
        if self._found:
            told = (str(error).replace("\n", "\n   ") for error in self._found)
            lines = (f"\n  {number}. {text}" for number, text in enumerate(told, 1))
            raise UsageError(f"{len(self._found)} mistakes" + "".join(lines))


class UnreadableFileError(LagbenchError):
    """A file that the user gave cannot be read."""

    exit_code = 3


class DataError(LagbenchError):
    """A data set is missing, damaged, or of another hash."""

    exit_code = 4


class WorkFailedError(LagbenchError):
    """The work itself failed: blow-up, disk full, worker lost."""

    exit_code = 5


def check_regular(
    path: Path, *, longest: int | None = None, fix: str | None = None
) -> int:
    """Refuse what is no regular file, or a long one; return its length [bytes].

    Devices never end and a FIFO waits for ever, so this comes before anything is
    opened.
    """
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        raise UnreadableFileError(
            "cannot open the file",
            where=str(path),
            expected="a readable file",
            got=getattr(error, "strerror", None) or error,
            fix="check the path and that you may read the file",
        ) from error
    if not stat.S_ISREG(status.st_mode):
        if stat.S_ISDIR(status.st_mode):
            kind = "a folder"
        else:
            kind = "a device, socket or pipe"
        raise UnreadableFileError(
            "not a file", where=str(path), expected="a file", got=kind, fix=fix
        )
    if longest is not None and status.st_size > longest:
        raise UnreadableFileError(
            "the file is too long",
            where=str(path),
            expected=f"at most {longest} bytes",
            got=f"{status.st_size} bytes",
            fix=fix,
        )
    return status.st_size


def nearest(name: str, known: Iterable[str]) -> str:
    """Return a remedy that names the known word nearest to a wrong one.

    >>> nearest("cavty", ["fluid", "cavity"])
    "did you mean 'cavity'? known: cavity, fluid"
    """
    words = sorted(known)
    close = difflib.get_close_matches(name, words, n=1, cutoff=0.5)
    listing = f"known: {', '.join(words) or 'none'}"
    if close:
        return f"did you mean {close[0]!r}? {listing}"
    return listing


def package_at_fault(error: BaseException) -> str | None:
    """Return the innermost place of a trace in what another package adds; None where
    there is none.
    """
    from importlib.metadata import (
        entry_points,
    )  # half of what importing lagbench would take

    groups = (f"lagbench.{group}" for group in ("baselines", "generators", "metrics"))
    points = [point for group in groups for point in entry_points(group=group)]
    added = {
        point.value.partition(":")[0].split(".")[0].strip() for point in points
    } - {"lagbench"}
    place = None
    for frame, line in traceback.walk_tb(error.__traceback__):
        if str(frame.f_globals.get("__name__")).split(".")[0] in added:
            place = f"{frame.f_code.co_filename}, line {line}"
    return place


def loaded(point: EntryPoint) -> Any:  # noqa: ANN401 (a stranger's)
    """Import what an entry point of another package names.

    Raises:
        ImportError: its module would end the program. Others raise what they like.
    """
    try:
        return point.load()
    except SystemExit as left:
        raise ImportError(f"its module would end the program: {left!r}") from left


def require(module: str, *, extra: str) -> ModuleType:
    """Import an optional module."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] != module.split(".")[0]:
            raise
        raise _missing(module, extra) from None


def check_installed(module: str, *, extra: str) -> None:
    """Refuse before work starts, without importing: workers will import the module.

    Raises:
        UsageError: it is not installed; the message holds the command that installs it.
    """
    if importlib.util.find_spec(module) is None:
        raise _missing(module, extra)


def _missing(module: str, extra: str) -> UsageError:
    return UsageError(
        f"{module.split('.')[0]} is not installed",
        where=f"this needs the extra {extra!r}",
        fix=f"pip install 'lagbench[{extra}]'",
    )
