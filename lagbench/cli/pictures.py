"""The commands plot and animate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lagbench.data.local import locate
from lagbench.errors import UsageError
from lagbench.figures.animate import FASTEST, SLOWEST
from lagbench.figures.canvas import COARSEST, DPI, FINEST
from lagbench.figures.pictures import (
    SCENARIO_ENDING,
    animate,
    plot,
    require_place,
)
from lagbench.figures.plot import contact_sheet

from .options import (
    JsonFlag,
    OverwriteFlag,
    PresentSizeOption,
    QuietFlag,
    RootOption,
    choose_split,
    option,
)
from .output import print_result

LAST_FRAME = -1

SourceArgument = Annotated[
    str | None,
    typer.Argument(metavar="SPLIT|FILE", help="A split, or a scenario file."),
]
SplitNameOption = Annotated[str | None, option("--split NAME", "The same as SPLIT.")]
ScenarioOption = Annotated[
    int | None,
    option("--scenario ID", "Scenario; by default the first one of test."),
]
OutputOption = Annotated[
    Path | None,
    option("--output -o FILE", "File to write; by default named after the data."),
]


def plot_command(
    source: SourceArgument = None,
    split: SplitNameOption = None,
    size: PresentSizeOption = None,
    scenario: ScenarioOption = None,
    frame: Annotated[
        int | None,
        option(
            "--frame",
            "Frame number. Negative numbers count from the end: -1, the default, is "
            "the last frame.",
        ),
    ] = None,
    kind: Annotated[
        str,
        option(
            "--kind NAME",
            "all, speed, material, vorticity, streamlines; for three-dimensional "
            "boxes also front or above.",
        ),
    ] = "all",
    sheet: Annotated[
        bool, option("--sheet", "Draw many scenarios of the split on one page instead.")
    ] = False,
    output: OutputOption = None,
    overwrite: OverwriteFlag = False,
    dpi: Annotated[
        float,
        option(
            "--dpi",
            "Pixels per inch of PNG files, and of particles in PDF files.",
            min=COARSEST,
            max=FINEST,
        ),
    ] = DPI,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Draw one frame of a scenario: particles, vorticity, streamlines."""
    if sheet:
        _refuse_choice_of_one(scenario, frame)
        split_name = choose_split(source, split)
        tier = locate(split_name, size, root=root).size
        page = Path(f"{tier.split}-{tier.name}-sheet.png")
        if output is not None:
            page = output
        require_place(page, overwrite=overwrite)
        path = contact_sheet(split_name, tier.name, page, root=root, kind=kind, dpi=dpi)
    else:
        path = plot(
            _choose_source(source, split),
            size=size,
            scenario=scenario,
            frame=LAST_FRAME if frame is None else frame,
            kind=kind,
            output=output,
            overwrite=overwrite,
            dpi=dpi,
            root=root,
        )
    print_result({"output": path}, [str(path)], as_json=as_json, quiet=quiet)


def _refuse_choice_of_one(scenario: int | None, frame: int | None) -> None:
    """Refuse a scenario or a frame beside --sheet, which would be left out in silence.

    Raises:
        UsageError: one of them is given.
    """
    for name, number in (("--scenario", scenario), ("--frame", frame)):
        if number is not None:
            raise UsageError(
                "a sheet shows many scenarios, at frames that suit the split",
                where=f"--sheet and {name}",
                expected="one of the two",
                got=f"--sheet {name} {number}",
                fix=f"leave {name} out, or leave --sheet out to draw one frame",
            )


def animate_command(
    source: SourceArgument = None,
    second: Annotated[
        str | None,
        typer.Argument(
            metavar="FILE", help="Second scenario file, shown beside the first."
        ),
    ] = None,
    split: SplitNameOption = None,
    size: PresentSizeOption = None,
    scenario: ScenarioOption = None,
    beside: Annotated[
        int | None,
        option("--beside ID", "Second scenario of the split, shown beside the first."),
    ] = None,
    kind: Annotated[
        str | None,
        option(
            "--kind NAME",
            "speed, material or vorticity; by default material where there are "
            "several, else speed.",
        ),
    ] = None,
    fps: Annotated[
        float,
        option("--fps", "Frames shown per second.", min=SLOWEST, max=FASTEST),
    ] = 30.0,
    every: Annotated[int, option("--every", "Show every n-th frame.", min=1)] = 1,
    output: OutputOption = None,
    overwrite: OverwriteFlag = False,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Make an MP4 or GIF film of a scenario, or of two side by side."""
    if second is not None and beside is not None:
        raise UsageError(
            "a film shows two scenarios at most",
            where="the second FILE and --beside",
            expected="one of the two",
            got=f"{second} and --beside {beside}",
            fix="leave one of them out",
        )
    path = animate(
        _choose_source(source, split),
        size=size,
        scenario=scenario,
        beside=second if beside is None else beside,
        kind=kind,
        frames_per_second=fps,
        every=every,
        output=output,
        overwrite=overwrite,
        root=root,
        quiet=quiet or as_json,
    )
    print_result({"output": path}, [str(path)], as_json=as_json, quiet=quiet)


def _choose_source(source: str | None, split: str | None) -> str:
    """Return the scenario file or the split that a user names."""
    if source is not None and source.endswith(SCENARIO_ENDING):
        return source
    return choose_split(source, split)
