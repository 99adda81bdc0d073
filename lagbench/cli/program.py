"""The program `lagbench`: its commands, and how they end."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib.metadata import version
from typing import Any

from cyclopts import (
    App,
    CycloptsError,
    Group,
    Parameter,
    UnknownCommandError,
    UnknownOptionError,
)

from lagbench.errors import LagbenchError, explain_system_error, suggest_name

from .commands import COMMAND_GROUPS, COMMANDS
from .stderr import print_on_stderr

USAGE = 2
FAILED = 5
INTERRUPTED = 130
PIPE_CLOSED = 141
"""Exit code that shells report when the reader of a pipe left, 128 + SIGPIPE."""


def build_program() -> App:
    """Return the program; a command is imported when it is called."""
    program = App(
        name="lagbench",
        help="Bit-reproducible particle data sets for neural surrogates of simulators.",
        help_format="plaintext",
        help_epilogue="Start with: lagbench generate --split cavity --size tiny",
        version=lambda: version("lagbench"),
        default_parameter=Parameter(negative=(), show_default=False),
        exit_on_error=False,
        print_error=False,
        suppress_keyboard_interrupt=False,
        result_action="return_value",
    )
    headings = list(dict.fromkeys(command.group for command in COMMANDS))
    groups = {name: Group(name, sort_key=headings.index(name)) for name in headings}
    parents = {"": program}
    for name, heading, summary in COMMAND_GROUPS:
        parents[name] = App(name=name, help=summary, group=groups[heading])
        program.command(parents[name])
    for command in COMMANDS:
        first_word, _, name = command.name.rpartition(" ")
        parents[first_word].command(
            f"lagbench.cli.{command.target}",
            name=name,
            help=command.summary,
            help_epilogue=f"Example: lagbench {command.example}",
            group=None if first_word else groups[command.group],
        )
    return program


def app(words: Sequence[str] | None = None) -> int:
    """Run the words of a command line, or those of this process.

    What a command raises becomes a message on stderr.

    Returns:
        The exit code: 0, that of the error's class, 2 for words that do not fit, 130
        after Ctrl-C.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _shorten(warnings.showwarning)
            exit_code = build_program()(words)
        sys.stdout.flush()
        return exit_code or 0
    except CycloptsError as error:
        chain = " ".join(["lagbench", *(error.command_chain or ())])
        if isinstance(error, UnknownCommandError):
            typed_name = " ".join((error.unused_tokens or ())[:1])
            hint = suggest_name(typed_name, [command.name for command in COMMANDS])
            text = f"no such command: {typed_name!r}; {hint}"
        elif isinstance(error, UnknownOptionError):
            typed_name = error.token.keyword or error.token.value
            names = {name for one in error.argument_collection for name in one.names}
            options = [name[2:] for name in names if name.startswith("--")]
            hint = suggest_name(typed_name.lstrip("-"), options, prefix="--")
            text = f"no such option: {typed_name}; {hint}"
        else:
            text = str(error)
        print_on_stderr(f"{chain}: {text}\n`{chain} --help` lists what there is")
        return USAGE
    except LagbenchError as error:
        print_on_stderr(f"lagbench: {error}")
        return error.exit_code
    except KeyboardInterrupt as interruption:
        reason = f"; {interruption}" if interruption.args else ""
        print_on_stderr(f"lagbench: interrupted{reason}")
        return INTERRUPTED
    except (BrokenPipeError, SystemExit) as error:
        # rich turns a BrokenPipeError into a SystemExit
        if isinstance(error, SystemExit) and not isinstance(
            error.__context__, BrokenPipeError
        ):
            raise
        # The buffered output would fail again at the end.
        with suppress(AttributeError, OSError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except MemoryError:
        print_on_stderr("lagbench: there is not enough memory; take fewer --workers")
        return FAILED
    except Exception as error:
        if os.environ.get("LAGBENCH_DEBUG") == "1":
            raise
        explained = explain_system_error(error) if isinstance(error, OSError) else None
        if explained is not None:
            print_on_stderr(f"lagbench: {explained}")
            return explained.exit_code
        print_on_stderr(
            f"lagbench: unexpected {type(error).__name__}: {error}\n"
            "a fault of lagbench or of a package that extends it; LAGBENCH_DEBUG=1 "
            "before the command shows the place"
        )
        return FAILED


def _shorten(show_in_full: Callable[..., None]) -> Callable[..., None]:
    """Return a function that shows warnings for users in one line."""

    def show(message: Warning | str, category: type[Warning], *place: Any) -> None:  # noqa: ANN401
        if category.__module__.startswith("lagbench."):
            print_on_stderr(f"warning: {message}")
        else:
            show_in_full(message, category, *place)

    return show
