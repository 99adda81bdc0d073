"""The program `lagbench`: its commands, and how they end."""

from __future__ import annotations

import difflib
import functools
import importlib
import io
import os
import re
import sys
import warnings
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, ClassVar

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from lagbench.addresses import REPOSITORY, describe
from lagbench.errors import (
    LagbenchError,
    UnreadableFileError,
    UsageError,
    WorkFailedError,
    escape_unprintable,
    explain_system_error,
    find_place_in_extension,
    text_of,
)

from .commands import (
    COMMANDS,
    LEADERBOARD_COMMANDS,
    CommandEntry,
)
from .stderr import print_on_stderr
from .typed_settings import (
    NEGATIVE_NUMBER,
    advise_on_baselines,
    advise_on_lists,
    advise_on_settings,
    advise_on_splits,
    shorten_word,
)

PROGRAM = "lagbench"
"""The word that begins each command line."""

INTERRUPTED = 130
FAILED = 5
PIPE_CLOSED = 141
"""Exit code that shells report when the reader of a pipe left, 128 + SIGPIPE."""

RESUMABLE_COMMANDS = {
    "demo",
    "generate",
    "download",
    "train",
    "leaderboard reproduce",
    "leaderboard shift",
}
"""Commands that go on where they stopped."""

GROUPS = ("leaderboard",)
"""Words before the names of their commands."""

COMMANDS_WITHOUT_SIZE = {
    "lagbench score",
    "lagbench validate",
    "lagbench compare",
    "lagbench submit",
}
"""Commands that read the size of the data set from predictions or scores."""

MEMORY_WORDS = ("failed to map segment", "annot allocate memory")
"""What a library says that finds no memory while it is loaded."""

PROCESSOR_WORDS = "NumPy was built with baseline optimizations"
"""What NumPy says, as it is imported, on a processor that lacks instructions."""

_UNREADABLE_PATH = re.compile(r"""(['"])(.+)\1 is not readable""")
"""What click says of a file without permission."""

_EXTRA_WORDS = re.compile(r"unexpected extra arguments?(?:\(s\))? \((.*)\)$")
"""What click says of words that are neither arguments nor options."""

_DECIMAL_COMMA = re.compile(r"[0-9]+,[0-9]+")

_LONG_OPTION = re.compile(r"--[a-z][a-z-]*(=.*)?", re.DOTALL)
"""A word that begins as a long option does, its own value included."""

SIZE_NAMES = frozenset({"tiny", "mini", "full"})
"""Names of sizes that a user may write behind the split."""

PATH_PLACEHOLDERS = frozenset({"FILE", "FOLDER", "A", "B"})
"""What the help shows in place of a path; A and B are the two sides of compare."""

NEAR_NAME = 0.8
"""Likeness of two options, of 1, from which one is a misspelt other."""


