"""The command clean."""

from __future__ import annotations

from lagbench.make.clean import clean

from .options import JsonFlag, QuietFlag, RootOption
from .output import format_bytes, print_result


def clean_command(
    split: str,
    *,
    size: str | None = None,
    root: RootOption = None,
    leftovers: bool = False,
    force: bool = False,
    dry_run: bool = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Remove one data set, or only its temporary files.

    Args:
        split: Name of the split.
        size: tiny, mini or full; needed if several have data here.
        leftovers: Remove only temporary files of interrupted commands.
        force: Also remove a local split, which lagbench cannot make again.
        dry_run: Print the files without removing them.
    """
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
