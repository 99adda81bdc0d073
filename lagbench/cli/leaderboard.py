"""The commands of the group leaderboard: build, check, picture, show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from lagbench.atomic import write_atomically
from lagbench.board.build import build, collect
from lagbench.board.check import CheckResult, check_board
from lagbench.board.cost import picture
from lagbench.board.folder import Folder
from lagbench.board.show import choose_data_sets, tables, to_plain
from lagbench.data.local import locate_new
from lagbench.data.registry import Size
from lagbench.errors import DataError, UsageError
from lagbench.scoring.references import measured_sizes

from .options import (
    DEFAULT_BOARD,
    BoardOption,
    JsonFlag,
    NewSizeOption,
    QuietFlag,
    SplitArgument,
    SplitOption,
    accept_split,
    choose_split,
    option,
    parse_root,
)
from .output import (
    format_bytes,
    format_count,
    print_json,
    print_line,
    print_result,
    print_tables,
)
from .progress import progress_bar


def build_command(
    board: BoardOption = DEFAULT_BOARD,
    check: Annotated[
        bool, option("--check", "Write nothing; fail if the page is out of date.")
    ] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Draw the leaderboard's page: one self-contained index.html.

    The same submissions give the same bytes.
    """
    result = build(board, check=check)
    state = "up to date"
    if result.page in result.written:
        state = "written"
    entries = format_count(result.rows, "entry")
    tabs = format_count(result.tabs, "tab")
    line = f"{result.page}: {entries}, {tabs}, {format_bytes(result.bytes)}, {state}"
    print_result(result, [line], as_json=as_json, quiet=quiet)


def check_command(
    board: BoardOption = DEFAULT_BOARD,
    base: Annotated[
        str | None,
        option("--base REF", "Find changes to entries that this commit already has."),
    ] = None,
    own: Annotated[
        list[str] | None,
        option("--own METHOD", "With --base: an entry that is yours; repeatable."),
    ] = None,
    page: Annotated[
        bool, option("--page", "Compare index.html and schema.json too.")
    ] = False,
    predictions: Annotated[
        list[Path] | None,
        option("--predictions FILE", "Score an entry's predictions again; repeatable."),
    ] = None,
    recording: Annotated[
        bool,
        option(
            "--record", "With --predictions: add confirmed entries to verified.yaml."
        ),
    ] = False,
    root: Annotated[
        Path | None,
        option(
            "--root FOLDER",
            "Folder of all data sets. Without --predictions, the shipped scores of "
            "reference predictors are measured again on these data.",
            parser=parse_root,
        ),
    ] = None,
    split: Annotated[
        str | None,
        option("--split NAME", "With --root: measure on this split only."),
    ] = None,
    size: Annotated[
        str | None, option("--size NAME", "With --root: measure on this size only.")
    ] = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Check all entries, score files and aggregates of the leaderboard.

    Every pull request runs these checks.
    """
    if (split or size) and not root:
        raise UsageError(
            "--split and --size choose data to measure again",
            where="--root",
            expected="the folder of the data",
            fix="give --root as well",
        )
    sizes: Sequence[Size] = ()
    if root and not predictions:
        sizes = _sizes_to_measure(root, split, size)
    with progress_bar(quiet=quiet or as_json) as progress:
        result = check_board(
            board,
            page=page,
            base=base,
            own=own or (),
            predictions=predictions or (),
            recording=recording,
            floors=sizes,
            root=root,
            progress=progress,
        )
    if not as_json:
        for issue in result.findings:
            typer.echo(str(issue), err=True)
    lines = _describe_check(result, recording=recording)
    print_result(result, lines, as_json=as_json, quiet=quiet)
    raise typer.Exit(result.exit_code)


def _sizes_to_measure(root: Path, split: str | None, size: str | None) -> list[Size]:
    """Return the sizes whose test scenarios lie under a root folder.

    Raises:
        DataError: there are none.
    """
    sizes = measured_sizes(root, split=split, name=size)
    if not sizes:
        raise DataError(
            "no test scenarios are there",
            where=str(root),
            fix="make them with `lagbench generate`, or name another --root",
        )
    return sizes


def _describe_check(result: CheckResult, *, recording: bool) -> Iterator[str]:
    for confirmation in result.confirmed:
        precision = "exactly"
        if confirmation.difference != 0.0:
            precision = f"to {confirmation.difference:.1e}, relative"
        yield (
            f"{confirmation.predictions}: confirms {confirmation.score_file} of "
            f"{confirmation.entry} {precision}"
        )
    for data_set, predictors in result.floors.items():
        yield f"{data_set}: measured again {', '.join(predictors)}"
    for entry in result.recorded:
        yield f"recorded as verified: {entry}"
    if recording and not result.findings:
        for entry in result.partly:
            yield (
                f"not recorded: {entry}: "
                "give the predictions of all its seeds in one call"
            )

    state = "nothing wrong"
    if result.findings:
        state = format_count(len(result.findings), "finding")
    if result.page_checked:
        state += ", page compared"
    entries = format_count(result.entries, "entry")
    yield f"{result.folder}: {entries}, {state}"


@accept_split
def picture_command(
    split: str,
    size: NewSizeOption = None,
    output: Annotated[Path, option("--output -o FILE", "SVG file to write.")] = Path(
        "cost.svg"
    ),
    board: BoardOption = DEFAULT_BOARD,
    quiet: QuietFlag = False,
) -> None:
    """Draw accuracy against cost of a data set as an SVG file."""
    tier = locate_new(split, size).size
    if output.suffix.lower() != ".svg":
        raise UsageError(
            "the picture is an SVG file",
            where="--output",
            expected="a name that ends in .svg",
            got=output,
        )
    model = collect(board, only=[(tier.split, tier.name)])
    svg = picture(model, tier)
    write_atomically(output, svg.encode(), option="--output")
    print_line(str(output), quiet=quiet)


def show_command(
    split_argument: SplitArgument = None,
    split_option: SplitOption = None,
    size: Annotated[
        str | None, option("--size NAME", "tiny, mini or full; all by default.")
    ] = None,
    metric: Annotated[
        list[str] | None, option("--metric NAME", "Metric to show; repeatable.")
    ] = None,
    wide: Annotated[
        bool, option("--wide", "Show the first metrics of each data set.")
    ] = False,
    board: BoardOption = DEFAULT_BOARD,
    as_json: JsonFlag = False,
) -> None:
    """Print the tables of the leaderboard."""
    split = None
    if split_argument or split_option:
        split = choose_split(split_argument, split_option)
    data_sets = Folder(board).data_sets()
    model = collect(board, only=choose_data_sets(data_sets, split, size))
    if as_json:
        print_json(to_plain(model))
        return

    print_tables(tables(model, metric or (), wide=wide))
    if model.tabs:
        return
    if data_sets:
        print_line(
            f"{board}: all entries were scored on earlier tasks; "
            "submit predictions for the present task: lagbench submit"
        )
    else:
        print_line(
            f"{board}: no entries yet; make the first: "
            "lagbench submit predictions.nc --from meta.yaml"
        )
