"""The command submit."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from lagbench.board.entry import read_meta
from lagbench.board.folder import SHIFT, VERIFIED
from lagbench.board.submit import SubmitResult, submit

from .options import (
    DEFAULT_BOARD,
    BoardOption,
    JsonFlag,
    QuietFlag,
    RootOption,
    WorkersOption,
)
from .output import print_errors, print_result, print_warning, progress_bar


def submit_command(
    predictions: list[Path],
    /,
    *,
    source: Annotated[Path | None, Parameter(name="--from")] = None,
    method: str | None = None,
    weights: list[Path] | None = None,
    replace: bool = False,
    new_board: bool = False,
    board: BoardOption = DEFAULT_BOARD,
    root: RootOption = None,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Score predictions and add them to a leaderboard as an entry.

    The entry and its score files go into the leaderboard's folder.

    Args:
        predictions: A predictions.nc for each seed.
        source: YAML file that describes the method, see docs/submitting.md.
        method: Name of the entry, as in my-model.
        weights: Files to keep beside the entry; at most one for each seed.
        replace: Replace the entry of that name.
        new_board: Begin a leaderboard in the folder of --board.
    """
    meta = read_meta(source, method)
    with progress_bar(quiet=quiet or as_json) as progress:
        result = submit(
            predictions,
            meta,
            weights=weights or (),
            board=board,
            root=root,
            replace=replace,
            new_board=new_board,
            workers=workers,
            progress=progress,
            examined=print_errors,
        )
    print_result(result, _describe(result), as_json=as_json, quiet=quiet)


def _describe(result: SubmitResult) -> Iterator[str]:
    is_default_board = result.board == DEFAULT_BOARD
    mean = "undefined" if result.mean is None else f"{result.mean:.4g}"
    if result.std is not None:
        mean += f" ± {result.std:.2g} over seeds"
    yield f"{result.method} on {result.split} {result.size}: {result.ranking} {mean}"
    for flag in result.flags:
        yield f"flag {flag}: raised"
    if result.size == "tiny" and is_default_board:
        print_warning(
            "tiny has too few scenarios to rank anything; "
            "use it for trials: --board trial --new-board"
        )
    if not result.has_cost:
        yield (
            "no cost: for it, all predictions must state seconds_per_frame and the "
            "same device, or meta.yaml must state cost"
        )
    yield f"written: {', '.join(map(str, result.files))}"
    if result.removed:
        paths = ", ".join(map(str, result.removed))
        yield f"removed from the earlier entry: {paths}"
    if result.board / VERIFIED in result.files:
        yield (
            "the entry lost its line in verified.yaml: "
            "maintainers score it again to verify it"
        )
    if result.board / SHIFT in result.files:
        yield (
            "the entry lost its line in shift.yaml: lagbench leaderboard shift "
            "scores its models there"
        )
    board_option = ""
    if not is_default_board:
        board_option = f" --board {shlex.quote(str(result.board))}"
    yield (
        f"next: lagbench leaderboard check{board_option}; "
        f"to see the page: lagbench leaderboard build{board_option}"
    )
