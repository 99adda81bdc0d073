"""Options that several commands share, each defined once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lagbench.errors import UsageError


def root_of(text: str) -> Path:
    """Return a root; an empty one would be the current folder as a path."""
    if not text.strip():
        raise typer.BadParameter("it is empty: name a folder, or leave it out")
    return Path(text)


SplitArgument = Annotated[str | None, typer.Argument(metavar="SPLIT", help="The same as --split.")]
SplitOption = Annotated[
    str | None, typer.Option("--split", metavar="NAME", help="Data set; `lagbench list` names them.")
]
NewSizeOption = Annotated[
    str | None, typer.Option("--size", metavar="NAME", help="tiny, mini or full; mini by default.")
]
PresentSizeOption = Annotated[
    str | None,
    typer.Option("--size", metavar="NAME", help="tiny, mini or full; by default the only one there is."),
]
SubsetOption = Annotated[
    str | None, typer.Option("--subset", metavar="NAMES", help="Some of train,valid,test; all by default.")
]
ScenariosOption = Annotated[
    str | None,
    typer.Option("--scenarios", metavar="IDS", help="Some scenarios, as in 0,3-5; all by default."),
]
RootOption = Annotated[
    Path | None,
    typer.Option(
        "--root",
        parser=root_of,
        metavar="FOLDER",
        help="Where data sets live, or s3://bucket/prefix; else LAGBENCH_ROOT, else user data.",
    ),
]
WorkersOption = Annotated[
    int | None,
    typer.Option("--workers", metavar="N", help="Worker processes; one per core by default.", min=1),
]
DeviceOption = Annotated[
    str, typer.Option("--device", metavar="NAME", help="cpu, parallel (its threads) or cuda.")
]
SchedulerOption = Annotated[
    str | None,
    typer.Option("--scheduler", metavar="ADDRESS", help="Dask scheduler, as in tcp://host:8786."),
]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout.")]
QuietFlag = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")]


def chosen(argument: str | None, option: str | None) -> str:
    """Return the split that a user named, by argument or by option.

    Raises:
        UsageError: neither or two different ones were given.
    """
    given = {name for name in (argument, option) if name is not None}
    if len(given) != 1:
        raise UsageError(
            "two splits are named" if given else "no split is named",
            where="--split",
            got=" and ".join(sorted(given)) or None,
            fix="name one, as in --split cavity; `lagbench list` shows them",
        )
    return given.pop()
