"""Commands around the leaderboard: submit; leaderboard build, check, show."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lagbench.errors import DataError, UsageError

from .options import (
    JsonFlag,
    NewSizeOption,
    QuietFlag,
    RootOption,
    SplitArgument,
    SplitOption,
    WorkersOption,
    chosen,
    option,
    root_of,
)
from .output import (
    complain,
    counted,
    print_blocks,
    print_json,
    progress_bar,
    say,
    spell_bytes,
)
from .output import show as tell

if TYPE_CHECKING:
    from lagbench.board.check import CheckResult
    from lagbench.board.publish import SubmitResult

BoardOption = Annotated[Path, option("--board FOLDER", "The leaderboard's folder.")]
BOARD = Path("leaderboard")


def submit(
    predictions: Annotated[
        list[Path],
        typer.Argument(metavar="FILE...", help="A predictions.nc; one per seed."),
    ],
    source: Annotated[
        Path | None,
        option(
            "--from FILE",
            "YAML that describes the method, see docs/submitting.md; options win.",
        ),
    ] = None,
    method: Annotated[
        str | None, option("--method ID", "Names the entry, as in my-model.")
    ] = None,
    authors: Annotated[list[str] | None, option("--author NAME", "Repeatable.")] = None,
    command: Annotated[
        str | None, option("--command TEXT", "What makes the predictions again.")
    ] = None,
    urls: Annotated[
        list[str] | None, option("--url URL", "Where FILE can be had; one per FILE.")
    ] = None,
    weights: Annotated[
        list[Path] | None,
        option(
            "--weights FILE", "weights.pt to keep beside the entry; at most one a seed."
        ),
    ] = None,
    replace: Annotated[
        bool, option("--replace", "Replace the entry of that name.")
    ] = False,
    add: Annotated[
        bool, option("--add", "Add seeds to the entry of that name; its others stay.")
    ] = False,
    new_board: Annotated[
        bool,
        option("--new-board", "Begin a leaderboard in --board, where there is none."),
    ] = False,
    board: BoardOption = BOARD,
    root: RootOption = None,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Score predictions and write their entry and score files into the leaderboard's
    folder.
    """
    from lagbench.board.entry_file import read_meta
    from lagbench.board.submit import submit as run

    meta = read_meta(
        source, {"method": method, "authors": authors, "command": command, "urls": urls}
    )
    with progress_bar(quiet=quiet or as_json) as draw:
        result = run(
            predictions,
            meta,
            weights=weights or (),
            board=board,
            root=root,
            replace=replace,
            add=add,
            new_board=new_board,
            workers=workers,
            progress=draw,
            examined=complain,
        )
    tell(result, _submitted(result), as_json=as_json, quiet=quiet)


def _submitted(result: SubmitResult) -> Iterator[str]:
    from lagbench.board.folder import VERIFIED

    if result.mean is None:
        mean = "undefined"
    else:
        mean = f"{result.mean:.4g}"
    if result.std is None:
        spread = ""
    else:
        spread = f" ± {result.std:.2g} over seeds"
    yield f"{result.method} on {result.split} {result.size}: {result.ranking} {mean}{spread}"
    yield from (f"flag {flag}: raised" for flag in result.flags)
    if result.size == "tiny" and result.board == BOARD:
        advice = "it is for trying out: --board trial --new-board"
        typer.echo(
            f"warning: tiny has too few scenarios to rank anything; {advice}", err=True
        )
    yield "written: " + ", ".join(map(str, result.files))
    for what, paths in {"kept": result.kept, "removed": result.removed}.items():
        if paths:
            yield f"{what}, of the entry before: " + ", ".join(map(str, paths))
    if result.board / VERIFIED in result.files:
        yield "its line of verified.yaml is gone: maintainers score the entry again"
    if result.board == BOARD:
        where = ""
    else:
        where = f" --board {result.board}"
    yield f"next: lagbench leaderboard check{where}; to look at it: lagbench leaderboard build{where}"


leaderboard = typer.Typer(
    no_args_is_help=True, help="Draw, check and show the leaderboard."
)


