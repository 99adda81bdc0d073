"""The command that shows everything once: demo."""

from __future__ import annotations

import time

import typer

from .options import QuietFlag, RootOption, WorkersOption
from .output import print_table, say
from .progress import progress_bar

__all__ = ["demo"]


def demo(root: RootOption = None, workers: WorkersOption = None, quiet: QuietFlag = False) -> None:
    """Generate, verify and draw the four splits at size tiny: a first look in a minute."""
    from lagbench.demo import demo as run
    from lagbench.registry import load

    started = time.monotonic()
    rows = []
    for split in load().splits:
        typer.echo(f"{split}: generating, verifying, drawing", err=True)
        with progress_bar(quiet=quiet) as draw:
            result = run(split, root=root, workers=workers, progress=draw)
        rows.append(
            (
                split,
                (result.generation.dataset_sha256 or "")[:16],
                result.verification.verdict,
                result.picture,
            )
        )
    if not quiet:
        print_table("", ("split", "hash", "data set", "picture"), rows)
    say(f"four data sets, verified and drawn, in {time.monotonic() - started:.0f} s", quiet=quiet)
    say("next: lagbench generate --split cavity --size mini", quiet=quiet)
