"""Commands that make and check data: generate, verify."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .options import (
    DeviceOption,
    JsonFlag,
    QuietFlag,
    RootOption,
    ScenariosOption,
    SchedulerOption,
    SizeOption,
    SplitArgument,
    SplitOption,
    SubsetOption,
    WorkersOption,
    chosen,
)
from .output import print_json, print_table, say, spell_bytes, spell_seconds
from .progress import progress_bar

if TYPE_CHECKING:
    from lagbench.generation import GenerationResult
    from lagbench.verification import VerificationResult

__all__ = ["generate", "verify"]


def generate(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: SizeOption = "full",
    subset: SubsetOption = None,
    scenarios: ScenariosOption = None,
    root: RootOption = None,
    workers: WorkersOption = None,
    device: DeviceOption = "cpu",
    scheduler: SchedulerOption = None,
    gather: Annotated[
        list[Path] | None,
        typer.Option("--gather", metavar="FOLDER", help="Take what another root has finished; repeatable."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Simulate anew what is there.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what it takes: bytes, time, free disk.")
    ] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Simulate a split to files; goes on where an earlier call stopped."""
    from lagbench.generation import generate as run

    with progress_bar(quiet=quiet or dry_run) as draw:
        result = run(
            chosen(name, split),
            size,
            subset=subset,
            scenarios=scenarios,
            root=root,
            workers=workers,
            device=device,
            scheduler=scheduler,
            gather=gather or (),
            force=force,
            dry_run=dry_run,
            progress=draw,
            on_wait=lambda holder: typer.echo(f"lagbench: waiting for {holder}", err=True),
        )
    if as_json:
        print_json(result)
    else:
        say("\n".join(_generated(result)), quiet=quiet)


def _generated(result: GenerationResult) -> list[str]:
    from lagbench.scenario_ids import spell_ids
    from lagbench.working_copy import url_of

    to_do = len(result.simulated)
    if result.dry_run:
        return [
            f"{result.split} {result.size}: {to_do} scenarios to simulate, {len(result.kept)} are there",
            f"  disk    at most {spell_bytes(result.bytes_needed)} ({result.bytes_needed} bytes);"
            f" {spell_bytes(result.bytes_free)} free in {result.root}",
            f"  time    about {spell_seconds(result.seconds_expected)} with {result.workers} workers",
        ]
    lines = [
        f"{result.split} {result.size}: {to_do} scenarios simulated in {result.seconds:.1f} s,"
        f" {len(result.kept)} kept",
        f"  folder  {result.folder}",
    ]
    if (url := url_of(result.root)) is not None:
        lines.append(f"  store   {url}/{result.folder.relative_to(result.root).as_posix()}")
    if result.missing:
        lines.append(f"  missing {spell_ids(result.missing)}: the data set is incomplete")
    if result.dataset_sha256:
        lines.append(f"  hash    {result.dataset_sha256}")
    return [*lines, f"  check   {result.verdict}"]


def verify(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: SizeOption = "full",
    subset: SubsetOption = None,
    scenarios: ScenariosOption = None,
    root: RootOption = None,
    workers: WorkersOption = None,
    regenerate: Annotated[
        int, typer.Option("--regenerate", metavar="K", help="Simulate K scenarios anew and compare.", min=0)
    ] = 0,
    complete: Annotated[bool, typer.Option("--complete", help="Fail if anything is missing.")] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Hash the files of a split again and compare them with datasets.yaml."""
    from lagbench.verification import verify as run

    with progress_bar(quiet=quiet) as draw:
        result = run(
            chosen(name, split),
            size,
            subset=subset,
            scenarios=scenarios,
            root=root,
            workers=workers,
            regenerate=regenerate,
            complete=complete,
            progress=draw,
        )
    if as_json:
        print_json({**vars(result), "complete": result.complete})
    elif not quiet:
        _verified(result)
    for warning in result.warnings:
        typer.echo(f"warning: {warning}", err=True)
    result.check()


def _verified(result: VerificationResult) -> None:
    rows = [
        (r.name, r.present, len(r.missing), len(r.wrong), len(r.extra), r.verdict) for r in result.subsets
    ]
    columns = ("subset", "present", "missing", "wrong", "extra", "hash")
    print_table(f"{result.split} {result.size} in {result.folder}", columns, rows)
    if result.regenerated:
        listing = ", ".join(f"scenario {i} {word}" for i, word in result.regenerated.items())
        say(f"regenerated: {listing}")
    say(f"data set hash: {result.verdict}")
