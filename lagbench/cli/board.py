"""Commands around the leaderboard: submit; leaderboard build, check, show."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lagbench.errors import UsageError

from . import entry_options as it
from .entry_options import option
from .options import JsonFlag, QuietFlag, RootOption, SplitArgument, SplitOption, WorkersOption, chosen
from .output import print_json, print_table, progress_bar, say, spell_bytes

if TYPE_CHECKING:
    from lagbench.board.check import CheckResult
    from lagbench.board.meta import Meta
    from lagbench.board.submit import SubmitResult
    from lagbench.submission import ValidationResult

__all__ = ["leaderboard", "submit"]

BoardOption = Annotated[Path, typer.Option("--board", metavar="FOLDER", help="The leaderboard's folder.")]
BOARD = Path("leaderboard")


def submit(
    predictions: it.FilesArgument = None,
    source: it.SourceOption = None,
    method: it.MethodOption = None,
    name: it.NameOption = None,
    authors: it.AuthorsOption = None,
    affiliation: it.AffiliationOption = None,
    licence: it.LicenceOption = None,
    code: it.CodeOption = None,
    paper: it.PaperOption = None,
    date: it.DateOption = None,
    notes: it.NotesOption = None,
    training: it.TrainingOption = None,
    parameters: it.ParametersOption = None,
    hardware: it.HardwareOption = None,
    command: it.CommandOption = None,
    solver_seconds_per_frame: it.SolverOption = None,
    urls: it.UrlsOption = None,
    scored_by: it.ScoredByOption = None,
    floor: it.FloorOption = None,
    split: SplitOption = None,
    size: it.FloorSizeOption = None,
    replace: it.ReplaceFlag = False,
    board: BoardOption = BOARD,
    root: RootOption = None,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Score predictions and write their entry and score files into the leaderboard's folder."""
    given = {
        "method": method,
        "name": name,
        "authors": authors,
        "affiliation": affiliation,
        "licence": licence,
        "code": code,
        "paper": paper,
        "notes": notes,
        "training": training,
        "parameters": parameters,
        "hardware": hardware,
        "command": command,
        "solver_seconds_per_frame": solver_seconds_per_frame,
        "urls": urls,
        "scored_by": scored_by,
    }
    _check_choice(predictions, floor, [split, size], [source, replace or None, *given.values()])
    meta, where = _described(source, given, date), {"board": board, "root": root, "workers": workers}
    with progress_bar(quiet=quiet or as_json) as draw:
        if floor is None:
            result = _of_files(predictions or [], meta, replace=replace, progress=draw, **where)
        else:
            result = _of_floor(floor, chosen(None, split), size, meta, progress=draw, **where)
    _submitted(result, as_json=as_json, quiet=quiet)


def _described(source: Path | None, given: Mapping[str, object], date: str | None) -> Meta:
    from lagbench.board.meta import read_meta

    return read_meta(source, {**given, "date": date})


def _of_files(predictions: list[Path], meta: Meta, *, replace: bool, **where: Any) -> SubmitResult:  # noqa: ANN401
    from lagbench.board.submit import submit as run

    return run(predictions, meta, replace=replace, examined=_complain, **where)


def _of_floor(name: str, split: str, size: str | None, meta: Meta, **where: Any) -> SubmitResult:  # noqa: ANN401
    from lagbench.board.submit import submit_floor

    return submit_floor(name, split=split, size=size or "full", date=meta.date, **where)


def _check_choice(
    predictions: list[Path] | None,
    floor: str | None,
    place: list[str | None],
    described: list[object],
) -> None:
    """Refuse options of files with --floor and the other way round."""
    if floor is not None and (predictions or any(described)):
        raise UsageError(
            "a floor is predicted and described by lagbench itself",
            where="--floor",
            fix="with --floor give --split, --size, --date, --board and --root only",
        )
    if floor is None and not predictions:
        raise UsageError("nothing to submit", expected="FILE..., or --floor NAME")
    if floor is None and any(place):
        raise UsageError(
            "predictions name split and size themselves", where="--split, --size", fix="leave out"
        )


def _complain(result: ValidationResult) -> None:
    """Tell on stderr what rejects a file; the error that follows names the first finding only."""
    if len(result.errors) > 1:
        typer.echo("\n".join(str(finding) for finding in result.errors), err=True)


def _submitted(result: SubmitResult, *, as_json: bool, quiet: bool) -> None:
    if as_json:
        print_json(result)
        return
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
        list[Path] | None, option("--predictions", "FILE", "Score an entry's predictions again; repeatable.")
    ] = None,
    floors: Annotated[
        bool | None,
        typer.Option(
            "--floors/--no-floors",
            help="Whether to score the floors again where the data are there; by default with --root.",
        ),
    ] = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Check entries, score files, every aggregate and the page; for every pull request."""
    from lagbench.board.check import check_board

    with progress_bar(quiet=quiet or as_json) as draw:
        result = check_board(
            board,
            page=page,
            predictions=predictions or (),
            floors=root is not None if floors is None else floors,
            root=root,
            progress=draw,
        )
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
    if result.floors_rescored:
        say(f"floors scored again: {', '.join(result.floors_rescored)}", quiet=quiet)
    if result.floors_trusted:
        which = ", ".join(result.floors_trusted)
        say(f"floors aggregated again only, not scored again: {which}", quiet=quiet)
        say(
            "--root FOLDER with the test data scores them again: seconds for a mini, long for a full",
            quiet=quiet,
        )


@leaderboard.command("show", epilog="Example: lagbench leaderboard show cavity --size mini")
def show(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: Annotated[str | None, option("--size", "NAME", "tiny, mini or full; all by default.")] = None,
    metric: Annotated[list[str] | None, option("--metric", "NAME", "Metric to show; repeatable.")] = None,
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
