"""The command import, which makes local splits."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from lagbench.data.box import describe_bounds
from lagbench.errors import UsageError, format_count
from lagbench.exchange.adoption import adopt
from lagbench.exchange.local_split import LocalSplit

from .options import JsonFlag, QuietFlag
from .output import print_result, print_warning, progress_bar


def import_command(
    sources: list[Path],
    /,
    *,
    output: Annotated[Path, Parameter(alias="-o")],
    axes: str | None = None,
    positions: str | None = None,
    kinds: str | None = None,
    radius: float | None = None,
    frame_interval: float | None = None,
    spacing: float | None = None,
    bounds: str | None = None,
    periodic: str | None = None,
    rescale: Annotated[bool, Parameter(negative="--no-rescale")] = True,
    input_frames: int | None = None,
    horizon: int | None = None,
    full_box: Annotated[bool | None, Parameter(negative="--free-surface")] = None,
    valid: int | None = None,
    test: int | None = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Make a local split from trajectories of other programs or code bases.

    You train and score models on a local split as on any other split.

    Args:
        sources: Files or folders of trajectories, or a folder of train, valid and test.
        output: New folder; its last part is the split's name.
        axes: Axes of arrays without names, as in particle,frame,space; by default
            frame,particle,space.
        positions: Name of the positions; in HDF5 GROUP/NAME, where * is any name.
        kinds: Material of each particle kind, as in 3=jelly,1=wall,0=drop.
        radius: Connectivity radius of graph models; two spacings by default.
        frame_interval: Time between two frames [s], where the files do not state it.
        spacing: Distance of neighbouring particles at first; measured by default.
        bounds: Lowest and highest position of the box along each axis, as in 0,2,0,1.
        periodic: Axes along which the box is periodic, as in x,y; or none.
        rescale: Scale positions by a power of two where they do not fit the unit box.
        input_frames: Frames that a model is given; 6 by default.
        horizon: Frames to predict; by default all after the given ones.
        full_box: Whether material fills the box. Then the error of the vorticity ranks,
            else the distance of particle clouds.
        valid: Trajectories for valid; by default a tenth, and at least one.
        test: Trajectories for test; by default a tenth, and at least six; of fewer than
            18 trajectories a third, and at least one.
    """
    options = {
        "radius": radius,
        "frame_interval": frame_interval,
        "spacing": spacing,
        "bounds": _parse_bounds(bounds),
        "periodic": () if periodic == "none" else periodic and periodic.split(","),
        "rescale": rescale,
        "input_frames": input_frames,
        "horizon": horizon,
        "full_box": full_box,
    }
    with progress_bar(quiet=quiet) as progress:
        local_split = adopt(
            sources,
            output=output,
            axes=axes or (),
            positions=positions,
            kinds=kinds,
            valid=valid,
            test=test,
            progress=progress,
            **{name: value for name, value in options.items() if value is not None},
        )
    _print_local_split(local_split, as_json=as_json, quiet=quiet)


def _parse_bounds(text: str | None) -> list[list[float]] | None:
    """Return the lowest and the highest position along each axis."""
    if text is None:
        return None
    try:
        ends = [float(part) for part in text.split(",")]
        if len(ends) not in (4, 6):
            raise ValueError
    except ValueError:
        raise UsageError(
            f"--bounds: {text!r} has another form; give x0,x1,y0,y1 (and z0,z1), as in "
            "--bounds 0,2,0,1"
        ) from None
    return [ends[start : start + 2] for start in range(0, len(ends), 2)]


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
        f"  time    {local_split.frame_interval:.6g} s between frames, "
        f"from {local_split.interval_source}",
        f"  box     {box}",
        f"  hash    {local_split.dataset_sha256}",
        *_next_steps(local_split),
    ]
    print_result(local_split, lines, as_json=as_json, quiet=quiet)
    if not quiet:
        for note in local_split.notes:
            print_warning(note)
