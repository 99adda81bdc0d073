"""Options that several commands share, each defined once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lagbench.errors import UsageError


def root_of(text: str) -> Path:
    """Return a root; an empty one would be the current folder as a path."""
    if not text.strip():
        raise typer.BadParameter("it is empty: name a folder, or leave it out")
    return Path(text)


def option(words: str, told: str, **how: Any) -> Any:  # noqa: ANN401
    """Return an option as its help shows it: its names, then what stands for the value,
    as in ``-o FILE``.
    """
    names = [word for word in words.split() if word.startswith("-")]
    return typer.Option(
        *names, metavar=" ".join(words.split()[len(names) :]) or None, help=told, **how
    )


SplitArgument = Annotated[
    str | None, typer.Argument(metavar="SPLIT", help="The same as --split.")
]
SplitOption = Annotated[
    str | None, option("--split NAME", "Data set; `lagbench list` names them.")
]
NewSizeOption = Annotated[
    str | None, option("--size NAME", "tiny, mini or full; mini by default.")
]
PresentSizeOption = Annotated[
    str | None,
    option("--size NAME", "tiny, mini or full; by default the only one there is."),
]
SubsetOption = Annotated[
    str | None, option("--subset NAMES", "Some of train,valid,test; all by default.")
]
ScenariosOption = Annotated[
    str | None,
    option("--scenarios IDS", "Some scenarios, as in 0,3-5; all by default."),
]
RootOption = Annotated[
    Path | None,
    option(
        "--root FOLDER",
        "Where data sets live, or s3://bucket/prefix; else LAGBENCH_ROOT, else "
        "user data.",
        parser=root_of,
    ),
]
WorkersOption = Annotated[
    int | None,
    option("--workers N", "Worker processes; one per core by default.", min=1),
]
DeviceOption = Annotated[
    str, option("--device NAME", "cpu, parallel (its threads) or cuda.")
]
SchedulerOption = Annotated[
    str | None, option("--scheduler ADDRESS", "Dask scheduler, as in tcp://host:8786.")
]
JsonFlag = Annotated[bool, option("--json", "Print one JSON object on stdout.")]
QuietFlag = Annotated[bool, option("--quiet -q", "Print nothing but errors.")]


def chosen(argument: str | None, option: str | None) -> str:
    """Return the split that a user named, by argument or by option; refuse none and
    two.
    """
    given = {name for name in (argument, option) if name is not None}
    if len(given) != 1:
        what = f"{'two splits are' if given else 'no split is'} named"
        got = " and ".join(sorted(given)) or None
        fix = "name one, as in --split cavity; `lagbench list` shows them"
        raise UsageError(what, where="--split", got=got, fix=fix)
    return given.pop()
