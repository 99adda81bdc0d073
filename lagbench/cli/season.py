"""The commands of the group season: close, run, show."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import typer

from lagbench.board.folder import SEASON_SCORES, Folder
from lagbench.board.season import (
    SCENARIOS,
    Season,
    close,
    read_season,
    reveal,
    season_path,
)
from lagbench.board.season_run import SeasonResult, run_season
from lagbench.board.season_scores import read_scores
from lagbench.board.season_table import (
    SeasonRow,
    describe_gap,
    markdown_table,
    record_blind,
    season_rows,
)
from lagbench.errors import ChecksFailedError, UsageError, format_count
from lagbench.figures.tables import Table
from lagbench.metrics.aggregate import FEWEST_FOR_INTERVAL
from lagbench.scoring.boards import board_option, find_board

from .options import (
    DEFAULT_BOARD,
    BoardOption,
    FoundBoardOption,
    JsonFlag,
    QuietFlag,
    RootOption,
    option,
)
from .output import (
    note_at_start,
    print_json,
    print_line,
    print_result,
    print_tables,
    progress_bar,
)

SeasonArgument = Annotated[
    str, typer.Argument(metavar="NAME", help="Name of the season.")
]


def close_command(
    name: SeasonArgument,
    split: Annotated[
        str | None, option("--split NAME", "Freeze entries of this split only.")
    ] = None,
    size: Annotated[
        str | None, option("--size NAME", "Freeze entries of this size only.")
    ] = None,
    scenarios: Annotated[
        int | None,
        option(
            "--scenarios N",
            f"Blind scenarios of each data set; {SCENARIOS} by default.",
        ),
    ] = None,
    budget: Annotated[
        float | None,
        option(
            "--budget SECONDS",
            "Greatest processor time of one model on one data set, estimated from its "
            "entry. A slower model predicts fewer scenarios, at least four.",
            min=0.0,
        ),
    ] = None,
    source: Annotated[
        str | None,
        option(
            "--source TEXT",
            "Source of a public random value that nobody knows yet. The seeds then "
            "wait for it.",
        ),
    ] = None,
    value: Annotated[
        str | None,
        option("--value TEXT", "The random value that a closed season waits for."),
    ] = None,
    board: BoardOption = DEFAULT_BOARD,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Freeze the models of a leaderboard; this fixes the blind scenarios.

    Exit code 0: closed
    1: a model is not the one that its entry names
    2: the season is closed already, or there is no model to freeze
    """
    if value is not None:
        _refuse_closing_options(
            {
                "--source": source,
                "--split": split,
                "--size": size,
                "--scenarios": scenarios,
                "--budget": budget,
            }
        )
        season = reveal(board, name, value)
    else:
        if source is not None and not source.strip():
            raise UsageError(
                "the source of the random value is not named",
                where="--source",
                expected="a text that says who publishes the value, and when",
                got=repr(source),
                fix="name the source; or leave --source out for seeds of the models "
                "alone",
            )
        season = close(
            board,
            name,
            split=split,
            size=size,
            scenarios=SCENARIOS if scenarios is None else scenarios,
            budget=budget,
            source=source or "",
            root=root,
            lagbench=version("lagbench"),
        )
    path = board / season_path(name)
    lines = _describe_season(season, path, board)
    print_result(season.model_dump(mode="json"), lines, as_json=as_json, quiet=quiet)


def _refuse_closing_options(options: Mapping[str, object]) -> None:
    """Refuse options of closing a season beside --value, which is given after it.

    Args:
        options: values by option; None where an option was not given.

    Raises:
        UsageError: one of them was given beside ``--value``.
    """
    given = [name for name, value in options.items() if value is not None]
    if not given:
        return
    raise UsageError(
        "--value is the random value of a season that is closed already",
        where="--value",
        expected="the name of the season and --value alone",
        got=f"{', '.join(given)} and --value",
        fix=f"give {given[0]} when you close the season, and --value alone when the "
        "value is known",
    )


def _describe_season(season: Season, path: Path, board: Path) -> Iterator[str]:
    for data_set in season.data_sets:
        models = sum(len(entry.models) for entry in data_set.entries)
        seed = data_set.draw_seed or "none yet"
        yield (
            f"{data_set.split} {data_set.size}: {format_count(models, 'model')} of "
            f"{format_count(len(data_set.entries), 'entry')}, "
            f"{data_set.scenarios} blind scenarios, seed {seed}"
        )
    yield f"{path}: {format_count(len(season.models), 'model')} frozen"
    if season.is_waiting:
        yield f"the seeds wait for: {season.source}"
    else:
        yield f"commit the file, then: {_next_commands(season, board)}"


def _next_commands(season: Season, board: Path) -> str:
    """Return the commands that lead from a closed season to its scores."""
    place = f"{season.season}{board_option(board)}"
    if season.is_waiting:
        return f"lagbench season close {place} --value VALUE, once it is known"
    return f"lagbench generate --season {place}; lagbench season run {place}"


