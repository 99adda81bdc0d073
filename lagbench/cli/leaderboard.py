"""The commands of the group leaderboard.

They are build, check, picture, reproduce, shift and show.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path, PurePath
from typing import Annotated

from cyclopts import Parameter
from cyclopts.types import PositiveInt

from lagbench.atomic import check_output_file, write_atomically
from lagbench.board.blind import BlindScore, score_blind
from lagbench.board.build import build, collect
from lagbench.board.check import CheckResult, check_board
from lagbench.board.cost import picture
from lagbench.board.folder import Folder
from lagbench.board.measured_cost import TIMED_FRAMES
from lagbench.board.reproduce import ReproduceResult, reproduce
from lagbench.board.selection import choose_data_sets, name_submit_command
from lagbench.board.shift import scores_of_seeds
from lagbench.board.shift_run import ShiftResult, score_on_shift
from lagbench.board.show import (
    SCOPE_OF_JSON,
    scope_of_tables,
    tables,
    to_plain,
)
from lagbench.data.local import locate_new, resolve_root
from lagbench.data.registry import Size
from lagbench.errors import (
    DataError,
    UsageError,
    check_regular,
    format_count,
)
from lagbench.references.shipped import shipped
from lagbench.scoring.boards import find_board
from lagbench.scoring.references import sizes_with_test_files

from .options import (
    DEFAULT_BOARD,
    BoardOption,
    DrawSeedOption,
    FoundBoardOption,
    JsonFlag,
    NewSizeOption,
    OverwriteFlag,
    QuietFlag,
    RootOption,
)
from .output import (
    format_bytes,
    note_at_start,
    print_json,
    print_line,
    print_result,
    print_tables,
    progress_bar,
)
from .solver_bench import try_bench
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
    base: str | None = None,
    own: list[str] | None = None,
    page: bool = False,
    predictions: list[Path] | None = None,
    recording: Annotated[bool, Parameter(name="--record")] = False,
    root: str | None = None,
    split: str | None = None,
    size: str | None = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> int:
    """Check all entries, score files and aggregates of the leaderboard.

    Every pull request runs these checks.

    Args:
        base: Report changes to entries that this git commit has.
        own: With --base: an entry that is yours; repeatable.
        page: Also check that the files index.html and schema.json are up to date.
        predictions: Score an entry's predictions again; repeatable.
        recording: With --predictions: add confirmed entries to verified.yaml.
        root: Folder of all data sets. Without --predictions, the shipped scores of
            reference predictors are measured again on these data.
        split: With --root: measure on this split only.
        size: With --root: measure on this size only.
    """
    if (split or size) and not root:
        raise UsageError(
            "--split and --size choose data to measure again; give --root as well",
            where="--root",
        )
    if recording and not predictions:
        raise UsageError(
            "there is nothing to record; give --predictions FILE as well",
            where="--record",
        )
    for path in predictions or ():
        check_regular(path)
    sizes: Sequence[Size] = ()
    if root is not None and not predictions:
        sizes = _sizes_to_measure(root, split, size)
    with progress_bar(quiet=quiet or as_json) as progress:
        result = check_board(
            find_board(board, reads=not recording),
            page=page,
            base=base,
            own=own or (),
            predictions=predictions or (),
            recording=recording,
            measured_sizes=sizes,
            root=root,
            progress=progress,
        )
    if not as_json:
        for issue in result.findings:
            print_on_stderr(str(issue))
    lines = _describe_check(result, recording=recording)
    print_result(result, lines, as_json=as_json, quiet=quiet)
    return result.exit_code


def _sizes_to_measure(root: str, split: str | None, size: str | None) -> list[Size]:
    """Return the sizes whose test scenarios lie under a root folder.

    Raises:
        DataError: there are none.
    """
    sizes = sizes_with_test_files(resolve_root(root), split=split, name=size)
    if not sizes:
        raise DataError(
            "no test scenarios are there; make them with `lagbench generate`, or name "
            "another --root",
            where=str(root),
        )
    return sizes


def _describe_check(result: CheckResult, *, recording: bool) -> Iterator[str]:
    for confirmation in result.confirmed:
        precision = "exactly"
        if confirmation.difference != 0.0:
            precision = f"to {confirmation.difference:.1e}, relative"
        if confirmation.is_anew:
            precision += ", predicted anew"
        yield (
            f"{confirmation.predictions}: confirms {confirmation.score_file} of "
            f"{confirmation.entry} {precision}"
        )
    for data_set, predictors in result.references.items():
        yield f"{data_set}: measured again {', '.join(predictors)}"
    for entry in result.recorded:
        yield f"recorded as verified: {entry}"
    if recording and not result.findings:
        for entry in result.partly:
            yield (
                f"not recorded: {entry}: "
                "give the predictions of all its seeds in one call"
            )

    if result.reproduced_wholly or result.reproduced_partly:
        wholly = format_count(result.reproduced_wholly, "active entry")
        yield (
            f"reproduced: {wholly} on all test scenarios, "
            f"{result.reproduced_partly} on a part of them"
        )
    state = "nothing wrong"
    if result.findings:
        state = format_count(len(result.findings), "finding")
    if result.page_checked:
        state += ", page compared"
    entries = format_count(result.entries, "entry")
    yield f"{result.folder}: {entries}, {state}"


def picture_command(
    split: str,
    *,
    size: NewSizeOption = None,
    output: Annotated[Path, Parameter(alias="-o")] = Path("cost.svg"),
    overwrite: OverwriteFlag = False,
    board: FoundBoardOption = None,
    quiet: QuietFlag = False,
) -> None:
    """Draw the accuracy of models against their cost as an SVG file.

    Args:
        split: Name of the split.
        output: SVG file to write.
    """
    tier = locate_new(split, size).size
    if output.suffix.lower() != ".svg":
        raise UsageError(
            f"the picture is an SVG file; -o {output.stem or 'cost'}.svg",
            where="--output",
        )
    check_output_file(output, overwrite=overwrite)
    folder = find_board(board, reads=True)
    if not shipped(tier):
        # without references the picture of no entry would be empty
        choose_data_sets(
            Folder(folder).data_sets(), tier.split, tier.name, board=folder
        )
    model = collect(folder, only=[(tier.split, tier.name)])
    svg = picture(model, tier)
    write_atomically(output, svg.encode(), option="--output")
    print_line(str(output), quiet=quiet)


def reproduce_command(
    entries: list[str] | None = None,
    /,
    *,
    every: EveryFlag = False,
    split: EntrySplitOption = None,
    size: EntrySizeOption = None,
    scenarios: int | None = None,
    costs: bool = False,
    no_costs: bool = False,
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
        costs: Measure costs only, on a quiet machine.
        no_costs: Measure no costs.
        recording: Write the result to verified.yaml.
        threads: Threads of a model on the CPU.
    """
    if bool(entries) == every:
        raise UsageError("name entries, as in cavity/mini/gns, or ask for --all")
    if (costs and no_costs) or (scenarios is not None and scenarios < 1):
        raise UsageError("--costs and --no-costs, or --scenarios 0; leave one out")
    if draw_seed is not None:
        with progress_bar(quiet=quiet or as_json) as progress:
            scores = score_blind(
                find_board(board, reads=True),
                entries or (),
                draw_seed,
                split=split,
                size=size,
                threads=threads,
                root=root,
                progress=progress,
            )
        print_result(scores, _describe_blind(scores), as_json=as_json, quiet=quiet)
        return 0
    folder = find_board(board)
    with progress_bar(quiet=quiet or as_json) as progress:
        if recording and not quiet:
            progress = note_at_start(f"results go to {folder}", progress)
        result = reproduce(
            folder,
            entries or (),
            split=split,
            size=size,
            scenarios=scenarios,
            scores=not costs,
            costs=not no_costs,
            again=again,
            recording=recording,
            threads=threads,
            root=root,
            time_solver=_time_solver,
            progress=progress,
        )
    if not as_json:
        for failure in result.failures:
            print_on_stderr(f"{failure.entry}: {failure.error}")
    lines = _describe_reproduced(result, with_scores=not costs, with_costs=not no_costs)
    print_result(result.to_plain(), lines, as_json=as_json, quiet=quiet)
    return result.exit_code


