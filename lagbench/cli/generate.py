"""The command generate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from lagbench.data.layout import url_of
from lagbench.data.registry import format_ids
from lagbench.errors import format_count
from lagbench.make.generate import GenerationResult, generate

from .options import (
    JsonFlag,
    NewSizeOption,
    QuietFlag,
    RootOption,
    ScenariosOption,
    SchedulerOption,
    SubsetOption,
    WorkersOption,
    accept_split,
    option,
)
from .output import format_bytes, format_seconds, print_note, print_result
from .progress import progress_bar


@accept_split
def generate_command(
    split: str,
    size: NewSizeOption = None,
    subset: SubsetOption = None,
    scenarios: ScenariosOption = None,
    root: RootOption = None,
    workers: WorkersOption = None,
    device: Annotated[
        str, option("--device NAME", "cpu, parallel (all CPU threads) or cuda.")
    ] = "cpu",
    scheduler: SchedulerOption = None,
    gather: Annotated[
        list[Path] | None,
        option(
            "--gather FOLDER",
            "Take finished scenarios from another root; repeatable.",
        ),
    ] = None,
    force: Annotated[
        bool, option("--force", "Simulate finished scenarios again.")
    ] = False,
    dry_run: Annotated[
        bool, option("--dry-run", "Print the cost only: bytes, time, free disk.")
    ] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Simulate a split and write its files.

    An interrupted call goes on where it stopped.
    """
    with progress_bar(quiet=quiet or dry_run) as progress:
        result = generate(
            split,
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
            progress=progress,
            on_wait=lambda holder: print_note(f"waiting for {holder}"),
        )
    if result.dry_run:
        lines = _describe_plan(result)
    else:
        lines = _describe_result(result)
    print_result(result, lines, as_json=as_json, quiet=quiet)


def _describe_plan(result: GenerationResult) -> list[str]:
    if result.measured:
        source = "at the rate measured here"
    else:
        source = "estimated; measured after the first generate"
    needed = format_bytes(result.bytes_needed)
    free = format_bytes(result.bytes_free)
    duration = format_seconds(result.seconds_expected)
    return [
        f"{result.split} {result.size}: "
        f"{format_count(len(result.simulated), 'scenario')} to simulate, "
        f"{len(result.kept)} kept",
        f"  disk    at most {needed} ({result.bytes_needed} bytes); "
        f"{free} free in {result.root}",
        f"  time    about {duration} with {result.workers} workers ({source})",
    ]


def _describe_result(result: GenerationResult) -> list[str]:
    duration = f"{result.seconds:.1f} s"
    simulated_count = len(result.simulated)
    kept_count = len(result.kept)
    if simulated_count:
        simulated = format_count(simulated_count, "scenario")
        work = f"{simulated} simulated in {duration}, {kept_count} kept"
    else:
        work = (
            f"nothing to simulate, {format_count(kept_count, 'scenario')} kept; "
            f"checked in {duration}"
        )
    lines = [
        f"{result.split} {result.size}: {work}",
        f"  folder  {result.folder}",
    ]
    url = url_of(result.root)
    if url is not None:
        folder = result.folder.relative_to(result.root).as_posix()
        lines.append(f"  store   {url}/{folder}")
    if result.missing:
        missing_ids = format_ids(result.missing)
        lines.append(f"  missing {missing_ids}: the data set is incomplete")
    if result.dataset_sha256:
        lines.append(f"  hash    {result.dataset_sha256}")
    lines.append(f"  check   {result.verdict}")
    return lines
