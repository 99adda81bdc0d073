"""Commands that look after the installation: doctor, clean."""

from __future__ import annotations

from typing import Annotated

import typer

from .options import JsonFlag, QuietFlag, RootOption, SizeOption, SplitArgument, SplitOption, chosen
from .output import print_json, print_table, say, spell_bytes

__all__ = ["clean", "doctor"]


def doctor(root: RootOption = None, as_json: JsonFlag = False) -> None:
    """Check this machine: libraries, cores, disk, registry."""
    from lagbench.doctor import doctor as run
    from lagbench.errors import ChecksFailedError

    diagnosis = run(root)
    if as_json:
        print_json(diagnosis)
    else:
        print_table("", ("check", "state", "detail"), [(c.name, c.state, c.detail) for c in diagnosis.checks])
    if not diagnosis.healthy:
        broken = ", ".join(check.name for check in diagnosis.checks if check.state == "broken")
        raise ChecksFailedError("this machine cannot run lagbench", got=f"broken: {broken}")


def clean(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: SizeOption = "full",
    root: RootOption = None,
    leftovers: Annotated[
        bool, typer.Option("--leftovers", help="Only temporary files of killed writers.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would go.")] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Remove a generated data set, or only what killed writers left of it."""
    from lagbench.cleaning import clean as run

    result = run(chosen(name, split), size, root=root, leftovers=leftovers, dry_run=dry_run)
    if as_json:
        print_json(result)
        return
    for path in result.removed:
        say(str(path), quiet=quiet)
    word = "would be removed" if dry_run else "removed"
    say(f"{len(result.removed)} files, {spell_bytes(result.bytes)} {word}", quiet=quiet)
