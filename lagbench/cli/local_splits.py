"""The commands import and adopt, which make local splits."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from lagbench.data.box import describe_bounds
from lagbench.data.layout import parse_ids
from lagbench.errors import UsageError, format_count
from lagbench.exchange.adoption import adopt, import_split
from lagbench.exchange.local_split import LocalSplit
from lagbench.exchange.metadata import parse_kinds
from lagbench.exchange.trajectory import DataOptions, read_options

from .options import JsonFlag, OutputOption, QuietFlag
from .output import print_result, print_warning, progress_bar

DescribeOption = Annotated[
    Path | None,
    Parameter(
        help="YAML file that describes the data (docs/exchange.md); options replace "
        "its values."
    ),
]
RadiusOption = Annotated[
    float | None,
    Parameter(
        help="Connectivity radius of graph models; at most half a period of the box."
    ),
]
IntervalOption = Annotated[float | None, Parameter(help="Time between two frames.")]
BoundsOption = Annotated[
    str | None,
    Parameter(
        help="Lowest and highest position of the box along each axis, as in 0,2,0,1."
    ),
]
PeriodicOption = Annotated[
    str | None,
    Parameter(help="Axes along which the box is periodic, as in x,y; or none."),
]
RescaleFlag = Annotated[
    bool, Parameter(help="Scale positions so that they fit the unit box.")
]
InputFramesOption = Annotated[
    int | None, Parameter(help="Frames that a model is given; 6 by default.")
]
HorizonOption = Annotated[
    int | None,
    Parameter(help="Frames to predict; by default all after the given ones."),
]
InterestOption = Annotated[
    str | None,
    Parameter(
        help="Frames whose scores are shown, as in 15,25; by default the last one."
    ),
]
CellsOption = Annotated[
    int | None,
    Parameter(
        help="Cells of the score grid across a length of 1: 4 to 4096, in a unit cube "
        "to 270."
    ),
]
FullBoxFlag = Annotated[
    bool | None,
    Parameter(
        negative="--free-surface",
        help="Whether material fills the box. Then the error of the vorticity ranks, "
        "else the distance of particle clouds.",
    ),
]


def import_command(
    source: Path,
    /,
    *,
    output: Annotated[Path, Parameter(alias="-o")],
    file_format: Annotated[str | None, Parameter(name="--format")] = None,
    kinds: str | None = None,
    describe: DescribeOption = None,
    radius: RadiusOption = None,
    frame_interval: IntervalOption = None,
    bounds: BoundsOption = None,
    periodic: PeriodicOption = None,
    rescale: RescaleFlag = False,
    input_frames: InputFramesOption = None,
    horizon: HorizonOption = None,
    frames_of_interest: InterestOption = None,
    cells: CellsOption = None,
    full_box: FullBoxFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Make a local split from the data of another code base.

    You train and score models on a local split as on any other split.

    Args:
        source: Folder of train, valid, test and metadata.
        output: New folder; its last part is the split's name.
        file_format: gns-npz or lagrangebench-h5; by default the one whose files the
            folder holds.
        kinds: Material of each particle kind, as in 3=jelly; 0=drop leaves out kind 0.
    """
    options = _data_options(locals())
    with progress_bar(quiet=quiet) as progress:
        local_split = import_split(
            source,
            format=file_format,
            output=output,
            kinds=parse_kinds(kinds),
            progress=progress,
            **options,
        )
    _print_local_split(local_split, as_json=as_json, quiet=quiet)


