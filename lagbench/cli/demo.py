"""The command that shows everything once: demo."""

from __future__ import annotations

import time

import typer

from .options import JsonFlag, QuietFlag, RootOption, WorkersOption
from .output import print_json, print_table, say
from .progress import progress_bar

__all__ = ["demo"]


def demo(
    root: RootOption = None,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Generate, verify and draw every split at size tiny: a first look in a minute."""
    from lagbench.demo import demo as run
    from lagbench.demo import demo_splits
    from lagbench.registry import load

    started = time.monotonic()
    results = {}
    for split in demo_splits(load()):
        if not quiet:
            typer.echo(f"{split}: generating, verifying, drawing", err=True)
        with progress_bar(quiet=quiet) as draw:
            results[split] = run(split, root=root, workers=workers, progress=draw)
    if as_json:
        print_json(results)
        return
    rows = [
        (split, (one.generation.dataset_sha256 or "")[:16], one.verification.verdict, one.picture)
        for split, one in results.items()
    ]
    if not quiet:
        print_table("", ("split", "hash", "data set", "picture"), rows)
    seconds = time.monotonic() - started
    say(f"{len(rows)} data sets, verified and drawn, in {seconds:.0f} s", quiet=quiet)
    say("next: lagbench generate --split cavity --size mini", quiet=quiet)
