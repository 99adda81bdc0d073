"""The command verify."""

from __future__ import annotations

from cyclopts.types import NonNegativeInt

from lagbench.make.verify import VerificationResult, verify

from .options import (
    JsonFlag,
    PresentSizeOption,
    QuietFlag,
    RootOption,
    ScenariosOption,
    SubsetOption,
    WorkersOption,
)
from .output import print_json, print_line, print_table, print_warning, progress_bar


def verify_command(
    split: str,
    *,
    size: PresentSizeOption = None,
    subset: SubsetOption = None,
    scenarios: ScenariosOption = None,
    root: RootOption = None,
    workers: WorkersOption = None,
    regenerate: NonNegativeInt = 0,
    complete: bool = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Hash the files of a split and compare them with the recorded hashes.

    Args:
        split: Name of the split, or folder of a local one.
        regenerate: Simulate so many scenarios again and compare them with the files.
        complete: Fail if a scenario is missing.
    """
    with progress_bar(quiet=quiet) as progress:
        result = verify(
            split,
            size,
            subset=subset,
            scenarios=scenarios,
            root=root,
            workers=workers,
            regenerate=regenerate,
            complete=complete,
            progress=progress,
        )
    if as_json:
        print_json({**vars(result), "complete": result.complete})
    elif not quiet:
        _print_verification(result)
    for warning in result.warnings:
        print_warning(warning)
    result.check()


def _print_verification(result: VerificationResult) -> None:
    rows = []
    for subset in result.subsets:
        row = (
            subset.name,
            subset.present,
            len(subset.missing),
            len(subset.wrong),
            len(subset.extra),
            subset.verdict,
        )
        rows.append(row)
    title = f"{result.split} {result.size} in {result.folder}"
    columns = ("subset", "present", "missing", "wrong", "extra", "hash")
    print_table(title, columns, rows)

    if result.regenerated:
        outcomes = []
        for scenario, outcome in result.regenerated.items():
            outcomes.append(f"scenario {scenario} {outcome}")
        print_line(f"regenerated: {', '.join(outcomes)}")
    print_line(f"data set hash: {result.verdict}")
