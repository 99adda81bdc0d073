"""Errors that say what is wrong and what to do, in one or two lines.

Every error that a user can cause is a :class:`LagbenchError`:

>>> raise UsageError("a setting has no =; write --set KEY=VALUE", where="--set")
Traceback (most recent call last):
    ...
lagbench.errors.UsageError: --set: a setting has no =; write --set KEY=VALUE

Its ``exit_code`` is what the command line returns: 1 for failed checks, 2 for wrong
usage, 3 for an unreadable file of the user, 4 for a data set that is missing, damaged
or of another hash, and 5 for work that failed.

The module also refuses files that are not regular or too long, and imports optional
dependencies.
"""

from __future__ import annotations

import difflib
import errno
import importlib
import importlib.util
import os
import re
import stat
import traceback
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import ClassVar

PLUGIN_GROUPS = ("lagbench.baselines", "lagbench.generators", "lagbench.metrics")
"""Entry points by which other packages add models, splits and metrics."""

DISK_FULL_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT})
"""What the operating system says of a disk or a quota that is full."""

LIMIT_FIXES = {
    errno.EFBIG: "raise the limit of the length of a file: `ulimit -f unlimited`",
    errno.EMFILE: "allow more open files, as by `ulimit -n 4096`",
    errno.ENFILE: "close other programs: the whole system opens no more files",
    errno.EAGAIN: "raise the limit of processes, as by `ulimit -u 4096`, or take fewer "
    "--workers",
}
"""What a user can do who has reached a limit of the operating system."""

SPLIT_NAMED = "SPLIT or --split"
"""Where a user names a split, for messages."""

MOST_NAMES = 30
"""Names that a hint lists."""

MOST_FILES = 10_000
"""Files of a folder whose names are compared with a wrong one."""

_CREDENTIALS = re.compile(r"(?<=://)[^/\s]*@")


class LagbenchError(Exception):
    """Base of every error that lagbench raises on purpose.

    Attributes:
        text: what is wrong and what to do, as in "no such split; see lagbench list".
        where: the file, key, variable or option concerned; the message begins with it.
        got: the value that is wrong, where a program reads it; the message is without.
    """

    exit_code: ClassVar[int] = 1

    def __init__(
        self, text: str, *, where: str | None = None, got: object = None
    ) -> None:
        super().__init__(text)
        self.text = text
        self.where = where
        self.got = got

    def __str__(self) -> str:
        """Return the message."""
        return self.text if self.where is None else f"{self.where}: {self.text}"

    def add_note(self, note: str, /) -> None:
        """Add a place to ``where``; our messages do not show Python's own notes."""
        self.where = note if self.where is None else f"{self.where}, {note}"


def hide_credentials(text: str, mark: str = "...@") -> str:
    """Return a text with a mark for the users and passwords of the addresses in it.

    >>> hide_credentials("ftp://ann:secret@host/data does not answer")
    'ftp://...@host/data does not answer'
    """
    return _CREDENTIALS.sub(lambda _: mark, text)


def escape_unprintable(text: str) -> str:
    r"""Return a text with its unprintable characters escaped.

    In a text from a stranger, such characters would command the terminal.

    >>> print(escape_unprintable("a\x1b[2J\nb"))
    a\x1b[2J
    b
    """
    characters = []
    for character in text:
        if character.isprintable() or character == "\n":
            characters.append(character)
        else:
            escaped = character.encode("unicode_escape")
            characters.append(escaped.decode("ascii"))
    return "".join(characters)


def escape_line(text: str) -> str:
    r"""Return a text on one line, with its unprintable characters escaped.

    >>> print(escape_line("a\nb"))
    a\nb
    """
    return escape_unprintable(text).replace("\n", "\\n")


class ChecksFailedError(LagbenchError):
    """A check did not hold."""

    exit_code = 1


class UsageError(LagbenchError):
    """A name, option or value of the caller does not exist or does not fit."""

    exit_code = 2


class NotInstalledError(UsageError, ModuleNotFoundError):
    """An optional package is not installed.

    It is a ModuleNotFoundError as well, as Python raises for such an import. So
    ``except ImportError`` around an import catches it.
    """


class UnreadableFileError(LagbenchError):
    """A file of the user cannot be read."""

    exit_code = 3


class DataError(LagbenchError):
    """A data set is missing, damaged, or of another hash."""

    exit_code = 4


class WorkFailedError(LagbenchError):
    """The work itself failed: blow-up, disk full, worker lost."""

    exit_code = 5


def explain_system_error(error: OSError) -> LagbenchError | None:
    """Return the message for an error of the operating system, None without a reason.

    HDF5 and pipes raise one without, for a lock or a full pipe.
    """
    if error.strerror is None:
        return None
    where = None if error.filename is None else os.fsdecode(error.filename)
    fix = LIMIT_FIXES.get(error.errno or 0, "see that the place is there and yours")
    if error.errno in DISK_FULL_ERRORS:
        fix = "free disk space"
    if error.errno == errno.ENAMETOOLONG:
        return UsageError(f"{error.strerror}; use a name of at most 255 bytes")
    return WorkFailedError(f"{error.strerror}; {fix}", where=where)


