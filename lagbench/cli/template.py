"""The command template."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from lagbench.errors import format_count
from lagbench.submission.writer import template

from .options import (
    JsonFlag,
    OverwriteFlag,
    PresentSizeOption,
    QuietFlag,
    RootOption,
    ScoredSubsetOption,
)
from .output import format_bytes, print_result


def template_command(
    split: str,
    *,
    size: PresentSizeOption = None,
    subset: ScoredSubsetOption = "test",
    output: Annotated[Path, Parameter(alias="-o")] = Path("predictions.nc"),
    overwrite: OverwriteFlag = False,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Write a valid predictions.nc for you to fill in; in it nothing moves.

    Args:
        split: Name of the split, or folder of a local one.
        output: File to write.
    """
    result = template(
        split, size, subset=subset, output=output, overwrite=overwrite, root=root
    )
    first, last = result.frames
    scenarios = format_count(len(result.scenarios), "scenario")
    fewest, most = result.particle_range
    particles = format_count(most, "particle")
    if fewest < most:
        particles = f"{fewest} to {most} particles"
    line = (
        f"{result.path}: {scenarios}, frames {first} to {last}, "
        f"{particles}, {format_bytes(result.bytes)}"
    )
    print_result(result, [line], as_json=as_json, quiet=quiet)
