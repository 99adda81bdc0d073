"""The commands plot, animate and view."""

from __future__ import annotations

from pathlib import Path

from cyclopts.types import PositiveInt

from lagbench.data.local import locate
from lagbench.errors import UsageError
from lagbench.exchange.viewing import view
from lagbench.figures.animate import animate
from lagbench.figures.pictures import (
    data_name,
    find_scenario,
    plot,
    require_place,
)
from lagbench.figures.plot import contact_sheet
from lagbench.store.copy import update_working_copy

from .options import (
    JsonFlag,
    OutputOption,
    OverwriteFlag,
    PresentSizeOption,
    QuietFlag,
    RootOption,
)
from .output import print_result

LAST_FRAME = -1


def plot_command(
    split: str,
    *,
    size: PresentSizeOption = None,
    scenario: int | None = None,
    frame: int | None = None,
    kind: str = "all",
    sheet: bool = False,
    output: OutputOption = None,
    overwrite: OverwriteFlag = False,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Draw one frame of a scenario: particles, vorticity, streamlines.

    Args:
        split: A split, or a scenario file.
        scenario: Scenario; by default the first one of test.
        frame: Frame number. Negative numbers count from the end: -1, the default, is
            the last frame.
        kind: all, speed, material, vorticity, streamlines; for three-dimensional boxes
            also front or above.
        sheet: Draw many scenarios of the split on one page instead.
        output: File to write; by default named after the data.
    """
    if sheet:
        if scenario is not None or frame is not None:
            raise UsageError(
                "a sheet shows many scenarios and frames; leave --scenario and --frame "
                "out, or --sheet"
            )
        tier, folder, splits = locate(split, size, root=root)
        page = Path(f"{tier.split}-{tier.name}-sheet.png")
        if output is not None:
            page = output
        require_place(page, overwrite=overwrite)
        update_working_copy(tier, folder, tier.scenarios)
        path = contact_sheet(tier, folder, page, registry=splits, kind=kind)
    else:
        file = find_scenario(split, size=size, scenario=scenario, root=root)
        path = output or Path(f"{data_name(file)}.png")
        plot(
            split,
            size=size,
            scenario=scenario,
            frame=LAST_FRAME if frame is None else frame,
            kind=kind,
            output=path,
            overwrite=overwrite,
            root=root,
        )
    print_result({"output": path}, [str(path)], as_json=as_json, quiet=quiet)


def animate_command(
    split: str,
    beside: str | None = None,
    *,
    size: PresentSizeOption = None,
    scenario: int | None = None,
    kind: str | None = None,
    fps: float = 30.0,
    every: PositiveInt = 1,
    output: OutputOption = None,
    overwrite: OverwriteFlag = False,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Make an MP4 or GIF film of a scenario, or of two side by side.

    Args:
        split: A split, or a scenario file.
        beside: Second scenario of the split, or second scenario file.
        scenario: Scenario; by default the first one of test.
        kind: speed, material or vorticity; by default material where there are several,
            else speed.
        fps: Frames shown per second.
        every: Show every n-th frame.
        output: File to write; by default named after the data.
    """
    second: str | int | None = beside
    if beside is not None and beside.isdecimal():
        second = int(beside)
    path = animate(
        split,
        size=size,
        scenario=scenario,
        beside=second,
        kind=kind,
        frames_per_second=fps,
        every=every,
        output=output,
        overwrite=overwrite,
        root=root,
        quiet=quiet or as_json,
    )
    print_result({"output": path}, [str(path)], as_json=as_json, quiet=quiet)


def view_command(
    split: str,
    predictions: Path | None = None,
    *,
    size: PresentSizeOption = None,
    scenario: int | None = None,
    every: PositiveInt = 1,
    output: OutputOption = None,
    overwrite: OverwriteFlag = False,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Show a scenario, and a prediction beside it, in Rerun's viewer.

    Args:
        split: A split, or a scenario file.
        predictions: A predictions.nc of this data set, shown beside the truth.
        scenario: Scenario; by default the first one of test.
        every: Show every n-th frame.
        output: File (.rrd) to write, in place of starting the viewer.
    """
    file = find_scenario(split, size=size, scenario=scenario, root=root)
    if output is not None:
        require_place(output, overwrite=overwrite)
    view(file, predictions=predictions, output=output, every=every)
    lines = [] if output is None else [str(output)]
    print_result({"output": output}, lines, as_json=as_json, quiet=quiet)
