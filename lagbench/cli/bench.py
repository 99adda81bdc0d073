"""The command bench."""

from __future__ import annotations

from typing import Annotated

import typer

from lagbench.data.local import locate_new
from lagbench.errors import UsageError, format_count

from .options import (
    JsonFlag,
    NewSizeOption,
    QuietFlag,
    SplitOption,
    choose_split,
    option,
)
from .output import print_result
from .solver_bench import bench_solver


def bench_command(
    subject: Annotated[
        str, typer.Argument(metavar="WHAT", help="What to measure: solver.")
    ],
    split: SplitOption = None,
    size: NewSizeOption = None,
    frames: Annotated[
        int, option("--frames N", "Number of frames to time.", min=1)
    ] = 20,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Measure how long our solver takes for a frame on this machine.

    The result is the processor time per frame of one scenario on one core.
    """
    if subject != "solver":
        raise UsageError(
            "there is no such bench",
            where="WHAT",
            expected="solver",
            got=subject,
            fix="lagbench bench solver",
        )
    tier = locate_new(choose_split(None, split), size).size
    if not tier.simulated:
        raise UsageError(
            "a local split cannot be simulated",
            where="--split",
            expected="a split that a generator makes",
            got=tier.split,
            fix="name a split of ours; `lagbench list` shows them",
        )
    result = bench_solver(tier.split, tier.name, frames=frames)
    particles = format_count(result.particles, "particle")
    substeps = format_count(result.substeps, "substep")
    line = (
        f"{result.split} {result.size}: {result.seconds_per_frame:.3g} s per frame of "
        f"{particles}, {substeps}, on one core"
    )
    print_result(result, [line], as_json=as_json, quiet=quiet)
