"""Commands around the leaderboard: submit; leaderboard build, check, show."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lagbench.errors import UsageError

from .options import JsonFlag, QuietFlag, RootOption, SplitArgument, SplitOption, WorkersOption, chosen
from .output import print_json, print_table, say, spell_bytes
from .progress import progress_bar

if TYPE_CHECKING:
    from lagbench.board.check import CheckResult
    from lagbench.board.submit import SubmitResult
    from lagbench.submission import ValidationResult

__all__ = ["leaderboard", "submit"]

BoardOption = Annotated[Path, typer.Option("--board", metavar="FOLDER", help="The leaderboard's folder.")]
BOARD = Path("leaderboard")


def _text(name: str, metavar: str, text: str) -> Any:  # noqa: ANN401 (what typer says of it)
    return typer.Option(name, metavar=metavar, help=text)


def submit(
    predictions: Annotated[
        list[Path] | None, typer.Argument(metavar="FILE...", help="A predictions.nc; one per seed.")
    ] = None,
    source: Annotated[
        Path | None, typer.Option("--from", metavar="FILE", help="YAML of the keys below; options win.")
    ] = None,
    method: Annotated[str | None, _text("--method", "ID", "Names the entry, as in my-model.")] = None,
    name: Annotated[str | None, _text("--name", "TEXT", "What the method is called.")] = None,
    authors: Annotated[list[str] | None, _text("--author", "NAME", "Repeatable.")] = None,
    affiliation: Annotated[str | None, _text("--affiliation", "TEXT", "Of the authors.")] = None,
    licence: Annotated[str | None, _text("--licence", "NAME", "Of the code, as in MIT.")] = None,
    code: Annotated[str | None, _text("--code", "URL", "Where the code is.")] = None,
    paper: Annotated[str | None, _text("--paper", "URL", "Where the paper is.")] = None,
    date: Annotated[str | None, _text("--date", "YYYY-MM-DD", "Of the submission; today by default.")] = None,
    notes: Annotated[str | None, _text("--notes", "TEXT", "What readers should know.")] = None,
    training: Annotated[str | None, _text("--training", "TEXT", "What it was trained on.")] = None,
    parameters: Annotated[int | None, _text("--parameters", "N", "Trainable parameters.")] = None,
    hardware: Annotated[str | None, _text("--hardware", "TEXT", "Machine of the training.")] = None,
    command: Annotated[str | None, _text("--command", "TEXT", "What makes the predictions again.")] = None,
    solver: Annotated[
        float | None,
        _text("--solver-seconds-per-frame", "S", "Of our solver on the same machine: lagbench bench solver."),
    ] = None,
    urls: Annotated[list[str] | None, _text("--url", "URL", "Where FILE can be had; one per FILE.")] = None,
    scored_by: Annotated[str | None, _text("--scored-by", "NAME", "Who runs this; else the author.")] = None,
    floor: Annotated[
        str | None, _text("--floor", "NAME", "Instead of FILE: persistence or constant-velocity.")
    ] = None,
    split: SplitOption = None,
    size: Annotated[str | None, _text("--size", "NAME", "With --floor: tiny, mini or full.")] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace the entry of that name.")] = False,
    board: BoardOption = BOARD,
    root: RootOption = None,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Score predictions and write their entry and score files into the leaderboard's folder."""
    from lagbench.board.meta import read_meta
    from lagbench.board.submit import submit as run
    from lagbench.board.submit import submit_floor

    given = {
        **{"method": method, "name": name, "authors": authors, "affiliation": affiliation},
        **{"licence": licence, "code": code, "paper": paper, "notes": notes, "training": training},
        **{"parameters": parameters, "hardware": hardware, "command": command, "urls": urls},
        **{"solver_seconds_per_frame": solver, "scored_by": scored_by},
    }
    _check_choice(predictions, floor, [source, split, size, replace or None, *given.values()])
    meta = read_meta(source, {**given, "date": date})
    with progress_bar(quiet=quiet or as_json) as draw:
        if floor is not None:
            result = submit_floor(
                floor,
                split=chosen(None, split),
                size=size or "full",
                date=meta.date,
                progress=draw,
                board=board,
                root=root,
                workers=workers,
            )
        else:
            result = run(
                predictions or [],
                meta,
                replace=replace,
                progress=draw,
                examined=_complain,
                board=board,
                root=root,
                workers=workers,
            )
    if as_json:
        print_json(result)
    else:
        _submitted(result, quiet=quiet)


