"""The command generate."""

from __future__ import annotations

from pathlib import Path

from lagbench.data.drawn import drawn_registry, drawn_root
from lagbench.data.layout import format_ids, url_of
from lagbench.data.local import locate_new
from lagbench.errors import format_count, hide_credentials
from lagbench.make.generate import GenerationResult, generate

from .options import (
    DrawSeedOption,
    JsonFlag,
    NewSizeOption,
    QuietFlag,
    RootOption,
    ScenariosOption,
    SchedulerOption,
    SubsetOption,
    WorkersOption,
)
from .output import (
    format_bytes,
    format_seconds,
    print_note,
    print_result,
    progress_bar,
)


def generate_command(
    split: str,
    *,
    size: NewSizeOption = None,
    subset: SubsetOption = None,
    scenarios: ScenariosOption = None,
    root: RootOption = None,
    workers: WorkersOption = None,
    device: str = "cpu",
    scheduler: SchedulerOption = None,
    gather: list[Path] | None = None,
    dry_run: bool = False,
    draw_seed: DrawSeedOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Simulate a split and write its files.

    An interrupted call goes on where it stopped.

    Args:
        split: Name of the split.
        device: cpu, parallel (all CPU threads) or cuda.
        gather: Take finished scenarios from another root folder; repeatable.
        dry_run: Print the cost only: bytes, time, free disk.
    """
    registry = None
    folder: str | Path | None = root
    if draw_seed is not None:
        chosen = locate_new(split, size, root=root)
        size = chosen.size.name
        registry = drawn_registry(chosen.registry, split, size, draw_seed)
        folder = drawn_root(root, draw_seed)
    with progress_bar(quiet=quiet or dry_run) as progress:
        result = generate(
            split,
            size,
            subset=subset,
            scenarios=scenarios,
            root=folder,
            workers=workers,
            device=device,
            scheduler=scheduler,
            gather=gather or (),
            dry_run=dry_run,
            progress=progress,
            on_wait=lambda holder: print_note(f"waiting for {holder}"),
            registry=registry,
        )
    if result.dry_run:
        lines = _describe_plan(result)
    else:
        lines = _describe_result(result)
    print_result(result, lines, as_json=as_json, quiet=quiet)


def _describe_plan(result: GenerationResult) -> list[str]:
    needed = format_bytes(result.bytes_needed)
    free = format_bytes(result.bytes_free)
    duration = format_seconds(result.seconds_expected)
    return [
        f"{result.split} {result.size}: "
        f"{format_count(len(result.simulated), 'scenario')} to simulate, "
        f"{len(result.kept)} kept",
        f"  disk    at most {needed} ({result.bytes_needed} bytes); "
        f"{free} free in {result.root}",
        f"  time    about {duration} with {result.workers} workers",
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
        lines.append(f"  store   {hide_credentials(url)}/{folder}")
    if result.missing:
        missing_ids = format_ids(result.missing)
        lines.append(f"  missing {missing_ids}: the data set is incomplete")
    if result.dataset_sha256:
        lines.append(f"  hash    {result.dataset_sha256}")
    lines.append(f"  check   {result.verdict}")
    return lines