def _describe_blind(scores: Sequence[BlindScore]) -> Iterator[str]:
    for one in scores:
        yield (
            f"{one.name}: skill {one.public_skill:.3f} on test, "
            f"{one.blind_skill:.3f} on the new scenarios"
        )


def _time_solver(split: str, size: str) -> float | None:
    """Return the solver's time of a frame [s], None where it cannot run."""
    solver = try_bench(split, size, warning="the solver is not timed")
    if solver is None:
        return None
    return solver.seconds_per_frame


def _describe_reproduced(
    result: ReproduceResult, *, with_scores: bool, with_costs: bool
) -> Iterator[str]:
    """Yield a text line for each seed and each cost, fixes, then the totals.

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
        if path in result.differing:
            yield _name_fix_of_difference(PurePath(path), result.folder)
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


def _name_fix_of_difference(entry_path: PurePath, board: Path) -> str:
    """Return the fix for an entry whose model does not give the entry's scores."""
    _, split, size, _ = entry_path.parts
    submit = name_submit_command(entry_path, board)
    return (
        "  fix: if the predictions were made with other weights, predict again with "
        "those of the entry and replace the entry: lagbench predict FILE "
        f"--split {split} --size {size} -o PREDICTIONS.nc; {submit}"
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
        raise UsageError("name entries, as in cavity/mini/gns, or ask for --all")
    folder = find_board(board)
    with progress_bar(quiet=quiet or as_json) as progress:
        if not quiet:
            progress = note_at_start(f"results go to {folder}", progress)
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
        for failure in result.failures:
            print_on_stderr(f"{failure.entry}: {failure.error}")
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
    wide: bool = False,
    board: FoundBoardOption = None,
    as_json: JsonFlag = False,
) -> None:
    """Print the tables of the leaderboard.

    Args:
        split: Name of the split; all by default.
        size: tiny, mini or full; all by default.
        metric: Metric to show; repeatable.
        wide: Show variants, deviations and the first metrics of each data set.
    """
    folder = find_board(board, reads=True)
    data_sets = Folder(folder).data_sets()
    chosen = choose_data_sets(data_sets, split, size, board=folder)
    scope = scope_of_tables(metric or (), wide=wide)
    if as_json:
        scope = SCOPE_OF_JSON
    model = collect(folder, only=chosen, scope=scope)
    if as_json:
        print_json(to_plain(model))
        return

    print_tables(tables(model, metric or (), wide=wide))
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
