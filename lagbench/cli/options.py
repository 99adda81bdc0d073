"""Options that several commands share, each defined once."""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from lagbench.errors import SPLIT_NAMED, UsageError

from .typed_settings import (
    advise_on_baselines,
    advise_on_settings,
    check_typed_settings,
)


def option(names_and_value: str, help_text: str, **settings: Any) -> Any:  # noqa: ANN401
    """Return an option that is written as its help shows it, as in ``-o FILE``.

    Args:
        names_and_value: the names of the option, then the placeholder of its value.
        help_text: what the option does.
        settings: passed on to ``typer.Option``.
    """
    words = names_and_value.split()
    names = [word for word in words if word.startswith("-")]
    placeholder = " ".join(words[len(names) :])
    return typer.Option(*names, metavar=placeholder or None, help=help_text, **settings)


SplitArgument = Annotated[
    str | None, typer.Argument(metavar="SPLIT", help="The split, as with --split.")
]
SplitOption = Annotated[
    str | None,
    option("--split NAME", "Name of the split; `lagbench list` shows all names."),
]
NewSizeOption = Annotated[
    str | None, option("--size NAME", "tiny, mini or full; mini by default.")
]
PresentSizeOption = Annotated[
    str | None,
    option(
        "--size NAME",
        "tiny, mini or full; by default the only size with data here, or mini if "
        "there are several.",
    ),
]
SubsetOption = Annotated[
    str | None,
    option("--subset NAMES", "Subsets, as in train,valid,test; all by default."),
]
ScenariosOption = Annotated[
    str | None,
    option("--scenarios IDS", "Scenarios, as in 0,3-5; all by default."),
]
# Texts: as a path, an empty text would be the current folder, and a URL would lose a /.
RootOption = Annotated[
    str | None,
    option(
        "--root FOLDER",
        "Folder of all data sets, or s3://bucket/prefix. By default LAGBENCH_ROOT, or "
        "else the folder for user data.",
    ),
]
WorkersOption = Annotated[
    int | None,
    option("--workers N", "Worker processes; one per core by default.", min=1),
]
SchedulerOption = Annotated[
    str | None,
    option("--scheduler ADDRESS", "Dask scheduler, as in tcp://host:8786."),
]
DEFAULT_BOARD = Path("leaderboard")
BoardOption = Annotated[Path, option("--board FOLDER", "Folder of the leaderboard.")]
FoundBoardOption = Annotated[
    Path | None,
    option(
        "--board FOLDER",
        "Folder of the leaderboard; by default ./leaderboard, or else the clone's.",
    ),
]
ScoredSubsetOption = Annotated[
    str,
    option(
        "--subset NAME", "test, or shift, whose scenarios are unlike those of train."
    ),
]
OverwriteFlag = Annotated[bool, option("--overwrite", "Replace a file of that name.")]
JsonFlag = Annotated[bool, option("--json", "Print one JSON object on stdout.")]
QuietFlag = Annotated[bool, option("--quiet -q", "Print errors only.")]


def choose_split(argument: str | None, option: str | None) -> str:
    """Return the split that a user names by the argument SPLIT or the option --split.

    Raises:
        UsageError: no split is named, or two different ones, or the value of a setting
            stands where the name of a split should.
    """
    if argument is not None:
        check_typed_settings(sys.argv)
    fix = "name one, as in --split cavity; `lagbench list` shows all splits"
    names = {name for name in (argument, option) if name is not None}
    if not names:
        raise UsageError(
            "no split is named",
            where=SPLIT_NAMED,
            expected="the name of a split, or the folder of a local one",
            got="nothing",
            fix=fix,
        )
    if len(names) > 1:
        raise UsageError(
            "two splits are named",
            where=SPLIT_NAMED,
            expected="one split: by SPLIT, by --split, or twice the same",
            got=" and ".join(sorted(names)),
            fix=advise_on_settings(sys.argv) or advise_on_baselines(sys.argv) or fix,
        )
    return names.pop()


def accept_split(command: Callable[..., None]) -> Callable[..., None]:
    """Let users name the split of a command by SPLIT or by --split.

    The command has one parameter, ``split``. Its command line gets the argument and the
    option instead, and :func:`choose_split` decides between them.
    """
    parameters = [
        _split_parameter("split_argument", SplitArgument),
        _split_parameter("split_option", SplitOption),
    ]
    for parameter in inspect.signature(command, eval_str=True).parameters.values():
        if parameter.name != "split":
            keyword = parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            parameters.append(keyword)

    @functools.wraps(command)
    def choose_and_run(
        *, split_argument: str | None, split_option: str | None, **others: object
    ) -> None:
        command(split=choose_split(split_argument, split_option), **others)

    # typer reads the parameters of a command from these two attributes.
    signature = inspect.Signature(parameters)
    annotations = {parameter.name: parameter.annotation for parameter in parameters}
    choose_and_run.__signature__ = signature  # type: ignore[attr-defined]
    choose_and_run.__annotations__ = annotations
    return choose_and_run


def _split_parameter(name: str, annotation: object) -> inspect.Parameter:
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=annotation,
    )
