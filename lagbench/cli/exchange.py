"""Commands that bring data in and out: download, export, import, adopt."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lagbench.errors import UsageError

from .options import (
    JsonFlag,
    NewSizeOption,
    PresentSizeOption,
    QuietFlag,
    RootOption,
    ScenariosOption,
    SplitArgument,
    SplitOption,
    SubsetOption,
    WorkersOption,
    chosen,
    option,
)
from .output import progress_bar, show, spell_bytes

if TYPE_CHECKING:
    from lagbench.exchange.local_split import LocalSplit

FormatOption = Annotated[str, option("--format NAME", "gns-npz or lagrangebench-h5.")]
FolderOption = Annotated[
    Path, option("--output -o FOLDER", "Folder to make; its last part names the split.")
]
DescribeOption = Annotated[
    Path | None,
    option(
        "--describe FILE",
        "YAML that says what the data are, see docs/exchange.md; options win.",
    ),
]
RadiusOption = Annotated[
    float | None, option("--radius LENGTH", "Connectivity radius of graph models.")
]
IntervalOption = Annotated[
    float | None, option("--frame-interval SECONDS", "Time between frames.")
]
BoundsOption = Annotated[
    str | None, option("--bounds X0,X1,Y0,Y1", "Walls of the box.")
]
RescaleFlag = Annotated[
    bool, option("--rescale", "Fit the bounds into the unit box, by a power of two.")
]
InputFramesOption = Annotated[
    int | None, option("--input-frames N", "Frames given to a model; 6 by default.")
]
HorizonOption = Annotated[
    int | None, option("--horizon N", "Frames to predict; all by default.")
]
InterestOption = Annotated[
    str | None,
    option("--frames-of-interest FRAMES", "As in 15,25; the last one by default."),
]
CellsOption = Annotated[
    int | None, option("--cells N", "Cells across of the score grid.")
]
FullBoxFlag = Annotated[
    bool | None,
    option(
        "--full-box/--free-surface",
        "Whether material fills the box: vorticity ranks then.",
    ),
]


def download(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: NewSizeOption = None,
    mirror: Annotated[
        str | None, option("--from URL", "Store or folder of archives; else mirrors.")
    ] = None,
    subset: SubsetOption = None,
    scenarios: ScenariosOption = None,
    root: RootOption = None,
    connections: Annotated[
        int, option("--connections N", "Files fetched side by side.", min=1)
    ] = 4,
    or_generate: Annotated[
        bool,
        option(
            "--or-generate/--no-generate", "Simulate what no store has, or stop there."
        ),
    ] = True,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Fetch a split from a store and check its content; simulate what no store has."""
    from lagbench.data.registry import format_ids
    from lagbench.exchange.downloading import download as run

    with progress_bar(quiet=quiet) as draw:
        result = run(
            chosen(name, split),
            size,
            mirror=mirror,
            subset=subset,
            scenarios=scenarios,
            root=root,
            connections=connections,
            or_generate=or_generate,
            workers=workers,
            progress=draw,
            announce=lambda text: typer.echo(f"lagbench: {text}", err=True),
            on_wait=lambda holder: typer.echo(
                f"lagbench: waiting for {holder}", err=True
            ),
        )
    counts = f"{len(result.downloaded)} downloaded, {len(result.generated)} simulated, {len(result.kept)} kept"
    what = f"{result.split} {result.size}: {counts}, {spell_bytes(result.bytes)}"
    words = [what, f"  folder  {result.folder}"]
    if result.downloaded:
        words.append(
            f"  mirror  {result.mirror}: scenarios "
            f"{format_ids(sorted(result.downloaded))}"
        )
    if result.dataset_sha256:
        words.append(f"  hash    {result.dataset_sha256}")
    show(result, [*words, f"  check   {result.verdict}"], as_json=as_json, quiet=quiet)


