"""The command bench."""

from __future__ import annotations

from cyclopts.types import PositiveInt

from lagbench.data.local import locate_new
from lagbench.errors import UsageError, format_count

from .options import JsonFlag, NewSizeOption, QuietFlag
from .output import print_result
from .solver_bench import bench_solver


def bench_command(
    split: str,
    *,
    size: NewSizeOption = None,
    frames: PositiveInt = 20,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Measure how long our solver takes for a frame on this machine.

    The result is the processor time per frame of one scenario on one core.

    Args:
        split: Name of the split.
        frames: Number of frames to time.
    """
    tier = locate_new(split, size).size
    if not tier.simulated:
        raise UsageError("a local split cannot be simulated; lagbench list shows ours")
    result = bench_solver(tier.split, tier.name, frames=frames)
    particles = format_count(result.particles, "particle")
    substeps = format_count(result.substeps, "substep")
    line = (
        f"{result.split} {result.size}: {result.seconds_per_frame:.3g} s per frame of "
        f"{particles}, {substeps}, on one core"
    )
    print_result(result, [line], as_json=as_json, quiet=quiet)
