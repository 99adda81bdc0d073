"""The commands plot and animate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from lagbench.data.local import locate, suggest_repair
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.figures.animate import animate, check_ending
from lagbench.figures.plot import check_kind, contact_sheet, plot_frame
from lagbench.figures.recording import open_recording
from lagbench.store.copy import update_working_copy

from .options import (
    JsonFlag,
    PresentSizeOption,
    QuietFlag,
    RootOption,
    choose_split,
    option,
)
from .output import print_result

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
        int, option("--frame", "Frame number; -1 is the last frame.")
    ] = -1,
    kind: Annotated[
        str, option("--kind", "all, speed, material, vorticity or streamlines.")
    ] = "all",
    sheet: Annotated[
        bool, option("--sheet", "Draw many scenarios of the split on one page instead.")
    ] = False,
    output: OutputOption = None,
    dpi: Annotated[
        int,
        option(
            "--dpi",
            "Pixels per inch of PNG files, and of particles in PDF files.",
            min=32,
            max=1200,
        ),
    ] = 128,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Draw one frame of a scenario: particles, vorticity, streamlines."""
    if sheet:
        split_name = choose_split(source, split)
        tier = locate(split_name, size, root=root).size
        page = output or Path(f"{tier.split}-{tier.name}-sheet.png")
        _require_folder_of(page)
        path = contact_sheet(split_name, tier.name, page, root=root, dpi=dpi)
    else:
        check_kind(kind)
        file = _scenario_file(
            source, split=split, size=size, scenario=scenario, root=root
        )
        with _blame_named_files(source):
            path = output or _frame_path(file, frame)
            _require_folder_of(path)
            plot_frame(file, frame, path, kind=kind, dpi=dpi)
    print_result({"output": path}, [str(path)], as_json=as_json, quiet=quiet)


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
        str | None, option("--kind", "speed, material or vorticity.")
    ] = None,
    fps: Annotated[float, option("--fps", "Frames shown per second.")] = 30.0,
    every: Annotated[int, option("--every", "Show every n-th frame.", min=1)] = 1,
    output: OutputOption = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Make an MP4 or GIF film of a scenario, or of two side by side."""
    if output is not None:
        check_ending(output)
    file = _scenario_file(source, split=split, size=size, scenario=scenario, root=root)
    second_file = None
    if beside is not None:
        second_file = _scenario_file(
            source, split=split, size=size, scenario=beside, root=root
        )
    elif second:
        second_file = Path(second)
    path = output or Path(f"{_data_name(file)}.mp4")
    _require_folder_of(path)
    with _blame_named_files(source, second):
        animate(
            file,
            path,
            beside=second_file,
            kind=kind,
            frames_per_second=fps,
            every=every,
            quiet=quiet or as_json,
        )
    print_result({"output": path}, [str(path)], as_json=as_json, quiet=quiet)


def _scenario_file(
    source: str | None,
    *,
    split: str | None,
    size: str | None,
    scenario: int | None,
    root: Path | None,
) -> Path:
    """Return the scenario file that a user names by its path, or by split and id.

    Raises:
        UsageError: no split, or no such split, size or scenario.
        DataError: the scenario is not on this machine.
    """
    if source is not None and source.endswith(".nc"):
        return Path(source)
    tier, folder, _ = locate(choose_split(source, split), size, root=root)
    if scenario is None:
        scenario_id = tier.subsets["test"][0]
        repair = "--subset test"
    else:
        scenario_id = scenario
        repair = f"--scenarios {scenario}"
    tier.subset_of(scenario_id)  # refuses an id that the size does not have
    update_working_copy(tier, folder, [scenario_id])
    path = tier.path(folder, scenario_id)
    if not path.is_file():
        raise DataError(
            f"scenario {scenario_id} is not there",
            where=str(path),
            fix=suggest_repair(tier, repair, root=folder),
        )
    return path


@contextmanager
def _blame_named_files(*names: str | None) -> Iterator[None]:
    """Turn errors of damaged data into errors of the files that the user named.

    Raises:
        UnreadableFileError: a named file cannot be read or is no scenario file.
        DataError: a file of a data set is damaged.
    """
    try:
        yield
    except DataError as error:
        place = error.where or ""
        paths = [str(Path(name)) for name in names if name]
        if not any(place.startswith(path) for path in paths):
            raise
        raise UnreadableFileError(
            error.what,
            where=error.where,
            expected=error.expected
            or "a scenario file, as lagbench generate writes it",
            got=error.got,
            fix="name another file, or a split: lagbench plot cavity --size tiny",
        ) from error


def _require_folder_of(path: Path) -> None:
    """Refuse a path whose folder does not exist.

    Raises:
        UsageError: there is no such folder.
    """
    if not path.parent.is_dir():
        raise UsageError(
            "there is no such folder",
            where="--output",
            got=path.parent,
            fix="create it first",
        )


def _frame_path(file: Path, frame: int) -> Path:
    with open_recording(file) as recording:
        frame_number = recording.frame_number(frame)
    return Path(f"{_data_name(file)}-frame{frame_number}.png")


def _data_name(file: Path) -> str:
    """Return split-size-scenario where the path names them, else the file's name."""
    parts = file.absolute().parts
    # A file of a data set lies at ROOT/SPLIT/SIZE/v1/SUBSET/SCENARIO.nc.
    if len(parts) > 5 and parts[-3].startswith("v"):
        return f"{parts[-5]}-{parts[-4]}-{file.stem}"
    return file.stem
