"""The commands of the group leaderboard.

They are build, check, picture, reproduce, shift and show.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from cyclopts.types import PositiveInt

from lagbench.atomic import check_output_file
from lagbench.board.blind import score_blind
from lagbench.board.check import check_board
from lagbench.board.collect import collect, list_data_sets
from lagbench.board.folder import Folder
from lagbench.board.models import choose_data_sets
from lagbench.board.page import build, write_picture
from lagbench.board.reproduce import TIMED_FRAMES, ReproduceResult, reproduce
from lagbench.board.shift import scores_of_seeds
from lagbench.board.shift_run import ShiftResult, score_on_shift
from lagbench.board.show import tables, to_plain
from lagbench.data.registry import load
from lagbench.errors import UsageError, check_installed, check_regular, format_count
from lagbench.scoring.boards import find_board

from .options import (
    DEFAULT_BOARD,
    BoardOption,
    DrawSeedOption,
    FoundBoardOption,
    JsonFlag,
    OverwriteFlag,
    QuietFlag,
    RootOption,
)
from .output import (
    format_bytes,
    print_json,
    print_line,
    print_result,
    print_tables,
    progress_bar,
)
from .solver_bench import time_solver
from .stderr import print_on_stderr

EveryFlag = Annotated[
    bool, Parameter(name="--all", help="Take every entry that has a model.")
]
EntrySplitOption = Annotated[
    str | None, Parameter(help="With --all: entries of this split only.")
]
EntrySizeOption = Annotated[
    str | None, Parameter(help="With --all: entries of this size only.")
]
AgainFlag = Annotated[
    bool, Parameter(help="Also run models that have a recorded result.")
]


def build_command(
    *,
    board: BoardOption = DEFAULT_BOARD,
    check: bool = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Draw the leaderboard's page: one self-contained index.html.

    The same submissions give the same bytes.

    Args:
        check: Write nothing; fail if the page is out of date.
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
    *,
    board: FoundBoardOption = None,
    predictions: list[Path] | None = None,
    recording: Annotated[bool, Parameter(name="--record")] = False,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> int:
    """Check all entries, score files and weights of the leaderboard.

    Every pull request runs these checks.

    Args:
        predictions: Score an entry's predictions again; repeatable.
        recording: With --predictions: add confirmed entries to verified.yaml.
    """
    if recording and not predictions:
        raise UsageError("--record needs --predictions FILE, which is scored again")
    for path in predictions or ():
        check_regular(path)
    with progress_bar(quiet=quiet or as_json) as progress:
        result = check_board(
            find_board(board),
            predictions=predictions or (),
            recording=recording,
            root=root,
            progress=progress,
        )
    if not as_json:
        for issue in result.findings:
            print_on_stderr(issue)
    lines = []
    for one in result.confirmed:
        lines.append(f"{one.predictions}: confirms {one.score_file} of {one.entry}")
    for entry in result.recorded:
        lines.append(f"recorded as verified: {entry}")
    state = "nothing wrong"
    if result.findings:
        state = format_count(len(result.findings), "finding")
    entries = format_count(result.entries, "entry")
    lines.append(f"{result.folder}: {entries}, {state}")
    print_result(result, lines, as_json=as_json, quiet=quiet)
    return result.exit_code


def picture_command(
    *,
    size: str = "mini",
    output: Annotated[Path, Parameter(alias="-o")] = Path("front.svg"),
    overwrite: OverwriteFlag = False,
    board: FoundBoardOption = None,
    quiet: QuietFlag = False,
) -> None:
    """Draw error against cost as a file: a small panel for each data set.

    Args:
        size: Data sets of this size: mini or full.
        output: SVG or PNG file to write.
    """
    if output.suffix.lower() not in (".svg", ".png"):
        raise UsageError(f"{output} must end in .svg or .png; rename it")
    check_output_file(output, overwrite=overwrite)
    check_installed("vl_convert", extra="plots")
    folder = find_board(board)
    data_sets = list_data_sets(Folder(folder), load())
    chosen = choose_data_sets(data_sets, None, size, board=folder)
    write_picture(collect(folder, only=chosen, metrics=()), output)
    print_line(str(output), quiet=quiet)


def reproduce_command(
    entries: list[str] | None = None,
    /,
    *,
    every: EveryFlag = False,
    split: EntrySplitOption = None,
    size: EntrySizeOption = None,
    scenarios: int | None = None,
    costs: Annotated[bool | None, Parameter(negative="--no-costs")] = None,
    again: AgainFlag = False,
    recording: Annotated[
        bool, Parameter(name="--record", negative="--no-record")
    ] = True,
    threads: PositiveInt = 1,
    draw_seed: DrawSeedOption = None,
    board: FoundBoardOption = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> int:
    """Run the models of entries again, compare scores, measure costs.

    Exit code 0: all scores agree
    1: some differ
    2: no such entry, or one without a model
    3: a model cannot be read
    4: data are missing
    5: out of memory or disk

    Args:
        entries: SPLIT/SIZE/METHOD, as in cavity/mini/gns.
        scenarios: Predict a sample of so many scenarios; all by default.
        costs: Measure costs only, on a quiet machine; or no costs. Default: both.
        recording: Write the result to verified.yaml.
        threads: Threads of a model on the CPU.
    """
    if bool(entries) == every:
        raise UsageError("name entries, as in cavity/mini/gns, or give --all")
    if scenarios is not None and scenarios < 1:
        raise UsageError(f"--scenarios {scenarios} predicts nothing; give 1 or more")
    if draw_seed is not None:
        with progress_bar(quiet=quiet or as_json) as progress:
            scores = score_blind(
                find_board(board),
                entries or (),
                draw_seed,
                split=split,
                size=size,
                threads=threads,
                root=root,
                progress=progress,
            )
        blind_lines = []
        for one in scores:
            blind_lines.append(
                f"{one.name}: skill {one.public_skill:.3f} on test, "
                f"{one.blind_skill:.3f} on the new scenarios"
            )
        print_result(scores, blind_lines, as_json=as_json, quiet=quiet)
        return 0
    folder = find_board(board)
    with_scores = costs is not True
    with_costs = costs is not False
    with progress_bar(quiet=quiet or as_json) as progress:
        result = reproduce(
            folder,
            entries or (),
            split=split,
            size=size,
            scenarios=scenarios,
            scores=with_scores,
            costs=with_costs,
            again=again,
            recording=recording,
            threads=threads,
            root=root,
            time_solver=time_solver,
            progress=progress,
        )
    if not as_json:
        for name, error in result.failures.items():
            print_on_stderr(f"{name}: {error}")
    lines = _describe_reproduced(result, with_scores=with_scores, with_costs=with_costs)
    print_result(result.to_plain(), lines, as_json=as_json, quiet=quiet)
    return result.exit_code


def _describe_reproduced(
    result: ReproduceResult, *, with_scores: bool, with_costs: bool
) -> Iterator[str]:
    """Yield a line for each seed and each cost, then the totals.

    Args:
        result: what was run, and what was recorded before.
        with_scores: whether scores were asked for.
        with_costs: whether costs were asked for.
    """
    for path, verification in result.lines.items():
        entry_name = path.removeprefix("submissions/").removesuffix(".yaml")
        for seed_result in verification.reproduced:
            name = entry_name
            if seed_result.seed is not None:
                name = f"{entry_name}, seed {seed_result.seed}"
            verdict = "reproduced"
            if not seed_result.agrees:
                verdict = "NOT reproduced"
            remark = ""
            if name not in result.predicted:
                remark = f"; recorded on {verification.date}"
                if with_scores:
                    remark += ", --again runs it now"
            yield (
                f"{name}: {verdict}, {seed_result.metric} "
                f"{seed_result.reproduced:.6g} against {seed_result.submitted:.6g} "
                f"({seed_result.difference:.1e} relative, {seed_result.scenarios} "
                f"of {seed_result.of} scenarios){remark}"
            )
        if verification.cost is not None and with_costs:
            cost = verification.cost
            yield (
                f"{entry_name}: {cost.seconds_per_frame:.3g} s per frame: "
                f"processor time, mean over {TIMED_FRAMES} frames, "
                f"least of {cost.repeats} rounds; {cost.machine}"
            )
    yield (
        f"{result.folder}: {format_count(len(result.lines), 'entry')}, "
        f"{format_count(len(result.differing), 'difference')}, "
        f"{format_count(len(result.failures), 'failure')}"
    )


def shift_command(
    entries: list[str] | None = None,
    /,
    *,
    every: EveryFlag = False,
    split: EntrySplitOption = None,
    size: EntrySizeOption = None,
    again: AgainFlag = False,
    threads: PositiveInt = 1,
    board: FoundBoardOption = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> int:
    """Score models of entries on shift, scenarios unlike those of train.

    The models predict the subset, and the scores go to shift.yaml.

    Exit code 0: all models ran
    2: no such entry, or one without a model
    3: a model cannot be read
    4: data are missing
    5: out of memory or disk

    Args:
        entries: SPLIT/SIZE/METHOD, as in cavity/mini/gns.
        threads: Threads of a model on the CPU.
    """
    if bool(entries) == every:
        raise UsageError("name entries, as in cavity/mini/gns, or give --all")
    folder = find_board(board)
    with progress_bar(quiet=quiet or as_json) as progress:
        result = score_on_shift(
            folder,
            entries or (),
            split=split,
            size=size,
            again=again,
            threads=threads,
            root=root,
            progress=progress,
        )
    if not as_json:
        for name, error in result.failures.items():
            print_on_stderr(f"{name}: {error}")
    print_result(
        result.to_plain(), _describe_shift(result), as_json=as_json, quiet=quiet
    )
    return result.exit_code


def _describe_shift(result: ShiftResult) -> Iterator[str]:
    for path, scores in result.entries.items():
        name = path.removeprefix("submissions/").removesuffix(".yaml")
        for one, seed_score in zip(scores.models, scores_of_seeds(scores), strict=True):
            seed = ""
            if one.seed is not None:
                seed = f", seed {one.seed}"
            yield (
                f"{name}{seed}: {scores.metric} {seed_score.mean:.6g} on shift, "
                f"{len(one.values)} scenarios"
            )
    yield (
        f"{result.folder}: {format_count(len(result.entries), 'entry')}, "
        f"{format_count(len(result.failures), 'failure')}"
    )


def show_command(
    split: str | None = None,
    *,
    size: str | None = None,
    metric: list[str] | None = None,
    board: FoundBoardOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Print the tables of the leaderboard.

    Args:
        split: Name of the split; all by default.
        size: tiny, mini or full; all by default.
        metric: Metric to show; repeatable.
    """
    folder = find_board(board)
    data_sets = list_data_sets(Folder(folder), load())
    chosen = choose_data_sets(data_sets, split, size, board=folder)
    metrics = None if as_json else metric or ()
    model = collect(folder, only=chosen, metrics=metrics)
    if as_json:
        print_json(to_plain(model))
        return

    print_tables(tables(model, metric or ()))
    if model.tabs:
        return
    if data_sets:
        print_line(
            f"{folder}: all entries were scored on earlier tasks; "
            "submit predictions for the present task: lagbench submit"
        )
    else:
        print_line(
            f"{folder}: no entries yet; make the first: "
            "lagbench submit predictions.nc --from meta.yaml"
        )
