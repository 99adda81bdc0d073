"""Errors that say what, where, expected, got and how to fix it.

Every error that a user can cause is a :class:`LagbenchError`. Its ``exit_code`` is what
the command line returns: 1 for failed checks, 2 for wrong usage, 3 for an unreadable
file of the user, 4 for a data set that is missing, damaged or of another hash, and 5
for work that failed.

The module also refuses files that are not regular or too long, and imports optional
dependencies and the modules that other packages add.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import importlib
import importlib.util
import itertools
import os
import re
import stat
import sys
import threading
import traceback
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

PLUGIN_GROUPS = ("lagbench.baselines", "lagbench.generators", "lagbench.metrics")
"""Entry points by which other packages add models, splits and metrics."""

DISK_FULL_ERRORS = frozenset({errno.ENOSPC, errno.EDQUOT})
"""What the operating system says of a disk or a quota that is full."""

LIMIT_FIXES = {
    errno.EFBIG: "raise the limit of the length of a file: `ulimit -f unlimited`",
    errno.EMFILE: "allow more open files, as by `ulimit -n 4096`",
    errno.ENFILE: "close other programs: the whole system opens no more files",
    errno.EAGAIN: "raise the limit of processes, as by `ulimit -u 4096`; where the "
    "command has the option --workers, take fewer of them",
}
"""What a user can do who has reached a limit of the operating system."""

VANISHED_ERRORS = frozenset(
    {
        errno.ENOENT,
        errno.ENOTDIR,
        errno.EIO,
        errno.ENODEV,
        errno.ENXIO,
        errno.ESTALE,
        errno.EROFS,
        errno.ENOTCONN,
    }
)
"""What a disk or a folder raises that is no longer there, or only read."""

_WORD = re.compile(r"\S+")
_DIGITS = re.compile(r"[0-9]+")
# The scheme before it is only looked back at: a search through a long text is linear.
_HOST_OF_ADDRESS = re.compile(r"(?<=[A-Za-z0-9+.-]):/+([^/]*)")
_IPV6_HOST = re.compile(r"\[[0-9A-Fa-f:.]+(?:%\w+)?\](?::[0-9]*)?")
_PORT = re.compile(r"[0-9]{1,5}")
_LAST_PORT = 65535
_SCHEME_WITH_PORT = re.compile(r"(?:^|[^a-z0-9+.-])(?:https?|s?ftp)$", re.IGNORECASE)
_LONGEST_SCHEME = len("https")

SPLIT_NAMED = "SPLIT or --split"
"""Where a user names a split, for messages."""

MOST_NAMES = 30
"""Names that a hint lists; of more it lists those that are near a wrong one."""

FIRST_NAMES = 5
"""Names that a hint lists where there are more, and none is near."""

MOST_FILES = 10_000
"""Files of a folder whose names are compared with a wrong one."""

PATIENCE = 20.0
"""Time that the import of a package's module may take before a line names it [s]."""


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
        # users and passwords of addresses are hidden in all texts
        # what is wrong, one clause without a full stop
        self.what = hide_credentials(what)
        # file, key, variable or flag concerned
        self.where = None if where is None else hide_credentials(where)
        # what would have been right
        self.expected = (
            hide_credentials(expected) if isinstance(expected, str) else expected
        )
        # the value that is wrong
        self.got = hide_credentials(got) if isinstance(got, str) else got
        # what the user can do about it
        self.fix = None if fix is None else hide_credentials(fix)
        super().__init__(self._compose())

    def _compose(self) -> str:
        message = compose_message(
            self.what,
            where=self.where,
            expected=self.expected,
            got=self.got,
            fix=self.fix,
        )
        return hide_credentials(message)

    def add_note(self, note: str, /) -> None:
        """Add a place to ``where``; our messages do not show Python's own notes."""
        note = hide_credentials(note)
        if self.where is None:
            self.where = note
        else:
            self.where = f"{self.where}, {note}"
        self.args = (self._compose(),)

    def __reduce__(self) -> tuple[object, ...]:
        """Rebuild with keyword arguments, so that errors cross process borders."""
        state = (
            type(self),
            self.what,
            self.where,
            self.expected,
            self.got,
            self.fix,
        )
        return _rebuild, state