class _CheckedCommand(TyperCommand):
    """A command that checks the words of its options and arguments as they are typed.

    Values lose what is checked here: an empty path becomes that of the working folder.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401 (two copies of click)
        typed_words = list(args)
        rest = super().parse_args(ctx, args)

        names: set[str] = set()
        for parameter in self.get_params(ctx):
            # an argument has no name that a user could type
            if parameter.param_type_name == "option":
                names.update(parameter.opts)
                names.update(parameter.secondary_opts)
        values, _, _ = self.make_parser(ctx).parse_args(args=typed_words)
        for parameter in self.get_params(ctx):
            value = values.get(parameter.name)
            words = value if isinstance(value, list | tuple) else [value]
            for word in words:
                if isinstance(word, str):
                    _check_typed_word(ctx, parameter, word, names)
            if parameter.metavar in PATH_PLACEHOLDERS:
                typed_value = ctx.params.get(parameter.name)
                ctx.params[parameter.name] = _expand_home(typed_value)
        return rest


def _expand_home(value: Any) -> Any:  # noqa: ANN401 (values of any option)
    """Return a path, or paths, with a first part ~ replaced by the home folder.

    A shell does this, except in ``--output=~/p.nc``. A value of another type stays, and
    so does a name that begins with ~.
    """
    if isinstance(value, list | tuple):
        return type(value)(_expand_home(item) for item in value)
    if isinstance(value, str | Path) and Path(value).parts[:1] == ("~",):
        return type(value)(os.path.expanduser(value))
    return value


def _check_typed_word(
    context: Any,  # noqa: ANN401 (two copies of click)
    parameter: Any,  # noqa: ANN401 (as above)
    word: str,
    names: Collection[str],
) -> None:
    """Refuse an empty path, and an option that was read as the value of another one.

    Args:
        context: context of the command.
        parameter: the option or argument.
        word: its value as typed.
        names: names of all options of the command.

    Raises:
        UsageError: as in ``--output ""`` or ``--output --overwrite``.
    """
    where = f"{PROGRAM} {_command_words(context)}"
    is_option = parameter.param_type_name == "option"
    name = max(parameter.opts, key=len) if is_option else parameter.metavar
    is_path = parameter.metavar in PATH_PLACEHOLDERS
    if is_path and not word:
        raise UsageError(
            f"{name} is empty",
            where=where,
            expected=f"a path as {name}",
            got="an empty text",
            fix="name a path; . is the working folder",
        )
    if not is_option or (word not in names and not _LONG_OPTION.fullmatch(word)):
        return
    advice = f"add a value behind {name}"
    if is_path:
        advice = f"{advice}; a file of that name is ./{shorten_word(word)}"
    raise UsageError(
        f"{name} has no value",
        where=where,
        expected=f"{name} {parameter.metavar or 'VALUE'}",
        got=f"{name} {shorten_word(word)}, which is written as an option is",
        fix=advice,
    )


class _LazyCommand(TyperCommand):
    """Stands for a command in its group and loads it when it is called."""

    def __init__(self, entry: CommandEntry) -> None:
        super().__init__(entry.name, help=entry.summary)
        self._entry = entry

    @functools.cached_property
    def loaded(self) -> Any:  # noqa: ANN401 (typer does not export its class of commands)
        """The command itself, with its options."""
        module_name, _, function_name = self._entry.target.partition(":")
        module = importlib.import_module(f"lagbench.cli.{module_name}")
        function = getattr(module, function_name)
        app = typer.Typer(add_completion=False)
        register = app.command(
            self._entry.name,
            cls=_CheckedCommand,
            epilog=f"Example: lagbench {self._entry.example}",
        )
        register(function)
        return get_command(app)

    def make_context(self, *args: Any, **options: Any) -> Any:  # noqa: ANN401
        """Return a context of the command itself, which runs instead of this one."""
        return self.loaded.make_context(*args, **options)


class _LazyGroup(TyperGroup):
    """A group of lazy commands; other commands of the group come after them."""

    entries: ClassVar[tuple[CommandEntry, ...]] = ()

    def __init__(self, **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        commands: dict[str, Any] = {}
        for entry in self.entries:
            commands[entry.name] = _LazyCommand(entry)
        commands.update(self.commands)
        self.commands = commands


class _Program(_LazyGroup):
    """All commands; what they raise becomes a message on stderr and an exit code."""

    entries = COMMANDS

    def make_context(self, *args: Any, **extra: Any) -> Any:  # noqa: ANN401
        for stream in (sys.stdout, sys.stderr):
            # A character that a stream cannot encode shall not end the work.
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
        # --help and --version print here.
        try:
            with _errors_as_messages(), _output_errors(), _command_line_errors():
                return super().make_context(*args, **extra)
        except KeyboardInterrupt:
            print_on_stderr(_interruption_message(None))
            raise typer.Exit(INTERRUPTED) from None

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 (typer and click disagree on its type)
        try:
            with (
                _short_warnings(),
                _errors_as_messages(),
                _output_errors(),
                _command_line_errors(),
            ):
                return super().invoke(ctx)
        except KeyboardInterrupt as interruption:
            message = _interruption_message(ctx.invoked_subcommand)
            if interruption.args:
                message = f"lagbench: interrupted; {interruption}"
            print_on_stderr(message)
            raise typer.Exit(INTERRUPTED) from None
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:
            if _is_click_error(error) or os.environ.get("LAGBENCH_DEBUG") == "1":
                raise
            print_on_stderr(_unexpected_error_message(error))
            raise typer.Exit(FAILED) from error


def _is_click_error(error: Exception) -> bool:
    """Tell whether an error is click's or typer's copy of it."""
    return any(kind.__name__ == "ClickException" for kind in type(error).__mro__)


@contextmanager
def _command_line_errors() -> Iterator[None]:
    """Turn the errors of click's parser into errors of ours.

    Raises:
        UsageError: an option or a command is unknown, missing, or has a wrong value.
        UnreadableFileError: a file may not be read.
    """
    try:
        yield
    except Exception as error:
        # Without any argument the help is printed, also by an exception.
        is_help = type(error).__name__ == "NoArgsIsHelpError"
        if not _is_click_error(error) or is_help:
            raise
        raise _translate_click_error(error) from None


def _translate_click_error(error: Any) -> LagbenchError:  # noqa: ANN401 (two copies of click)
    """Return an error of click's parser as one of ours."""
    context = getattr(error, "ctx", None)
    command = _guess_command()
    if context is not None:
        command = f"lagbench {_command_words(context)}".rstrip()
    translations = {
        "NoSuchOption": _unknown_option_error,
        "MissingParameter": _missing_parameter_error,
        "BadParameter": _bad_parameter_error,
        "BadOptionUsage": _option_value_error,
    }
    kind = type(error).__name__
    if kind in translations:
        return translations[kind](error, command)

    message = str(error.format_message()).rstrip(".")
    extra_words = _EXTRA_WORDS.search(message)
    if extra_words is not None and context is not None:
        return _extra_words_error(context, command, extra_words[1])
    if sys.argv[1:2] == [PROGRAM]:
        words = " ".join(map(shorten_word, sys.argv[2:]))
        return UsageError(
            "the name of the program is typed twice",
            where=PROGRAM,
            expected="the name of a command",
            got=f"{PROGRAM} {_typed_words()}",
            fix=f"write it once: {PROGRAM} {words or '--help'}",
        )
    typed_command = _find_command(sys.argv[2:3])
    if sys.argv[1:2] == ["help"] and typed_command is not None:
        command = f"{PROGRAM} {typed_command}"
    return UsageError(
        message[:1].lower() + message[1:],
        where=command,
        expected="a command, its arguments and its options",
        got=_typed_words(),
        fix=_name_help(command),
    )


