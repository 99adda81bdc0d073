"""Commands that draw: plot, animate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from lagbench.errors import DataError, UnreadableFileError, UsageError

from .options import JsonFlag, PresentSizeOption, QuietFlag, RootOption, chosen, option
from .output import show

SourceArgument = Annotated[
    str | None, typer.Argument(metavar="SPLIT|FILE", help="Split, or a scenario file.")
]
SplitNameOption = Annotated[str | None, option("--split NAME", "The same as SPLIT.")]
ScenarioOption = Annotated[
    int | None, option("--scenario ID", "Scenario; the first of test by default.")
]
OutputOption = Annotated[
    Path | None, option("--output -o FILE", "File to write; named after the data.")
]


def _source(
    name: str | None,
    split: str | None,
    size: str | None,
    scenario: int | None,
    root: Path | None,
) -> Path:
    """Return the scenario file that a user means by its path or by split, size and
    id.
    """
    from lagbench.data.local import locate, suggest_repair
    from lagbench.store.copy import update_working_copy

    if name is not None and name.endswith(".nc"):
        return Path(name)
    tier, folder, _ = locate(chosen(name, split), size, root=root)
    if scenario is None:
        wanted = tier.subsets["test"][0]
    else:
        wanted = scenario
    subset = tier.subset_of(wanted)
    update_working_copy(tier, folder, [wanted])
    path = tier.path(folder, wanted)
    if not path.is_file():
        if scenario is None:
            option = f"--subset {subset}"
        else:
            option = f"--scenarios {wanted}"
        raise DataError(
            f"scenario {wanted} is not there",
            where=str(path),
            fix=suggest_repair(tier, option, root=folder),
        )
    return path


@contextmanager
def _told_as_given(*names: str | None) -> Iterator[None]:
    """Call what is wrong with a file that the user named an unreadable file, no damaged
    data set.
    """
    try:
        yield
    except DataError as error:
        if not any(
            name and (error.where or "").startswith(str(Path(name))) for name in names
        ):
            raise
        raise UnreadableFileError(
            error.what,
            where=error.where,
            expected=error.expected
            or "a scenario file, as lagbench generate writes it",
            got=error.got,
            fix="name another file, or a split: lagbench plot cavity --size tiny",
        ) from error


def _target(path: Path) -> Path:
    """Return the path of a file to write, whose folder must be there."""
    if not path.parent.is_dir():
        raise UsageError(
            "there is no such folder",
            where="--output",
            got=path.parent,
            fix="create it first",
        )
    return path


def _default_name(source: Path, ending: str) -> Path:
    """Return a file name in this folder: split-size-scenario where the path tells
    them.
    """
    parts = source.absolute().parts
    named = len(parts) > 5 and parts[-3].startswith("v")
    words = (parts[-5], parts[-4], source.stem) if named else (source.stem,)
    return Path("-".join(words) + ending)


def plot(
    name: SourceArgument = None,
    split: SplitNameOption = None,
    size: PresentSizeOption = None,
    scenario: ScenarioOption = None,
    frame: Annotated[
        int, option("--frame", "Frame number; negative ones from the end.")
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
            "--dpi", "Pixels per inch of PNG, and of clouds in PDF.", min=32, max=1200
        ),
    ] = 128,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Draw one frame of a scenario: particles, vorticity, streamlines."""
    from lagbench.data.local import locate
    from lagbench.figures.plot import check_kind, contact_sheet, plot_frame
    from lagbench.figures.recording import open_recording

    if sheet:
        chosen_split = chosen(name, split)
        tier = locate(chosen_split, size, root=root).size
        page = _target(output or Path(f"{tier.split}-{tier.name}-sheet.png"))
        drawn = contact_sheet(chosen_split, tier.name, page, root=root, dpi=dpi)
        show({"output": drawn}, [str(drawn)], as_json=as_json, quiet=quiet)
        return
    check_kind(kind)
    source = _source(name, split, size, scenario, root)
    with _told_as_given(name):
        if output is None:
            with open_recording(source) as recording:
                output = _default_name(
                    source, f"-frame{recording.frame_number(frame)}.png"
                )
        target = _target(output)
        plot_frame(source, frame, target, kind=kind, dpi=dpi)
    show({"output": target}, [str(target)], as_json=as_json, quiet=quiet)


def animate(
    name: SourceArgument = None,
    second: Annotated[
        str | None,
        typer.Argument(
            metavar="FILE", help="Second scenario file, drawn beside the first."
        ),
    ] = None,
    split: SplitNameOption = None,
    size: PresentSizeOption = None,
    scenario: ScenarioOption = None,
    beside: Annotated[
        int | None, option("--beside ID", "Second scenario of the split.")
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
    """Turn a scenario into an MP4 or GIF film; two scenarios stand side by side."""
    from lagbench.figures.animate import animate as run
    from lagbench.figures.animate import check_ending

    if output is not None:
        check_ending(output)
    source = _source(name, split, size, scenario, root)
    if second:
        other = Path(second)
    else:
        other = None
    if beside is not None:
        other = _source(name, split, size, beside, root)
    target = _target(output or _default_name(source, ".mp4"))
    hidden = quiet or as_json
    with _told_as_given(name, second):
        run(
            source,
            target,
            beside=other,
            kind=kind,
            frames_per_second=fps,
            every=every,
            quiet=hidden,
        )
    show({"output": target}, [str(target)], as_json=as_json, quiet=quiet)
