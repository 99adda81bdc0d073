"""The command clean."""

from __future__ import annotations

from typing import Annotated

from lagbench.make.clean import clean

from .options import (
    JsonFlag,
    QuietFlag,
    RootOption,
    accept_split,
    option,
)
from .output import format_bytes, print_result

RemovedSizeOption = Annotated[
    str | None,
    option("--size NAME", "tiny, mini or full; needed if several have data here."),
]


@accept_split
def clean_command(
    split: str,
    size: RemovedSizeOption = None,
    root: RootOption = None,
    leftovers: Annotated[
        bool,
        option("--leftovers", "Remove only temporary files of interrupted commands."),
    ] = False,
    force: Annotated[
        bool,
        option(
            "--force", "Also remove a local split, which lagbench cannot make again."
        ),
    ] = False,
    dry_run: Annotated[
        bool, option("--dry-run", "Print the files without removing them.")
    ] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Remove one data set, or only its temporary files."""
    result = clean(
        split, size, root=root, leftovers=leftovers, force=force, dry_run=dry_run
    )
    action = "removed"
    if dry_run:
        action = "would be removed"
    total_size = format_bytes(result.bytes)
    lines = [str(path) for path in result.removed]
    lines.append(f"{len(result.removed)} files, {total_size} {action}")
    print_result(result, lines, as_json=as_json, quiet=quiet)
