"""The program `lagbench`: its commands, and how they end."""

from __future__ import annotations

import errno
import io
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from typing import Annotated, Any

import typer

from .addresses import REPOSITORY, describe
from .cli.commands import COMMANDS, LEADERBOARD_COMMANDS
from .cli.lazy_group import LazyGroup
from .errors import (
    LagbenchError,
    WorkFailedError,
    escape_unprintable,
    find_faulty_package,
)

INTERRUPTED = 130
FAILED = 5
PIPE_CLOSED = 141
"""Exit code that shells report when the reader of a pipe left, 128 + SIGPIPE."""

RESUMABLE_COMMANDS = {"demo", "generate", "download", "train"}
"""Commands that go on where they stopped."""

DISK_FULL_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


class _Program(LazyGroup):
    """All commands; what they raise becomes a message on stderr and an exit code."""

    entries = COMMANDS

    def make_context(self, *args: Any, **extra: Any) -> Any:  # noqa: ANN401
        for stream in (sys.stdout, sys.stderr):
            # A character that a stream cannot encode shall not end the work.
            if isinstance(stream, io.TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")
        # --help and --version print here.
        with _errors_as_messages(), _output_errors():
            return super().make_context(*args, **extra)

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 (typer and click disagree on its type)
        try:
            with _short_warnings(), _errors_as_messages(), _output_errors():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            message = _interruption_message(ctx.invoked_subcommand)
            typer.echo(message, err=True)
            raise typer.Exit(INTERRUPTED) from None
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:
            if _is_click_error(error) or os.environ.get("LAGBENCH_DEBUG") == "1":
                raise
            typer.echo(_unexpected_error_message(error), err=True)
            raise typer.Exit(FAILED) from error


def _is_click_error(error: Exception) -> bool:
    """Tell whether an error is click's or typer's copy of it; typer shows those."""
    return any(kind.__name__ == "ClickException" for kind in type(error).__mro__)


def _interruption_message(command: str | None) -> str:
    if command not in RESUMABLE_COMMANDS:
        return "lagbench: interrupted"
    same_command = "the same command"
    if "--force" in sys.argv:
        same_command += ", without --force,"
    return f"lagbench: interrupted; {same_command} goes on where it stopped"


def _unexpected_error_message(error: Exception) -> str:
    debug_command = f"LAGBENCH_DEBUG=1 lagbench {' '.join(sys.argv[1:])}"
    place = find_faulty_package(error)
    if place is None:
        advice = "this is a fault of lagbench; please report it with the output of"
        place = f"the repository's address is {describe(REPOSITORY)}"
        fix = f"{advice}\n       {debug_command}\n       ({place})"
    else:
        advice = f"mend or uninstall the package of {place};"
        fix = f"{advice}\n       {debug_command} has the whole trace"
    texts = [str(error), *getattr(error, "__notes__", ())]
    description = escape_unprintable(", ".join(texts))
    kind = type(error).__name__
    return f"lagbench: unexpected {kind}: {description}\n  fix: {fix}"


@contextmanager
def _errors_as_messages() -> Iterator[None]:
    """Print our errors, and end with their exit codes."""
    try:
        yield
    except LagbenchError as error:
        typer.echo(f"lagbench: {error}", err=True)
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
    except OSError as error:
        if isinstance(error, PermissionError) and error.filename is not None:
            raise WorkFailedError(
                "no permission",
                where=str(error.filename),
                expected="a file or folder that you may read or write",
                got=error.strerror,
                fix="see who owns it, or name another",
            ) from error
        if error.errno not in DISK_FULL_ERRORS:
            raise
        raise WorkFailedError(
            "cannot write there",
            where=error.filename or "standard output, or another output file",
            got=error.strerror,
            fix="free disk space",
        ) from error


@contextmanager
def _short_warnings() -> Iterator[None]:
    """Print warnings for users in one line; those for developers keep their place."""
    with warnings.catch_warnings():
        show_in_full = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            *place: Any,  # noqa: ANN401
            **more: Any,  # noqa: ANN401
        ) -> None:
            if category.__module__.startswith("lagbench."):
                typer.echo(f"warning: {message}", err=True)
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


class _LeaderboardGroup(LazyGroup):
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

if __name__ == "__main__":
    app()