def hide_credentials(text: str, mark: str = "...@") -> str:
    """Return a text with a mark for the users and passwords of the addresses in it.

    Messages are printed, logged and sent to others. A password may hold any characters
    but blanks, so after a user with a colon all is hidden up to the last ``@``. But in
    addresses of http, https, ftp and sftp, a number from 1 to 65535 between the colon
    and the first slash is a port, as every reader of addresses takes it: an ``@``
    behind it belongs to the path. Those of stores, such as s3, have no port.

    >>> hide_credentials("ftp://ann:se/cret@host/data does not answer")
    'ftp://...@host/data does not answer'
    >>> hide_credentials("http://nas:8000/data@v2 does not answer")
    'http://nas:8000/data@v2 does not answer'
    >>> hide_credentials("s3://KEY:1/secret@bucket does not answer")
    's3://...@bucket does not answer'
    """
    if "@" not in text:
        return text
    return _WORD.sub(lambda word: _hide_credentials_in_word(word[0], mark), text)


def _hide_credentials_in_word(word: str, mark: str) -> str:
    """Return a text without blanks with a mark for the users of its addresses.

    Each character is looked at a few times only, however long the text is.
    """
    last = word.rfind("@")
    parts = []
    end = 0
    for match in _HOST_OF_ADDRESS.finditer(word, 0, last + 1):
        host = match[1]
        begin = match.start(1)
        parts.append(word[end:begin])
        end = begin
        scheme_begin = max(0, match.start() - _LONGEST_SCHEME - 1)
        scheme = word[scheme_begin : match.start()]
        may_have_port = _SCHEME_WITH_PORT.search(scheme) is not None
        if ":" in host and not (may_have_port and _is_host_with_port(host)):
            parts.append(mark)
            end = last + 1
            break
        if "@" in host:
            parts.append(mark)
            end = begin + host.rfind("@") + 1
    parts.append(word[end:])
    return "".join(parts)


def _is_host_with_port(host: str) -> bool:
    """Return whether what stands before the first slash is a host and a port.

    A user may stand before them.
    """
    host = host.rpartition("@")[2]
    if _IPV6_HOST.fullmatch(host):
        return True
    name, _, port = host.partition(":")
    if not name or not _PORT.fullmatch(port):
        return False
    return 1 <= int(port) <= _LAST_PORT


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


def compose_message(
    what: str, *, where: str | None, expected: object, got: object, fix: str | None
) -> str:
    """Return the parts of a message in lines; those that are None are left out.

    A line break in a name or value of a stranger begins no line that looks like a part.
    """
    lines = [what]
    if where is not None:
        lines.append(f"where: {escape_line(where)}")
    for label, value in (("expected", expected), ("got", got)):
        if value is not None:
            indented = str(value).replace("\n", "\n    ")
            lines.append(f"{label}: {indented}")
    if fix is not None:
        lines.append(f"fix: {fix}")
    return escape_unprintable("\n  ".join(lines))


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
    """A check did not hold."""

    exit_code = 1


class UsageError(LagbenchError):
    """A name, option or value of the caller does not exist or does not fit."""

    exit_code = 2


class WrongCallError(UsageError, TypeError):
    """A call has an argument too many, one too few, or one of an unknown name.

    It is a TypeError as well, as Python raises for such a call.
    """


class UnknownKeyError(UsageError, KeyError):
    """A mapping has no entry of that name.

    It is a KeyError as well, as Python raises for such a name.
    """

    def __str__(self) -> str:
        """Return the message; a KeyError would return its repr, in one line."""
        return str(self.args[0])


class NotInstalledError(UsageError, ModuleNotFoundError):
    """An optional package is not installed.

    It is a ModuleNotFoundError as well, as Python raises for such an import. So
    ``except ImportError`` around an import catches it.
    """


