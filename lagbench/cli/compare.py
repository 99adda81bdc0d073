"""The command compare."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from lagbench.scoring.compare import compare, comparison_lines, comparison_tables

from .options import (
    ExpectedSplitOption,
    FoundBoardOption,
    JsonFlag,
    QuietFlag,
    RootOption,
    WorkersOption,
)
from .output import print_json, print_line, print_tables


def compare_command(
    first: str,
    second: str,
    /,
    *,
    metric: list[str] | None = None,
    split: ExpectedSplitOption = None,
    board: FoundBoardOption = None,
    root: RootOption = None,
    workers: WorkersOption = None,
    every: Annotated[bool, Parameter(name="--all")] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Compare two methods with statistical tests and confidence intervals.

    The comparison runs over the test scenarios, and over seeds where there are several.

    Args:
        first: A predictions.nc, scores.json or scores.nc; or a folder of the scores of
            one method, with one or several seeds; or an entry of the leaderboard, as in
            cavity/mini/gns.
        second: The same, or the name of a reference predictor (of a local split any
            beside a predictions.nc, else the best one).
        metric: Metric to compare by; repeatable.
        every: Show every metric.
    """
    result = compare(
        first,
        second,
        metrics=metric or (),
        split=split,
        board=board,
        root=root,
        workers=workers,
    )
    if as_json:
        print_json(result.as_json())
    elif not quiet:
        if result.namesakes:
            print_line(f"{result.first}: {first}")
            print_line(f"{result.second}: {second}")
        every = every or bool(metric)
        print_tables(comparison_tables(result, every=every))
        for line in comparison_lines(result, every=every):
            print_line(line)
        print_line(result.verdict)
