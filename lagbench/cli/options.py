"""Options that several commands share, each defined once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.types import PositiveInt

NewSizeOption = Annotated[
    str | None, Parameter(help="tiny, mini or full; mini by default.")
]
PresentSizeOption = Annotated[
    str | None,
    Parameter(
        help="tiny, mini or full; by default the only size with data here, or mini if "
        "there are several."
    ),
]
SubsetOption = Annotated[
    str | None, Parameter(help="Subsets, as in train,valid,test; all by default.")
]
ScenariosOption = Annotated[
    str | None, Parameter(help="Scenarios, as in 0,3-5; all by default.")
]
# A text: as a path, a URL would lose a slash.
RootOption = Annotated[
    str | None,
    Parameter(
        help="Folder of all data sets, or s3://bucket/prefix. By default "
        "LAGBENCH_ROOT, or else the folder for user data."
    ),
]
WorkersOption = Annotated[
    PositiveInt | None, Parameter(help="Worker processes; one per core by default.")
]
SchedulerOption = Annotated[
    str | None, Parameter(help="Dask scheduler, as in tcp://host:8786.")
]
DEFAULT_BOARD = Path("leaderboard")
BoardOption = Annotated[Path, Parameter(help="Folder of the leaderboard.")]
FoundBoardOption = Annotated[
    Path | None,
    Parameter(
        help="Folder of the leaderboard; by default ./leaderboard, or else the clone's."
    ),
]
ScoredSubsetOption = Annotated[
    str,
    Parameter(help="test, or shift, whose scenarios are unlike those of train."),
]
ExpectedSplitOption = Annotated[
    str | None,
    Parameter(
        help="Refuse predictions for another split; a local split is named by its "
        "folder."
    ),
]
OutputOption = Annotated[Path | None, Parameter(alias="-o")]
OverwriteFlag = Annotated[bool, Parameter(help="Replace a file of that name.")]
DeviceOption = Annotated[str, Parameter(help="cpu, cuda, or auto.")]
ThreadsOption = Annotated[
    PositiveInt | None,
    Parameter(
        help="CPU threads; by default OMP_NUM_THREADS, or else a share of the cores."
    ),
]
DrawSeedOption = Annotated[
    str | None,
    Parameter(
        help="New test scenarios, drawn from this seed of 64 hexadecimal digits."
    ),
]
JsonFlag = Annotated[
    bool, Parameter(name="--json", help="Print one JSON object on stdout.")
]
QuietFlag = Annotated[bool, Parameter(alias="-q", help="Print errors only.")]