def _name_help(command: str) -> str:
    """Return the hint that names the help of a command."""
    return f"`{command} --help` lists what there is"


def _typed_words() -> str | None:
    """Return the words behind ``lagbench``; None where there are none."""
    return " ".join(map(shorten_word, sys.argv[1:])) or None


def _unknown_option_error(error: Any, command: str) -> UsageError:  # noqa: ANN401
    """Return the error for an option that a command does not have."""
    if error.option_name == "--size" and command in COMMANDS_WITHOUT_SIZE:
        return UsageError(
            "no such option",
            where=command,
            expected="files, which state their size",
            got=error.option_name,
            fix="leave --size out; `lagbench template` and `lagbench predict` take "
            "the size and write it into predictions",
        )
    fix = _name_help(command)
    single_hyphen = _find_single_hyphen(error)
    if single_hyphen is not None:
        return UsageError(
            "no such option",
            where=command,
            expected="a long option with two hyphens",
            got=shorten_word(single_hyphen),
            fix=f"write two hyphens: -{single_hyphen.partition('=')[0]}",
        )
    typed_command = _find_command(sys.argv[1:])
    if command == PROGRAM and typed_command is not None:
        fix = f"write options behind the command: {PROGRAM} {typed_command} ... "
        fix += error.option_name
    options = error.possibilities or ()
    if options:
        fix = f"did you mean {', '.join(options)}? {fix}"
    is_misspelt = difflib.get_close_matches(
        error.option_name, options, cutoff=NEAR_NAME
    )
    if command == "lagbench train" and not is_misspelt:
        setting = "--set training.steps=100"
        fix = f"the values of a recipe follow --set, as in {setting}; {fix}"
    # The value of a setting may be a negative number.
    if NEGATIVE_NUMBER.fullmatch(error.option_name):
        fix = advise_on_settings(sys.argv) or fix
    return UsageError(
        "no such option",
        where=command,
        expected="an option of this command",
        got=error.option_name,
        fix=fix,
    )


def _find_single_hyphen(error: Any) -> str | None:  # noqa: ANN401 (two copies of click)
    """Return a word such as -split or -split=cavity, for which there is --split."""
    if error.ctx is None:
        return None
    options = set()
    for parameter in error.ctx.command.params:
        options.update(parameter.opts)
    for word in sys.argv[1:]:
        name = word.partition("=")[0]
        if word.startswith(error.option_name) and f"-{name}" in options:
            return word
    return None


def _find_command(words: Sequence[str]) -> str | None:
    """Return the first word that is the name of a command or a group."""
    names = {entry.name for entry in COMMANDS}.union(GROUPS)
    for word in words:
        if word in names:
            return word
    return None


def _missing_parameter_error(error: Any, command: str) -> UsageError:  # noqa: ANN401
    """Return the error for an argument or an option that a command needs."""
    name = _parameter_name(error)
    return UsageError(
        f"{name} is missing",
        where=command,
        expected=getattr(error.param, "help", None) or f"a value of {name}",
        got="nothing",
        fix=f"add {name}; {_name_help(command)}",
    )


