"""The application: its commands in the order in which a user meets them, and their errors."""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated, Any, TextIO

import typer
from typer.core import TyperGroup

from lagbench.errors import LagbenchError

from . import board, data, draw, exchange, scoring, training
from . import data as show
from . import data as upkeep
from . import demo as tour

__all__ = ["app"]

INTERRUPTED = 130
FAILED = 5


class _Commands(TyperGroup):
    """Turns whatever a command raises into a message on stderr and an exit code."""

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 (typer and click disagree on its type)
        try:
            with _plain_warnings():
                return super().invoke(ctx)
        except LagbenchError as error:
            typer.echo(f"lagbench: {error}", err=True)
            raise typer.Exit(error.exit_code) from error
        except KeyboardInterrupt:
            typer.echo("lagbench: interrupted; the same command goes on where it stopped", err=True)
            raise typer.Exit(INTERRUPTED) from None
        except (typer.Exit, typer.Abort, BrokenPipeError):
            raise
        except Exception as error:
            if _is_usage(error) or os.environ.get("LAGBENCH_DEBUG") == "1":
                raise
            typer.echo(
                f"lagbench: unexpected {type(error).__name__}: {error}\n"
                "  fix: this is a fault of lagbench; please report it with the output of\n"
                f"       LAGBENCH_DEBUG=1 lagbench {' '.join(sys.argv[1:])}",
                err=True,
            )
            raise typer.Exit(FAILED) from error


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Tell our users' warnings in one line; those for developers keep their place in the code."""
    with warnings.catch_warnings():
        show = warnings.showwarning

        def tell(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if category.__module__.startswith("lagbench."):
                typer.echo(f"warning: {message}", err=True)
            else:
                show(message, category, filename, lineno, file, line)

        warnings.showwarning = tell
        yield


def _is_usage(error: Exception) -> bool:
    """Tell whether typer shall show an error itself: click's or its own copy of them."""
    return any(kind.__name__ == "ClickException" for kind in type(error).__mro__)


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
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Bit-reproducible particle data sets for neural surrogates of continuum simulators."""


app.command("demo", epilog="Example: lagbench demo --root demo")(tour.demo)
app.command("list", epilog="Example: lagbench list --json")(show.list_splits)
app.command("info", epilog="Example: lagbench info cavity --size mini")(show.info)
app.command("generate", epilog="Example: lagbench generate --split cavity --size tiny --workers 2")(
    data.generate
)
app.command("verify", epilog="Example: lagbench verify --split cavity --size tiny --regenerate 2")(
    data.verify
)
app.command(
    "download", epilog="Example: lagbench download --split cavity --size mini --from https://host/data"
)(exchange.download)
app.command("export", epilog="Example: lagbench export cavity --size mini --format gns-npz -o cavity-gns")(
    exchange.export
)
app.command("import", epilog="Example: lagbench import WaterDrop --format gns-npz --allow-pickle -o drop")(
    exchange.import_split
)
app.command("adopt", epilog="Example: lagbench adopt runs/*.npz -o own --radius 0.03 --frame-interval 0.1")(
    exchange.adopt
)
app.command("template", epilog="Example: lagbench template cavity --size tiny -o predictions.nc")(
    scoring.template
)
app.command("validate", epilog="Example: lagbench validate predictions.nc")(scoring.validate)
app.command("score", epilog="Example: lagbench score predictions.nc")(scoring.score)
app.command("compare", epilog="Example: lagbench compare ours/scores.json theirs/scores.json")(
    scoring.compare
)
app.command("train", epilog="Example: lagbench train --baseline gns --split cavity --size tiny")(
    training.train
)
app.command("predict", epilog="Example: lagbench predict runs/cavity/tiny/gns-0/weights.pt")(training.predict)
app.command("bench", epilog="Example: lagbench bench solver --split cavity --size tiny")(training.bench)
app.command("submit", epilog="Example: lagbench submit predictions.nc --from meta.yaml")(board.submit)
app.add_typer(board.leaderboard, name="leaderboard", epilog="Example: lagbench leaderboard show")
app.command("plot", epilog="Example: lagbench plot cavity --size tiny --scenario 3 --frame 15 -o flow.png")(
    draw.plot
)
app.command("animate", epilog="Example: lagbench animate fluid --size tiny --scenario 3 -o splash.gif")(
    draw.animate
)
app.command("cite", epilog="Example: lagbench cite cavity")(show.cite)
app.command("doctor", epilog="Example: lagbench doctor")(upkeep.doctor)
app.command("clean", epilog="Example: lagbench clean --split cavity --size tiny --dry-run")(upkeep.clean)
