"""The command download."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from lagbench.data.layout import format_ids
from lagbench.exchange.downloading import DownloadResult, download

from .options import (
    JsonFlag,
    NewSizeOption,
    QuietFlag,
    RootOption,
    ScenariosOption,
    SubsetOption,
    WorkersOption,
)
from .output import format_bytes, print_note, print_result, progress_bar


def download_command(
    split: str,
    *,
    size: NewSizeOption = None,
    mirror: Annotated[str | None, Parameter(name="--from")] = None,
    subset: SubsetOption = None,
    scenarios: ScenariosOption = None,
    root: RootOption = None,
    or_generate: Annotated[
        bool, Parameter(name="--or-generate", negative="--no-generate")
    ] = True,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Download a split and check its content; simulate missing scenarios.

    Args:
        split: Name of the split.
        mirror: Address of a store or of archives; by default the mirrors of the split.
        or_generate: Simulate scenarios that no store has; with --no-generate end with
            an error instead.
    """
    with progress_bar(quiet=quiet) as progress:
        result = download(
            split,
            size,
            mirror=mirror,
            subset=subset,
            scenarios=scenarios,
            root=root,
            or_generate=or_generate,
            workers=workers,
            progress=progress,
            announce=print_note,
            on_wait=lambda holder: print_note(f"waiting for {holder}"),
        )
    print_result(result, _describe(result), as_json=as_json, quiet=quiet)


def _describe(result: DownloadResult) -> list[str]:
    counts = (
        f"{len(result.downloaded)} downloaded, {len(result.generated)} simulated, "
        f"{len(result.kept)} kept"
    )
    lines = [
        f"{result.split} {result.size}: {counts}, {format_bytes(result.bytes)}",
        f"  folder  {result.folder}",
    ]
    if result.downloaded:
        ids = format_ids(sorted(result.downloaded))
        lines.append(f"  mirror  {result.mirror}: scenarios {ids}")
    if result.dataset_sha256:
        lines.append(f"  hash    {result.dataset_sha256}")
    lines.append(f"  check   {result.verdict}")
    return lines