def _bad_parameter_error(error: Any, command: str) -> LagbenchError:  # noqa: ANN401
    """Return the error for a value that does not fit, or for a file without access."""
    # The help of a group shall load no other module.
    from lagbench.data.field_errors import describe_expectation

    unreadable_path = _UNREADABLE_PATH.search(str(error.message))
    if unreadable_path is not None:
        return UnreadableFileError(
            "cannot open the file",
            where=unreadable_path[2],
            expected="a file that you may read",
            got="no permission to read it",
            fix="see who owns it, or name another",
        )
    name = _parameter_name(error)
    detail = _first_detail(error)
    fix = f"give another value; {_name_help(command)}"
    is_number = detail is not None and detail["type"].startswith("float")
    if is_number and _DECIMAL_COMMA.fullmatch(str(detail["input"])):
        number = str(detail["input"]).replace(",", ".")
        fix = f"write a decimal point: {name} {number}"
    return UsageError(
        f"{name} has a value that does not fit",
        where=command,
        expected=describe_expectation(detail) if detail else str(error.message),
        got=shorten_word(repr(detail["input"])) if detail else None,
        fix=fix,
    )


def _option_value_error(error: Any, command: str) -> UsageError:  # noqa: ANN401
    """Return the error for a flag with a value, or an option without its value."""
    name = error.option_name
    if "not take a value" in str(error.format_message()):
        return UsageError(
            f"{name} takes no value",
            where=command,
            expected=f"{name} alone",
            got=_typed_words(),
            fix=f"leave the value out; {_name_help(command)}",
        )
    return UsageError(
        f"{name} has no value",
        where=command,
        expected=f"{name} and a value",
        got=_typed_words(),
        fix=f"add a value behind {name}; {_name_help(command)}",
    )


def _extra_words_error(
    context: Any,  # noqa: ANN401 (two copies of click)
    command: str,
    words: str,
) -> UsageError:
    """Return the error for words that are neither arguments nor options."""
    usage = " ".join([command, *context.command.collect_usage_pieces(context)])
    has_size = any("--size" in parameter.opts for parameter in context.command.params)
    size_names = SIZE_NAMES.intersection(words.split())
    if has_size and size_names:
        fix = f"name the size by an option: --size {min(size_names)}"
    else:
        fix = (
            advise_on_lists(sys.argv)
            or advise_on_settings(sys.argv)
            or advise_on_baselines(sys.argv)
            or advise_on_splits(sys.argv)
            or "leave them out, or put quotes around a text with blanks; "
            f"`{command} --help`"
        )
    return UsageError(
        "too many words",
        where=command,
        expected=usage,
        got=shorten_word(words),
        fix=fix,
    )


def _guess_command() -> str:
    """Return the words of a command as they were typed, where click tells none."""
    words = ["lagbench"]
    for word in sys.argv[1:]:
        if word.startswith("-"):
            break
        words.append(word)
        if word not in GROUPS:
            break
    return " ".join(words)


def _command_words(context: Any) -> str:  # noqa: ANN401 (two copies of click)
    """Return the words of a command below the program's name."""
    words: list[str] = []
    while context.parent is not None:
        words.insert(0, str(context.info_name))
        context = context.parent
    return " ".join(words)


def _parameter_name(error: Any) -> str:  # noqa: ANN401 (two copies of click)
    """Return how the user writes a parameter, as in --size or FILE."""
    if error.param is None:
        return str(error.param_hint or "an argument")
    for name in error.param.opts:
        if name.startswith("--"):
            return str(name)
    return str(error.param.metavar or error.param.name)


def _first_detail(error: Any) -> Any:  # noqa: ANN401 (two copies of click)
    """Return what pydantic says of a wrong value; None where it did not check it."""
    cause = error.__cause__ or error.__context__
    if not hasattr(cause, "errors"):
        return None
    return cause.errors()[0]


def _interruption_message(command: str | None) -> str:
    same_command = "the same command"
    words = [command or ""]
    if command in GROUPS:
        words.extend(sys.argv[2:3])
    is_resumable = " ".join(words) in RESUMABLE_COMMANDS
    if not is_resumable or "--no-record" in sys.argv:
        return f"lagbench: interrupted; {same_command} begins anew"
    if command == "train" and "--fresh" in sys.argv:
        return (
            f"lagbench: interrupted; {same_command}, without --fresh, goes on with the "
            "training that its folder holds"
        )
    for option in ("--force", "--again"):
        if option in sys.argv:
            same_command += f", without {option},"
    return f"lagbench: interrupted; {same_command} goes on where it stopped"