def adopt_command(
    sources: list[Path],
    /,
    *,
    output: OutputOption = None,
    describe: DescribeOption = None,
    radius: RadiusOption = None,
    frame_interval: IntervalOption = None,
    valid: int | None = None,
    test: int | None = None,
    bounds: BoundsOption = None,
    periodic: PeriodicOption = None,
    rescale: RescaleFlag = False,
    input_frames: InputFramesOption = None,
    horizon: HorizonOption = None,
    frames_of_interest: InterestOption = None,
    cells: CellsOption = None,
    full_box: FullBoxFlag = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Make a local split from your own trajectories.

    The trajectories are NumPy arrays or netCDF files.

    Args:
        sources: .npy, .npz or .nc files, or a folder of them.
        output: New folder; its last part is the split's name.
        valid: Number of trajectories for valid; by default a tenth, and at least one.
        test: Number of trajectories for test; by default a tenth, and at least six; of
            fewer than 18 trajectories a third, and at least one.
    """
    options = _data_options(locals())
    with progress_bar(quiet=quiet) as progress:
        local_split = adopt(
            sources,
            output=output,
            valid=valid,
            test=test,
            progress=progress,
            **options,
        )
    _print_local_split(local_split, as_json=as_json, quiet=quiet)


def _data_options(parameters: Mapping[str, Any]) -> Any:  # noqa: ANN401 (a DataOptions)
    """Return the options that describe the data, those of ``--describe`` included."""
    options: dict[str, Any] = {}
    for name in DataOptions.__annotations__:
        value = parameters.get(name)
        if value is not None:
            options[name] = value
    # A flag that the user leaves out must not win over the file.
    if not options["rescale"]:
        del options["rescale"]
    if "bounds" in options:
        options["bounds"] = _parse_bounds(options["bounds"])
    if "periodic" in options:
        options["periodic"] = _parse_axes(options["periodic"])
    if "frames_of_interest" in options:
        options["frames_of_interest"] = parse_ids(
            options["frames_of_interest"], where="--frames-of-interest", noun="frame"
        )
    if parameters["describe"] is None:
        return options
    return {**read_options(parameters["describe"]), **options}


def _parse_bounds(text: str) -> tuple[tuple[float, float], ...]:
    """Return the lowest and the highest position along each axis."""
    try:
        ends = [float(part) for part in text.split(",")]
        if len(ends) not in (4, 6):
            raise ValueError
    except ValueError:
        raise UsageError(
            "bad bounds",
            where="--bounds",
            expected="x0,x1,y0,y1, as in 0,2,0,1; and z0,z1 in three dimensions",
            got=ascii(text),
            fix="give the lowest and the highest position along each axis, with commas "
            "and without blanks",
        ) from None
    return tuple(zip(ends[::2], ends[1::2], strict=True))


def _parse_axes(text: str) -> tuple[str, ...]:
    """Return the names of axes; "none" stands for no axis."""
    if text == "none":
        return ()
    return tuple(text.split(","))


def _next_steps(local_split: LocalSplit) -> Iterator[str]:
    """Yield the commands that predict with a model of the user, and that train one.

    The recipe has no options of a model, so every baseline can be trained by it. Only
    NeuralMPM needs to know the materials, if there are others than liquid.
    """
    folder = shlex.quote(f"{local_split.folder}/")
    training = "training: {steps: 2000, learning_rate: 1.0e-3, schedule: cosine}"
    name = f"{local_split.name}/{local_split.size}"
    recipe = f"{{format: 1, recipes: {{{name}: {{{training}}}}}}}"
    file = shlex.quote(f"{local_split.name}-recipe.yaml")
    yield f"  use it  lagbench template --split {folder} -o predictions.nc"
    yield "  train   lagbench has no recipe for your data; begin with this one:"
    yield f"          echo {shlex.quote(recipe)} > {file}"
    options = f"--split {folder} --recipe {file}"
    materials = ""
    if local_split.materials != (0,):
        numbers = ",".join(map(str, local_split.materials))
        materials = f" --set 'model.materials=[{numbers}]'"
    yield f"          lagbench train --baseline neuralmpm {options}{materials}"
    yield "          or a small graph network:"
    yield (
        f"          lagbench train --baseline gns {options} --set model.latent=32 "
        "--set model.layers=2"
    )
    yield "          docs/exchange.md and docs/baselines.md say more about recipes"


def _print_local_split(local_split: LocalSplit, *, as_json: bool, quiet: bool) -> None:
    counts = []
    for subset, count in local_split.scenarios.items():
        counts.append(f"{count} {subset}")
    fewest, most = local_split.particles
    particles = f"{fewest} to {most} particles"
    if fewest == most:
        particles = format_count(fewest, "particle")
    frames = format_count(local_split.frames, "frame")
    box = describe_bounds(local_split.bounds, local_split.periodic)
    given_frames = format_count(local_split.input_frames, "frame")
    lines = [
        f"{local_split.folder}: {', '.join(counts)}, {frames}, {particles}",
        f"  task    {given_frames} given, {local_split.horizon} to predict",
        f"  box     {box}",
        f"  hash    {local_split.dataset_sha256}",
        *_next_steps(local_split),
    ]
    print_result(local_split, lines, as_json=as_json, quiet=quiet)
    if not quiet:
        for note in local_split.notes:
            print_warning(note)
