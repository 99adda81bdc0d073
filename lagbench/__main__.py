"""The program `lagbench`: its commands in the order in which a user meets them, and
their errors.
"""

from __future__ import annotations

import errno
import io
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from .cli import board, data, draw, exchange, scoring, training
from .cli import demo as tour
from .errors import LagbenchError, WorkFailedError, package_at_fault, printable

INTERRUPTED = 130
FAILED = 5
RESUMED = {
    "demo",
    "generate",
    "download",
    "train",
}  # commands that go on where they stopped
UNREAD = 141  # what shells say of a command whose reader left, 128 + SIGPIPE
FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


class _Commands(TyperGroup):
    """Turns whatever a command raises into a message on stderr and an exit code."""

    def make_context(self, *args: Any, **extra: Any) -> Any:  # noqa: ANN401
        for stream in (sys.stdout, sys.stderr):
            if isinstance(
                stream, io.TextIOWrapper
            ):  # a letter that a stream lacks shall not end the work
                stream.reconfigure(errors="backslashreplace")
        with _told(), _refused_output():  # --help and --version print here
            return super().make_context(*args, **extra)

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 (typer and click disagree on its type)
        try:
            with _plain_warnings(), _told(), _refused_output():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            again = "; the same command" + (
                ", without --force," if "--force" in sys.argv else ""
            )
            if ctx.invoked_subcommand in RESUMED:
                more = f"{again} goes on where it stopped"
            else:
                more = ""
            typer.echo(f"lagbench: interrupted{more}", err=True)
            raise typer.Exit(INTERRUPTED) from None
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:
            # click's usage errors, or typer's own copy of them, are typer's to show
            usage = any(
                kind.__name__ == "ClickException" for kind in type(error).__mro__
            )
            if usage or os.environ.get("LAGBENCH_DEBUG") == "1":
                raise
            again = f"LAGBENCH_DEBUG=1 lagbench {' '.join(sys.argv[1:])}"
            fix = f"this is a fault of lagbench; please report it with the output of\n       {again}"
            if (place := package_at_fault(error)) is not None:
                fix = f"mend or uninstall the package of {place};\n       {again} has the whole trace"
            said = printable(", ".join([str(error), *getattr(error, "__notes__", ())]))
            typer.echo(
                f"lagbench: unexpected {type(error).__name__}: {said}\n  fix: {fix}",
                err=True,
            )
            raise typer.Exit(FAILED) from error


@contextmanager
def _told() -> Iterator[None]:
    """Print our errors, and end with their exit codes."""
    try:
        yield
    except LagbenchError as error:
        typer.echo(f"lagbench: {error}", err=True)
        raise typer.Exit(error.exit_code) from error


@contextmanager
def _refused_output() -> Iterator[None]:
    """End in silence where the reader of a pipe has left; say that there is no space to
    write to.
    """
    try:
        yield
    except (BrokenPipeError, SystemExit) as left:
        # rich makes one of the other
        if isinstance(left, SystemExit) and not isinstance(
            left.__context__, BrokenPipeError
        ):
            raise
        with suppress(
            AttributeError, OSError
        ):  # what is still buffered would fail again at the end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(UNREAD) from None
    except OSError as error:
        if isinstance(error, PermissionError) and error.filename is not None:
            raise WorkFailedError(
                "no permission",
                where=str(error.filename),
                expected="a file or folder that you may read or write",
                got=error.strerror,
                fix="see who owns it, or name another",
            ) from error
        if error.errno not in FULL:
            raise
        where = error.filename or "standard output, or another file that is written"
        raise WorkFailedError(
            "cannot write there", where=where, got=error.strerror, fix="free disk space"
        ) from error


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Tell our users' warnings in one line; those for developers keep their place in
    the code.
    """
    with warnings.catch_warnings():
        show = warnings.showwarning

        def tell(
            message: Warning | str,
            category: type[Warning],
            *place: Any,  # noqa: ANN401
            **more: Any,  # noqa: ANN401
        ) -> None:
            if category.__module__.startswith("lagbench."):
                typer.echo(f"warning: {message}", err=True)
            else:
                show(message, category, *place, **more)

        warnings.showwarning = tell
        yield


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Start with: lagbench generate --split cavity --size tiny",
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(version("lagbench"))
        raise typer.Exit


@app.callback()
def _lagbench(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Bit-reproducible particle data sets for neural surrogates of continuum
    simulators.
    """


COMMANDS: tuple[tuple[Callable[..., None], str], ...] = (
    (tour.demo, "demo --root demo"),
    (data.list_splits, "list --json"),
    (data.info, "info cavity --size mini"),
    (data.generate, "generate --split cavity --size tiny --workers 2"),
    (data.verify, "verify --split cavity --size tiny --regenerate 2"),
    (exchange.download, "download --split cavity --size mini --from https://host/data"),
    (exchange.export, "export cavity --size mini --format gns-npz -o cavity-gns"),
    (exchange.import_split, "import WaterDrop --format gns-npz -o drop"),
    (exchange.adopt, "adopt runs/*.npz -o own --radius 0.03 --frame-interval 0.1"),
    (scoring.template, "template cavity --size tiny -o predictions.nc"),
    (scoring.validate, "validate predictions.nc"),
    (scoring.score, "score predictions.nc"),
    (scoring.compare, "compare ours/scores.json theirs/scores.json"),
    (training.train, "train --baseline gns --split cavity --size tiny"),
    (training.predict, "predict runs/cavity/tiny/gns-0/weights.pt"),
    (training.bench, "bench solver --split cavity --size tiny"),
    (board.submit, "submit predictions.nc --from meta.yaml"),
    (draw.plot, "plot cavity --size tiny --scenario 3 --frame 15 -o flow.png"),
    (draw.animate, "animate fluid --size tiny --scenario 3 -o splash.gif"),
    (data.cite, "cite cavity"),
    (data.doctor, "doctor"),
    (data.clean, "clean --split cavity --size tiny --dry-run"),
)
"""Every command, and the example below its help, which begins with its name."""

for function, example in COMMANDS:
    app.command(example.split()[0], epilog=f"Example: lagbench {example}")(function)
app.add_typer(
    board.leaderboard, name="leaderboard", epilog="Example: lagbench leaderboard show"
)

if __name__ == "__main__":
    app()