def _unexpected_error_message(error: Exception) -> str:
    """Return the message of an error that is no LagbenchError, with what to do."""
    debug_command = f"LAGBENCH_DEBUG=1 lagbench {' '.join(sys.argv[1:])}"
    place = find_place_in_extension(error)
    if place is None:
        advice = "this is a fault of lagbench; please report it with the output of"
        address = f"the repository's address is {describe(REPOSITORY)}"
        fix = f"{advice}\n       {debug_command}\n       ({address})"
    else:
        advice = f"mend or uninstall the package of {place};"
        fix = f"{advice}\n       {debug_command} has the whole trace"
    texts = [text_of(error), *getattr(error, "__notes__", ())]
    description = escape_unprintable(", ".join(texts))
    kind = type(error).__name__
    return f"lagbench: unexpected {kind}: {description}\n  fix: {fix}"


@contextmanager
def _errors_as_messages() -> Iterator[None]:
    """Print our errors, and end with their exit codes."""
    try:
        yield
    except LagbenchError as error:
        print_on_stderr(f"lagbench: {error}")
        raise typer.Exit(error.exit_code) from error


@contextmanager
def _output_errors() -> Iterator[None]:
    """End in silence when the reader of a pipe has left; explain a full disk."""
    try:
        yield
    except (BrokenPipeError, SystemExit) as error:
        # rich turns a BrokenPipeError into a SystemExit.
        is_broken_pipe = isinstance(error, BrokenPipeError) or isinstance(
            error.__context__, BrokenPipeError
        )
        if not is_broken_pipe:
            raise
        # The buffered output would fail again at the end.
        with suppress(AttributeError, OSError):
            null_device = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null_device, sys.stdout.fileno())
        raise typer.Exit(PIPE_CLOSED) from None
    except (MemoryError, ImportError) as error:
        is_memory = isinstance(error, MemoryError)
        text = text_of(error)
        if not is_memory and not any(word in text for word in MEMORY_WORDS):
            raise
        raise WorkFailedError(
            "there is not enough memory",
            where="this process",
            expected="room for the libraries and the data",
            got=f"{type(error).__name__}: {text[:200]}",
            fix="raise the limit (`ulimit -v unlimited`, or that of the batch system), "
            "close other programs, or take fewer --workers",
        ) from error
    except RuntimeError as error:
        text = text_of(error)
        if PROCESSOR_WORDS not in text:
            raise
        raise WorkFailedError(
            "the installed NumPy cannot run on this processor",
            where="this machine",
            expected="a processor with the instructions that NumPy was built for",
            got=" ".join(text.split()),
            fix="install an older NumPy, which needs fewer: pip install 'numpy<2.4'",
        ) from error
    except OSError as error:
        explained = explain_system_error(error)
        if explained is None:
            raise
        raise explained from error


@contextmanager
def _short_warnings() -> Iterator[None]:
    """Print warnings for users in one line; those for developers keep their place.

    A package that cannot be loaded is printed once, however often it is asked for.
    """
    with warnings.catch_warnings():
        show_in_full = warnings.showwarning
        printed_texts: set[str] = set()

        def show(
            message: Warning | str,
            category: type[Warning],
            *place: Any,  # noqa: ANN401
            **more: Any,  # noqa: ANN401
        ) -> None:
            if category.__module__.startswith("lagbench."):
                text = escape_unprintable(str(message))
                if category.__name__ == "PluginWarning" and text in printed_texts:
                    return
                printed_texts.add(text)
                print_on_stderr(f"warning: {text}")
            else:
                show_in_full(message, category, *place, **more)

        warnings.showwarning = show
        yield


app = typer.Typer(
    cls=_Program,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Start with: lagbench generate --split cavity --size tiny",
)


def _print_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(version("lagbench"))
        raise typer.Exit


@app.callback()
def _lagbench(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_print_version,
            is_eager=True,
            help="Print the version.",
        ),
    ] = False,
) -> None:
    """Bit-reproducible particle data sets for neural surrogates of simulators."""


class _LeaderboardGroup(_LazyGroup):
    entries = LEADERBOARD_COMMANDS


leaderboard = typer.Typer(
    cls=_LeaderboardGroup,
    no_args_is_help=True,
    help="Draw, check and show the leaderboard.",
)
app.add_typer(
    leaderboard,
    name="leaderboard",
    epilog="Example: lagbench leaderboard show",
)