def _check_choice(predictions: list[Path] | None, floor: str | None, described: list[object]) -> None:
    """Refuse options of files with --floor and the other way round."""
    _, split, size, *_ = described
    rest = [value for value in described if value and value not in (split, size)]
    if floor is not None and (predictions or rest):
        raise UsageError(
            "a floor is predicted and described by lagbench itself",
            where="--floor",
            fix="with --floor give --split, --size, --date, --board and --root only",
        )
    if floor is None and not predictions:
        raise UsageError("nothing to submit", expected="FILE..., or --floor NAME")
    if floor is None and (split or size):
        raise UsageError(
            "predictions name split and size themselves", where="--split, --size", fix="leave out"
        )


def _complain(result: ValidationResult) -> None:
    """Tell on stderr what rejects a file; the error that follows names the first finding only."""
    if len(result.errors) > 1:
        typer.echo("\n".join(str(finding) for finding in result.errors), err=True)


def _submitted(result: SubmitResult, *, quiet: bool) -> None:
    mean = "undefined" if result.mean is None else f"{result.mean:.4g}"
    spread = "" if result.std is None else f" ± {result.std:.2g} over seeds"
    say(f"{result.method} on {result.split} {result.size}: {result.ranking} {mean}{spread}", quiet=quiet)
    for flag in result.flags:
        say(f"flag {flag}: raised", quiet=quiet)
    say("written: " + ", ".join(str(path) for path in result.files), quiet=quiet)
    say("next: lagbench leaderboard build, then lagbench leaderboard check", quiet=quiet)


leaderboard = typer.Typer(no_args_is_help=True, help="Draw, check and show the leaderboard.")


@leaderboard.command("build", epilog="Example: lagbench leaderboard build")
def build(
    board: BoardOption = BOARD,
    check: Annotated[
        bool, typer.Option("--check", help="Write nothing; fail where the page is stale.")
    ] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Draw the page: one self-contained index.html; the same submissions give the same bytes."""
    from lagbench.board.build import build as run

    result = run(board, check=check)
    if as_json:
        print_json(result)
        return
    state = "written" if result.page in result.written else "up to date"
    what = f"{result.rows} entries, {result.tabs} tabs, {spell_bytes(result.bytes)}"
    say(f"{result.page}: {what}, {state}", quiet=quiet)


@leaderboard.command("check", epilog="Example: lagbench leaderboard check")
def check(
    board: BoardOption = BOARD,
    page: Annotated[bool, typer.Option("--page/--no-page", help="Whether to compare the page.")] = True,
    predictions: Annotated[
        list[Path] | None, _text("--predictions", "FILE", "Score an entry's predictions again; repeatable.")
    ] = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Check entries, score files, every aggregate and the page; for every pull request."""
    from lagbench.board.check import check_board

    with progress_bar(quiet=quiet or as_json) as draw:
        result = check_board(board, page=page, predictions=predictions or (), root=root, progress=draw)
    if as_json:
        print_json(result)
    else:
        _checked(result, quiet=quiet)
    raise typer.Exit(result.exit_code)


def _checked(result: CheckResult, *, quiet: bool) -> None:
    for finding in result.findings:
        typer.echo(str(finding), err=True)
    state = f"{len(result.findings)} findings" if result.findings else "nothing wrong"
    looked = "" if result.page_checked else ", page not compared"
    say(f"{result.folder}: {result.entries} entries, {state}{looked}", quiet=quiet)


@leaderboard.command("show", epilog="Example: lagbench leaderboard show cavity --size mini")
def show(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: Annotated[str | None, _text("--size", "NAME", "tiny, mini or full; all by default.")] = None,
    metric: Annotated[list[str] | None, _text("--metric", "NAME", "Metric to show; repeatable.")] = None,
    board: BoardOption = BOARD,
    as_json: JsonFlag = False,
) -> None:
    """Print the tables of the leaderboard."""
    from lagbench.board.collect import collect
    from lagbench.board.show import as_plain, chosen_tabs, tables

    held = collect(board)
    tabs = chosen_tabs(held, chosen(name, split) if name or split else None, size)
    if as_json:
        print_json(as_plain(tabs))
        return
    for table in tables(held, tabs, metric or ()):
        print_table(table.title, table.columns, table.rows)