def check_regular(
    path: Path, *, longest: int | None = None, fix: str | None = None
) -> int:
    """Refuse a path that is no regular file, or a long one; return its length [bytes].

    Devices never end and a FIFO waits for ever, so this check comes before anything is
    opened.

    Raises:
        UnreadableFileError: the path is missing, no regular file, or too long.
    """
    where = str(path)
    try:
        status = path.stat()
    except FileNotFoundError as error:
        hint = suggest_file(path) or "relative paths start in the working folder"
        message = f"there is no such file; {hint}"
        raise UnreadableFileError(message, where=where) from error
    except (OSError, ValueError) as error:
        message = f"cannot open the file ({error}); check the path"
        raise UnreadableFileError(message, where=where) from error
    if stat.S_ISDIR(status.st_mode):
        raise UnreadableFileError("a folder; name a file", where=where)
    if not stat.S_ISREG(status.st_mode):
        raise UnreadableFileError("a device or pipe; name a file", where=where)
    if longest is not None and status.st_size > longest:
        message = (
            f"the file has {status.st_size} bytes, more than {longest}; "
            f"{fix or 'name a file that lagbench wrote'}"
        )
        raise UnreadableFileError(message, where=where)
    return status.st_size


def suggest_file(path: Path) -> str | None:
    """Return a hint that names the file of the same folder with the nearest name.

    None where no name is near, or where the folder holds too many files or is closed.
    """
    names: list[str] = []
    with suppress(OSError, ValueError):
        names = os.listdir(path.parent)
    if len(names) > MOST_FILES:
        return None
    near = difflib.get_close_matches(path.name, sorted(names), n=1, cutoff=0.75)
    if not near:
        return None
    return f"did you mean {path.with_name(near[0])}?"


def format_count(number: int, noun: str) -> str:
    """Return a number with its noun.

    >>> format_count(1, "error"), format_count(2, "entry")
    ('1 error', '2 entries')
    """
    if number == 1:
        return f"1 {noun}"
    if noun.endswith("y"):
        return f"{number} {noun[:-1]}ies"
    return f"{number} {noun}s"


def suggest_name(name: str, known_names: Iterable[str], *, prefix: str = "") -> str:
    """Return a hint that names the known word nearest to a wrong one.

    ``prefix`` stands before each word as a user writes it; it makes no words alike.

    >>> suggest_name("cavty", ["fluid", "cavity"])
    "did you mean 'cavity'? known: cavity, fluid"
    >>> suggest_name("latant", ["latent"], prefix="model.")
    "did you mean 'model.latent'? known: model.latent"
    """
    names = sorted(known_names)
    words = [f"{prefix}{known}" for known in names[:MOST_NAMES]]
    if len(names) > MOST_NAMES:
        words.append("...")
    listing = f"known: {', '.join(words) or 'none'}"
    near = difflib.get_close_matches(name, names, n=1)
    if not near:
        return listing
    return f"did you mean {prefix + near[0]!r}? {listing}"


def find_place_in_extension(error: BaseException, *modules: str) -> str | None:
    """Return the innermost line of a traceback that lies in an extension of lagbench.

    It has the form ``file, line n``. None if no line of the traceback lies in one.

    Args:
        error: an exception that was caught.
        modules: modules that belong to extensions, beside those of entry points.
    """
    # importlib.metadata takes half as long to import as the rest of lagbench.
    from importlib.metadata import entry_points

    names = {*modules}
    for group in PLUGIN_GROUPS:
        names.update(point.module for point in entry_points(group=group))
    packages = {name.split(".")[0] for name in names} - {"lagbench"}

    place = None
    for frame, line in traceback.walk_tb(error.__traceback__):
        module_name = str(frame.f_globals.get("__name__"))
        if module_name.split(".")[0] in packages:
            place = f"{frame.f_code.co_filename}, line {line}"
    return place


def describe_exception(error: BaseException, *modules: str) -> str:
    """Return the class, the text and the place of an exception of an extension."""
    description = f"{type(error).__name__}: {error}"
    place = find_place_in_extension(error, *modules)
    if place is None:
        return description
    return f"{description} ({place})"


def require(module: str, *, extra: str) -> ModuleType:
    """Import an optional module.

    Raises:
        NotInstalledError: it is not installed; the message holds the command that
            installs it.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        missing_package = (error.name or "").split(".")[0]
        if missing_package != module.split(".")[0]:
            raise
        raise _not_installed(module, extra) from None


def check_installed(module: str, *, extra: str) -> None:
    """Refuse before work starts, without importing: workers will import the module.

    Raises:
        NotInstalledError: it is not installed; the message holds the command that
            installs it.
    """
    if importlib.util.find_spec(module) is None:
        raise _not_installed(module, extra)


def _not_installed(module: str, extra: str) -> NotInstalledError:
    package = module.split(".")[0]
    return NotInstalledError(
        f"{package} is not installed; pip install 'lagbench[{extra}]'"
    )