def export(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: PresentSizeOption = None,
    form: FormatOption = "gns-npz",
    output: Annotated[
        Path | None,
        option("--output -o FOLDER", "Folder for the files; SPLIT-SIZE-FORMAT here."),
    ] = None,
    root: RootOption = None,
    from_walls: Annotated[
        bool | None,
        option(
            "--from-walls/--unit-box",
            "lagrangebench-h5: measure positions from the lower walls; closed boxes "
            "do by default.",
        ),
    ] = None,
    wall_particles: Annotated[
        bool,
        option(
            "--wall-particles",
            "Closed boxes: add particles that move along with the walls.",
        ),
    ] = False,
    force: Annotated[bool, option("--force", "Write over an earlier export.")] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Write a split in the format of another code base: train, valid, test,
    metadata.
    """
    from lagbench.data.local import locate
    from lagbench.exchange.exporting import export as run

    wanted = chosen(name, split)
    size = locate(wanted, size, root=root).size.name
    folder = output or Path(f"{Path(wanted).name}-{size}-{form}")
    with progress_bar(quiet=quiet) as draw:
        result = run(
            wanted,
            size,
            format=form,
            output=folder,
            root=root,
            from_walls=from_walls,
            wall_particles=wall_particles,
            force=force,
            progress=draw,
        )
    words = [f"{result.split} {result.size} as {result.format} in {result.folder}"]
    for name, count in result.trajectories.items():
        words.append(f"  {name:<6}{count} trajectories, {result.frames[name]} frames")
    if result.left_out:
        words.append(
            f"  {result.left_out} frames left out: readers of this format want "
            f"equal lengths"
        )
    show(
        result, [*words, f"  {spell_bytes(result.bytes)}"], as_json=as_json, quiet=quiet
    )


def import_split(
    ctx: typer.Context,
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="Folder of train, valid, test, metadata."
        ),
    ],
    form: FormatOption,
    output: FolderOption,
    kinds: Annotated[
        str | None,
        option("--kinds LIST", "Material of kinds of particles, as in 3=jelly,0=drop."),
    ] = None,
    describe: DescribeOption = None,
    radius: RadiusOption = None,
    frame_interval: IntervalOption = None,
    bounds: BoundsOption = None,
    rescale: RescaleFlag = False,
    input_frames: InputFramesOption = None,
    horizon: HorizonOption = None,
    frames_of_interest: InterestOption = None,
    cells: CellsOption = None,
    full_box: FullBoxFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Make a local split of another code base's data, to train on and to score."""
    from lagbench.exchange.adoption import import_split as run
    from lagbench.exchange.metadata import parse_kinds

    with progress_bar(quiet=quiet) as draw:
        made = run(
            source,
            format=form,
            output=output,
            kinds=parse_kinds(kinds),
            progress=draw,
            **_wishes(ctx),
        )
    _made(made, as_json=as_json, quiet=quiet)


def adopt(
    ctx: typer.Context,
    sources: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", help=".npy, .npz or .nc files, or a folder of them."
        ),
    ],
    output: FolderOption,
    describe: DescribeOption = None,
    radius: RadiusOption = None,
    frame_interval: IntervalOption = None,
    valid: Annotated[
        int | None, option("--valid N", "Trajectories for valid; a tenth by default.")
    ] = None,
    test: Annotated[
        int | None, option("--test N", "Trajectories for test; a tenth by default.")
    ] = None,
    bounds: BoundsOption = None,
    rescale: RescaleFlag = False,
    input_frames: InputFramesOption = None,
    horizon: HorizonOption = None,
    frames_of_interest: InterestOption = None,
    cells: CellsOption = None,
    full_box: FullBoxFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Make a local split of your own trajectories: arrays or netCDF files."""
    from lagbench.exchange.adoption import adopt as run

    with progress_bar(quiet=quiet) as draw:
        made = run(
            sources,
            output=output,
            valid=valid,
            test=test,
            progress=draw,
            **_wishes(ctx),
        )
    _made(made, as_json=as_json, quiet=quiet)


def _wishes(ctx: typer.Context) -> Any:  # noqa: ANN401 (the functions type them)
    """Return what a user says of the data: a file, and the options that import and
    adopt share.
    """
    from lagbench.data.registry import parse_ids
    from lagbench.exchange.trajectory import DataOptions, read_options

    file = ctx.params["describe"]
    said = {
        n: v
        for n, v in ctx.params.items()
        if n in DataOptions.__annotations__ and v is not None
    }
    if not said["rescale"]:  # a flag that is not given says nothing
        del said["rescale"]
    if "bounds" in said:
        try:
            left, right, bottom, top = (
                float(part) for part in said["bounds"].split(",")
            )
        except ValueError:
            expected = "x0,x1,y0,y1, as in 0,2,0,1"
            raise UsageError(
                "bad bounds", where="--bounds", expected=expected, got=said["bounds"]
            ) from None
        said["bounds"] = (left, right), (bottom, top)
    if "frames_of_interest" in said:
        given = said["frames_of_interest"]
        said["frames_of_interest"] = parse_ids(
            given, where="--frames-of-interest", noun="frame"
        )
    if file is None:
        return said
    return {**read_options(file), **said}


def _made(made: LocalSplit, *, as_json: bool, quiet: bool) -> None:
    counts = ", ".join(f"{count} {subset}" for subset, count in made.scenarios.items())
    fewest, most = made.particles
    if fewest == most:
        span = f"{fewest}"
    else:
        span = f"{fewest} to {most}"
    words = [
        f"{made.folder}: {counts}, {made.frames} frames, {span} particles",
        f"  task    {made.input_frames} frames given, {made.horizon} to predict",
        f"  hash    {made.dataset_sha256}",
        f"  use it  lagbench template --split {made.folder}/",
    ]
    show(made, words, as_json=as_json, quiet=quiet)
    for note in made.notes:
        typer.echo(f"warning: {note}", err=True)