def run_command(
    name: SeasonArgument,
    again: Annotated[
        bool, option("--again", "Also run models that an earlier run has scored.")
    ] = False,
    check: Annotated[
        bool,
        option(
            "--check",
            "Compare saved scores with those on the board, and write nothing there; "
            "with --again predict anew.",
        ),
    ] = False,
    threads: Annotated[
        int, option("--threads N", "Threads of a model on the CPU.", min=1)
    ] = 1,
    board: FoundBoardOption = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Score the frozen models of a season on its blind scenarios.

    An interrupted run goes on where it stopped. Models that an earlier run has scored
    are not predicted again.

    Exit code 0: done; with --check, the scores agree
    1: with --check, the scores differ or are missing; or a model is not the frozen one
    2: no such season, or it waits for its value
    3: a model cannot be read
    4: public data or blind scenarios are missing, or not those of the season
    5: out of memory or disk
    """
    board = find_board(board, reads=check)
    with progress_bar(quiet=quiet or as_json) as progress:
        if not check and not quiet:
            progress = note_at_start(f"results go to {board}", progress)
        result = run_season(
            board,
            name,
            again=again,
            comparing=check,
            threads=threads,
            root=root,
            progress=progress,
        )
    rows = season_rows(result.season, result.scores)
    blind_entries: tuple[str, ...] = ()
    if not check:
        blind_entries = record_blind(board, result.season, rows)
    plain: dict[str, object] = {
        "rows": rows,
        "predicted": result.predicted,
        "blind": blind_entries,
    }
    if result.comparison is not None:
        plain["comparison"] = result.comparison
    unmeasured = []
    for row in rows:
        if math.isnan(row.low):
            unmeasured.append(row.name)
    lines = _describe_run(result, blind_entries, unmeasured)
    print_result(plain, lines, as_json=as_json, quiet=quiet)
    raise typer.Exit(result.exit_code)


def _describe_run(
    result: SeasonResult, blind_entries: tuple[str, ...], unmeasured: Sequence[str]
) -> Iterator[str]:
    """Yield what was predicted, or compared; ``unmeasured`` gaps have no interval."""
    predicted = format_count(len(result.predicted), "model")
    if result.comparison is None:
        frozen_count = 0
        for data_set in result.scores.data_sets:
            frozen_count += len(data_set.models)
        earlier = ""
        if len(result.predicted) < frozen_count:
            earlier = f", {frozen_count - len(result.predicted)} scored before"
        yield f"{result.path}: {predicted} predicted{earlier}"
        entries = format_count(len(blind_entries), "entry")
        yield f"verified.yaml: {entries} at level blind"
        if unmeasured:
            yield (
                f"not in verified.yaml: {', '.join(unmeasured)}; with fewer than "
                f"{FEWEST_FOR_INTERVAL} public or blind scenarios a gap has no interval"
            )
        return
    comparison = result.comparison
    if comparison.has_same_bytes:
        yield f"{result.path}: {comparison.values} scores, the same bytes"
    else:
        verdict = "within the tolerance" if result.exit_code == 0 else "OTHER SCORES"
        yield (
            f"{result.path}: {comparison.values} scores, the greatest difference is "
            f"{comparison.greatest:.1e}, relative: {verdict}"
        )


def show_command(
    name: SeasonArgument,
    as_markdown: Annotated[
        bool, option("--markdown", "Print the table as Markdown, for a page.")
    ] = False,
    board: FoundBoardOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Print public and blind skill of a season, and their gap."""
    if as_json and as_markdown:
        raise UsageError(
            "the table is printed in one form",
            where="--json and --markdown",
            expected="one of the two",
            got="both",
            fix="leave one of them out",
        )
    board = find_board(board, reads=True)
    folder = Folder(board)
    season = read_season(folder, name)
    scores = read_scores(folder, season)
    if scores is None:
        raise ChecksFailedError(
            "the season was not run yet",
            where=str(board / season_path(name, SEASON_SCORES)),
            expected="the scores of its run",
            got="no such file",
            fix=_next_commands(season, board),
        )
    rows = season_rows(season, scores)
    if as_json:
        print_json({"season": name, "closed": str(season.closed), "rows": rows})
    elif as_markdown:
        print_line(markdown_table(rows))
    else:
        print_tables(_tables(name, rows), is_narrow=True)


def _tables(name: str, rows: tuple[SeasonRow, ...]) -> Iterator[Table]:
    places = []
    for row in rows:
        place = (row.split, row.size)
        if place not in places:
            places.append(place)
    for split, size in places:
        cells = []
        for row in rows:
            if (row.split, row.size) != (split, size):
                continue
            cells.append(
                (
                    row.method,
                    f"{row.public:z.3f}",
                    f"{row.blind:z.3f}",
                    describe_gap(row),
                    f"{len(row.models)} of {row.seeds}",
                    str(row.blind_scenarios),
                )
            )
        # short headings: the table fits a terminal of 80 characters
        columns = ("entry", "public", "blind", "gap [95 %]", "seeds", "scenarios")
        title = f"season {name}: {split} {size}, public and blind skill"
        yield Table(title, columns, tuple(cells))