@leaderboard.command("build", epilog="Example: lagbench leaderboard build")
def build(
    board: BoardOption = BOARD,
    check: Annotated[
        bool, option("--check", "Write nothing; fail where the page is stale.")
    ] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Draw the page: one self-contained index.html; the same submissions give the same
    bytes.
    """
    from lagbench.board.build import build as run

    result = run(board, check=check)
    if result.page in result.written:
        state = "written"
    else:
        state = "up to date"
    what = f"{counted(result.rows, 'entry')}, {counted(result.tabs, 'tab')}, {spell_bytes(result.bytes)}"
    tell(result, [f"{result.page}: {what}, {state}"], as_json=as_json, quiet=quiet)


@leaderboard.command(
    "check", epilog="Example: lagbench leaderboard check --base origin/main"
)
def check(
    board: BoardOption = BOARD,
    base: Annotated[
        str | None,
        option(
            "--base REF", "Find what the folder alters of entries that this commit has."
        ),
    ] = None,
    own: Annotated[
        list[str] | None,
        option("--own METHOD", "With --base: an entry of yours; repeatable."),
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
            "--record", "With --predictions: note what is confirmed in verified.yaml."
        ),
    ] = False,
    root: Annotated[
        Path | None,
        option(
            "--root FOLDER",
            "Where data sets live; without --predictions the shipped floors of those "
            "there are measured"
            " again.",
            parser=root_of,
        ),
    ] = None,
    split: Annotated[
        str | None, option("--split NAME", "With --root: floors of this split only.")
    ] = None,
    size: Annotated[
        str | None, option("--size NAME", "With --root: floors of this size only.")
    ] = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Check entries, score files and every aggregate; for every pull request."""
    from lagbench.board.check import check_board
    from lagbench.scoring.references import measured_sizes

    if (split or size) and not root:
        raise UsageError(
            "--split and --size say whose floors are measured again",
            fix="give --root as well",
        )
    if root and not predictions:
        sizes = measured_sizes(root, split=split, name=size)
    else:
        sizes = []
    if root and not predictions and not sizes:
        fix = "make them with `lagbench generate`, or name another --root"
        raise DataError("no test scenarios are there", where=str(root), fix=fix)
    with progress_bar(quiet=quiet or as_json) as draw:
        result = check_board(
            board,
            page=page,
            base=base,
            own=own or (),
            predictions=predictions or (),
            recording=recording,
            floors=sizes,
            root=root,
            progress=draw,
        )
    for finding in () if as_json else result.findings:
        typer.echo(str(finding), err=True)
    tell(result, _checked(result, recording=recording), as_json=as_json, quiet=quiet)
    raise typer.Exit(result.exit_code)


def _checked(result: CheckResult, *, recording: bool) -> Iterator[str]:
    for one in result.confirmed:
        if one.difference == 0.0:
            close = "exactly"
        else:
            close = f"to {one.difference:.1e}, relative"
        yield f"{one.predictions}: confirms {one.score_file} of {one.entry} {close}"
    yield from (
        f"{name}: measured again {', '.join(floors)}"
        for name, floors in result.floors.items()
    )
    yield from (f"recorded as verified: {entry}" for entry in result.recorded)
    for entry in result.partly if recording and not result.findings else ():
        yield f"not recorded: {entry}: give the predictions of all its seeds in one call"
    if result.findings:
        state = counted(len(result.findings), "finding")
    else:
        state = "nothing wrong"
    if result.page_checked:
        looked = ", page compared"
    else:
        looked = ""
    yield f"{result.folder}: {counted(result.entries, 'entry')}, {state}{looked}"


@leaderboard.command(
    "picture",
    epilog="Example: lagbench leaderboard picture cavity --size mini -o cost.svg",
)
def picture(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: NewSizeOption = None,
    output: Annotated[Path, option("--output -o FILE", "SVG file to write.")] = Path(
        "cost.svg"
    ),
    board: BoardOption = BOARD,
    quiet: QuietFlag = False,
) -> None:
    """Draw accuracy against cost of a data set as an SVG file."""
    from lagbench.atomic import write_atomically
    from lagbench.board.build import collect
    from lagbench.board.cost import picture as draw
    from lagbench.data.local import locate_new

    wanted = locate_new(chosen(name, split), size).size
    if output.suffix.lower() != ".svg":
        raise UsageError(
            "the picture is an SVG file",
            where="--output",
            expected="a .svg name",
            got=output,
        )
    drawn = draw(collect(board, only=[(wanted.split, wanted.name)]), wanted)
    write_atomically(output, drawn.encode(), option="--output")
    say(str(output), quiet=quiet)


@leaderboard.command(
    "show", epilog="Example: lagbench leaderboard show cavity --size mini"
)
def show(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: Annotated[
        str | None, option("--size NAME", "tiny, mini or full; all by default.")
    ] = None,
    metric: Annotated[
        list[str] | None, option("--metric NAME", "Metric to show; repeatable.")
    ] = None,
    wide: Annotated[
        bool, option("--wide", "Show the first metrics of each data set.")
    ] = False,
    board: BoardOption = BOARD,
    as_json: JsonFlag = False,
) -> None:
    """Print the tables of the leaderboard."""
    from lagbench.board.build import collect
    from lagbench.board.folder import Folder
    from lagbench.board.show import choose_data_sets, tables, to_plain

    known = Folder(board).data_sets()
    held = collect(
        board,
        only=choose_data_sets(
            known, chosen(name, split) if name or split else None, size
        ),
    )
    if as_json:
        print_json(to_plain(held))
        return
    print_blocks(tables(held, metric or (), wide=wide))
    if known and not held.tabs:
        say(
            f"{board}: scores of earlier tasks alone; score predictions for today's: "
            f"lagbench submit"
        )
    elif not held.tabs:
        say(
            f"{board}: no entries yet; the first: lagbench submit predictions.nc "
            f"--from meta.yaml"
        )
