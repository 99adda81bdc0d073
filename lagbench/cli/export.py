"""The command export."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from lagbench.data.local import locate
from lagbench.errors import format_count
from lagbench.exchange.exporting import ExportResult, export

from .options import (
    JsonFlag,
    OutputOption,
    OverwriteFlag,
    PresentSizeOption,
    QuietFlag,
    RootOption,
)
from .output import format_bytes, print_result, progress_bar


def export_command(
    split: str,
    *,
    size: PresentSizeOption = None,
    file_format: Annotated[str, Parameter(name="--format")] = "gns-npz",
    output: OutputOption = None,
    root: RootOption = None,
    overwrite: OverwriteFlag = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Write a split in the file format of another code base.

    The folder holds the subsets train, valid and test.

    Args:
        split: Name of the split, or folder of a local one.
        file_format: gns-npz, lagrangebench-h5, or vtkhdf for ParaView.
        output: Folder of the new files; by default SPLIT-SIZE-FORMAT here.
    """
    tier = locate(split, size, root=root).size
    folder = output or Path(f"{tier.split}-{tier.name}-{file_format}")
    with progress_bar(quiet=quiet) as progress:
        result = export(
            split,
            tier.name,
            format=file_format,
            output=folder,
            root=root,
            overwrite=overwrite,
            progress=progress,
        )
    print_result(result, _describe(result), as_json=as_json, quiet=quiet)


def _describe(result: ExportResult) -> list[str]:
    lines = [f"{result.split} {result.size} as {result.format} in {result.folder}"]
    for subset, count in result.trajectories.items():
        trajectories = format_count(count, "trajectory")
        frames = format_count(result.frames[subset], "frame")
        lines.append(f"  {subset:<6}{trajectories}, {frames}")
    if result.left_out:
        left_out = format_count(result.left_out, "frame")
        lines.append(
            f"  {left_out} left out: "
            "readers of this format need trajectories of equal lengths"
        )
    if result.loses_wall_motion:
        lines.append(
            "  the scenarios have wall velocities, and the files do not: the format "
            "has none"
        )
    lines.append(f"  {format_bytes(result.bytes)}")
    return lines