class UsageErrorCollector:
    """Collect the usage errors of several ``with`` blocks, to raise them together."""

    def __init__(self) -> None:
        self._errors: list[UsageError] = []

    def __enter__(self) -> None:
        """Begin a block that may raise a usage error."""

    def __exit__(
        self, kind: object, error: BaseException | None, trace: object
    ) -> bool:
        """Keep a usage error and go on after the block; anything else is raised."""
        if not isinstance(error, UsageError):
            return False
        self._errors.append(error)
        return True

    def raise_errors(self) -> None:
        """Raise the collected errors, if there are any.

        Raises:
            UsageError: the one error, or all of them numbered.
        """
        if not self._errors:
            return
        if len(self._errors) == 1:
            raise self._errors[0]
        lines = [f"{len(self._errors)} mistakes"]
        for number, error in enumerate(self._errors, start=1):
            indented = str(error).replace("\n", "\n   ")
            lines.append(f"\n  {number}. {indented}")
        raise UsageError("".join(lines))


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
    """Return the message for an error of the operating system that a user can mend.

    These are a missing permission, a disk or folder that has vanished, a name that is
    too long, a full disk, and a limit of files or processes. None for all others.
    """
    if isinstance(error, PermissionError) and error.filename is not None:
        return WorkFailedError(
            "no permission",
            where=os.fsdecode(error.filename),
            expected="a file or folder that you may read or write",
            got=error.strerror,
            fix="see who owns it, or name another",
        )
    if error.errno in VANISHED_ERRORS:
        return WorkFailedError(
            "cannot read or write there",
            where=os.fsdecode(error.filename or "the working folder"),
            expected="a disk and a folder that stay there while lagbench works",
            got=error.strerror,
            fix="see that they are there and can be written to, then repeat the "
            "command",
        )
    if error.errno == errno.ENAMETOOLONG:
        name = str(error.filename)
        return UsageError(
            "no file can have that name",
            where="an argument or an option",
            expected="a name of at most 255 bytes",
            got=f"{name[:60]!r}..., {len(os.fsencode(name))} bytes",
            fix="use a shorter name",
        )
    if error.errno in DISK_FULL_ERRORS:
        return WorkFailedError(
            "cannot write there",
            where=error.filename or "standard output, or another output file",
            expected="space on the disk",
            got=error.strerror,
            fix="free disk space",
        )
    # HDF5 and pipes use EAGAIN, with other texts, for a lock and for a full pipe.
    code = error.errno or 0
    is_of_processes = error.strerror == os.strerror(errno.EAGAIN)
    if code in LIMIT_FIXES and (code != errno.EAGAIN or is_of_processes):
        return WorkFailedError(
            "a limit of the operating system is reached",
            where=os.fsdecode(error.filename or "this process"),
            expected="room for the files and processes of lagbench",
            got=error.strerror,
            fix=LIMIT_FIXES[code],
        )
    return None


def check_regular(
    path: Path, *, longest: int | None = None, fix: str | None = None
) -> int:
    """Refuse a path that is no regular file, or a long one; return its length [bytes].

    Devices never end and a FIFO waits for ever, so this check comes before anything is
    opened.

    Raises:
        UnreadableFileError: the path is missing, no regular file, or too long.
    """
    try:
        status = path.stat()
    except FileNotFoundError as error:
        raise UnreadableFileError(
            "there is no such file",
            where=str(path),
            expected="a readable file",
            got="nothing",
            fix=suggest_file(path)
            or "check the path: relative ones start in the working folder",
        ) from error
    except (OSError, ValueError) as error:
        raise UnreadableFileError(
            "cannot open the file",
            where=str(path),
            expected="a readable file",
            got=getattr(error, "strerror", None) or error,
            fix="check the path and that you may read the file",
        ) from error
    if not stat.S_ISREG(status.st_mode):
        kind = "a device, socket or pipe"
        if stat.S_ISDIR(status.st_mode):
            kind = "a folder"
            fix = _name_files_in(path)
        raise UnreadableFileError(
            "not a file",
            where=str(path),
            expected="a file",
            got=kind,
            fix=fix or "name a file",
        )
    if longest is not None and status.st_size > longest:
        raise UnreadableFileError(
            "the file is too long",
            where=str(path),
            expected=f"at most {longest} bytes",
            got=f"{status.st_size} bytes",
            fix=fix or "name a file that lagbench wrote",
        )
    return status.st_size


def _name_files_in(folder: Path) -> str:
    """Return a hint that names the first files of a folder, without hidden ones."""
    names = []
    with contextlib.suppress(OSError):
        for file in sorted(folder.iterdir()):
            if file.is_file() and not file.name.startswith("."):
                names.append(ascii(file.name)[1:-1])
    if not names:
        return "name a file"
    return f"name a file in it: {', '.join(names[:3])[:120]}"


def suggest_file(path: Path) -> str | None:
    """Return a hint that names the file of the same folder with the nearest name.

    A name with other digits is another scenario or run, so it is not suggested. None
    where no name is near, or where the folder holds too many files or is closed.
    """
    names: list[str] = []
    with suppress(OSError, ValueError), os.scandir(path.parent) as entries:
        for entry in itertools.islice(entries, MOST_FILES + 1):
            names.append(entry.name)
    if not names or len(names) > MOST_FILES:
        return None

    name_without_digits = _DIGITS.sub("", path.name)
    close_names = difflib.get_close_matches(
        path.name, sorted(names), n=len(names), cutoff=0.75
    )
    for name in close_names:
        differs_in_letters = _DIGITS.sub("", name) != name_without_digits
        if differs_in_letters and os.path.isfile(path.with_name(name)):
            return f"did you mean {path.with_name(name)}?"
    return None


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
    >>> suggest_name("density", ["denstiy", "density_coupling"])[:23]
    "did you mean 'denstiy'?"
    >>> suggest_name("rate", ["learning_rate", "patience"])
    "did you mean 'learning_rate'? known: learning_rate, patience"
    """
    names = sorted(known_names)
    close_names = difflib.get_close_matches(name, names, n=5, cutoff=0.5)
    # a whole word of a known name is nearer than a few letters in common, but not than
    # a slip of the pen
    has_slip = bool(difflib.get_close_matches(name, names, cutoff=0.8))
    containing = [known for known in names if name in known.split("_")]
    if len(containing) == 1 and not has_slip:
        others = [close for close in close_names if close not in containing]
        close_names = [*containing, *others]
    words = [f"{prefix}{known}" for known in names]
    close_words = [f"{prefix}{close}" for close in close_names]
    listing = f"known: {', '.join(words) or 'none'}"
    if len(words) > MOST_NAMES:
        if close_words:
            listing = f"known, among others: {', '.join(close_words)}"
        else:
            first_words = ", ".join(words[:FIRST_NAMES])
            listing = f"known: {first_words} and {len(words) - FIRST_NAMES} more"
    if close_words:
        return f"did you mean {close_words[0]!r}? {listing}"
    return listing


def find_place_in_extension(error: BaseException, *modules: str) -> str | None:
    """Return the innermost line of a traceback that lies in an extension of lagbench.

    It has the form ``file, line n``. None if no line of the traceback lies in one.

    Args:
        error: an exception that was caught.
        modules: modules that belong to extensions, beside those of entry points.
    """
    # importlib.metadata takes half as long to import as the rest of lagbench.
    from importlib.metadata import entry_points

    package_names = {module.split(".")[0] for module in modules}
    for group in PLUGIN_GROUPS:
        for point in entry_points(group=group):
            module_name = point.value.partition(":")[0]
            package_names.add(module_name.split(".")[0].strip())
    package_names.discard("lagbench")

    place = None
    for frame, line in traceback.walk_tb(error.__traceback__):
        module_name = str(frame.f_globals.get("__name__"))
        if module_name.split(".")[0] in package_names:
            place = f"{frame.f_code.co_filename}, line {line}"
    return place


def text_of(error: BaseException) -> str:
    """Return the text of an exception, which a class of a stranger may fail to form."""
    try:
        return str(error)
    except Exception:
        return "(its text cannot be formed)"


def describe_exception(error: BaseException, *modules: str) -> str:
    """Return the class and the text of an exception, and its line in an extension.

    ``modules`` as for :func:`find_place_in_extension`.
    """
    description = f"{type(error).__name__}: {text_of(error)}"
    place = find_place_in_extension(error, *modules)
    if place is None:
        return description
    return f"{description} ({place})"


def load_entry_point(
    point: EntryPoint,
    *,
    patience: float = PATIENCE,
) -> Any:  # noqa: ANN401 (any object)
    """Import the object that an entry point of another package names.

    A line on stderr names the module where that takes longer than ``patience`` [s].

    Raises:
        ImportError: its module would end the program. Others raise what they like.
    """
    note = f"lagbench: still importing {point.value}, which an entry point names\n"
    timer = threading.Timer(patience, _write_note, (note,))
    timer.daemon = True
    timer.start()
    try:
        return point.load()
    except SystemExit as error:
        refusal = ImportError(f"its module would end the program: {error!r}")
        # with the line that would do so
        raise refusal.with_traceback(error.__traceback__) from error
    finally:
        timer.cancel()


def _write_note(note: str) -> None:
    """Write a line on stderr, where there is one."""
    if sys.stderr is not None:
        with suppress(OSError):
            sys.stderr.write(note)


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
        f"{package} is not installed",
        where=f"this needs the extra {extra!r}",
        expected=f"the package {package}",
        got="no such package",
        fix=f"pip install 'lagbench[{extra}]'",
    )
