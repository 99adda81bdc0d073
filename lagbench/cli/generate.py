"""The command generate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from lagbench.data.layout import format_ids, url_of
from lagbench.data.local import locate_new
from lagbench.data.registry import Registry, load
from lagbench.errors import UsageError, format_count, hide_credentials
from lagbench.make.generate import GenerationResult, generate
from lagbench.make.inventory import recording_hint
from lagbench.scoring.boards import find_board

from .options import (
    FoundBoardOption,
    JsonFlag,
    NewSizeOption,
    QuietFlag,
    RootOption,
    ScenariosOption,
    SchedulerOption,
    SplitArgument,
    SplitOption,
    SubsetOption,
    WorkersOption,
    choose_split,
    option,
)
from .output import (
    format_bytes,
    format_seconds,
    print_note,
    print_result,
    progress_bar,
)


def generate_command(
    split_argument: SplitArgument = None,
    split_option: SplitOption = None,
    size: NewSizeOption = None,
    subset: SubsetOption = None,
    scenarios: ScenariosOption = None,
    root: RootOption = None,
    workers: WorkersOption = None,
    device: Annotated[
        str, option("--device NAME", "cpu, parallel (all CPU threads) or cuda.")
    ] = "cpu",
    scheduler: SchedulerOption = None,
    gather: Annotated[
        list[Path] | None,
        option(
            "--gather FOLDER",
            "Take finished scenarios from another root folder; repeatable.",
        ),
    ] = None,
    force: Annotated[
        bool, option("--force", "Simulate finished scenarios again.")
    ] = False,
    dry_run: Annotated[
        bool, option("--dry-run", "Print the cost only: bytes, time, free disk.")
    ] = False,
    season: Annotated[
        str | None,
        option(
            "--season NAME",
            "Simulate the blind scenarios of this season, for all its data sets or "
            "for those of --split and --size.",
        ),
    ] = None,
    board: FoundBoardOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Simulate a split and write its files.

    An interrupted call goes on where it stopped.
    """
    if season is None:
        _refuse_board(board)
        split = choose_split(split_argument, split_option)
        if size is None and not quiet:
            print_note(_describe_default_size(split, root))
        targets = [GenerationTarget(split=split, size=size, root=root, registry=None)]
    else:
        split_name = None
        if split_argument or split_option:
            split_name = choose_split(split_argument, split_option)
        targets = _season_targets(season, board, root, split_name, size)
    for target in targets:
        with progress_bar(quiet=quiet or dry_run) as progress:
            result = generate(
                target.split,
                target.size,
                subset=subset,
                scenarios=scenarios,
                root=target.root,
                workers=workers,
                device=device,
                scheduler=scheduler,
                gather=gather or (),
                force=force,
                dry_run=dry_run,
                progress=progress,
                on_wait=lambda holder: print_note(f"waiting for {holder}"),
                registry=target.registry,
            )
        if result.dry_run:
            lines = _describe_plan(result)
        else:
            lines = _describe_result(result)
            if result.complete and season is None:
                lines += recording_hint(result.split, result.size, result.root)
        print_result(result, lines, as_json=as_json, quiet=quiet)


def _refuse_board(board: Path | None) -> None:
    """Refuse a leaderboard where no season is read from it."""
    if board is not None:
        raise UsageError(
            "only a season is read from a leaderboard",
            where="--board",
            expected="--season NAME beside it",
            got=str(board),
            fix="name the season: --season NAME; or leave --board out",
        )


@dataclass(frozen=True, kw_only=True)
class GenerationTarget:
    """A data set to generate, and where it is described and kept."""

    split: str
    size: str | None
    root: str | Path | None
    registry: Registry | None


def _season_targets(
    name: str,
    board: Path | None,
    root: str | Path | None,
    split: str | None,
    size: str | None,
) -> list[GenerationTarget]:
    """Return the data sets of a season, or those of a split and size.

    Raises:
        UsageError: there is no such season, it has no such data set, or it waits for
            its random value.
    """
    from lagbench.board.folder import Folder
    from lagbench.board.season import read_season, season_registry, season_root
    from lagbench.board.season_scores import read_scores

    folder = Folder(find_board(board, reads=True))
    season = read_season(folder, name)
    scores = read_scores(folder, season)
    recorded_hashes: Mapping[tuple[str, str], Mapping[int, str]] = {}
    if scores is not None:
        recorded_hashes = scores.recorded
    registry = season_registry(season, load(), recorded_hashes, board=folder.path)
    targets = []
    known = []
    for data_set in season.data_sets:
        known.append(f"{data_set.split} {data_set.size}")
        if split in (None, data_set.split) and size in (None, data_set.size):
            targets.append(
                GenerationTarget(
                    split=data_set.split,
                    size=data_set.size,
                    root=season_root(name, root),
                    registry=registry,
                )
            )
    if not targets:
        raise UsageError(
            "the season has no such data set",
            where="--split, --size",
            expected=", ".join(known),
            got=f"{split or 'any split'} {size or 'any size'}",
            fix=f"name one of these, or leave both out; `lagbench season show {name}` "
            "describes the season",
        )
    return targets


def _describe_default_size(split: str, root: str | Path | None) -> str:
    """Return which size is taken where none is named, why, and which others there are.

    Raises:
        UsageError: there is no such split.
    """
    size, _, registry = locate_new(split, root=root)
    others = [name for name in registry.split(size.split).sizes if name != size.name]
    if not others:
        return f"{size.split} {size.name}: the only size of the split"
    return (
        f"{size.split} {size.name}: the default, since no --size is named; the others "
        f"are {' and '.join(others)}"
    )


def _describe_plan(result: GenerationResult) -> list[str]:
    if result.measured:
        source = "at the pace of this machine's last generations"
    else:
        source = "estimated; measured after the first generate"
    needed = format_bytes(result.bytes_needed)
    free = format_bytes(result.bytes_free)
    duration = format_seconds(result.seconds_expected)
    return [
        f"{result.split} {result.size}: "
        f"{format_count(len(result.simulated), 'scenario')} to simulate, "
        f"{len(result.kept)} kept",
        f"  disk    at most {needed} ({result.bytes_needed} bytes); "
        f"{free} free in {result.root}",
        f"  time    about {duration} with {result.workers} workers ({source})",
    ]


def _describe_result(result: GenerationResult) -> list[str]:
    duration = f"{result.seconds:.1f} s"
    simulated_count = len(result.simulated)
    kept_count = len(result.kept)
    if simulated_count:
        simulated = format_count(simulated_count, "scenario")
        work = f"{simulated} simulated in {duration}, {kept_count} kept"
    else:
        work = (
            f"nothing to simulate, {format_count(kept_count, 'scenario')} kept; "
            f"checked in {duration}"
        )
    lines = [
        f"{result.split} {result.size}: {work}",
        f"  folder  {result.folder}",
    ]
    url = url_of(result.root)
    if url is not None:
        folder = result.folder.relative_to(result.root).as_posix()
        lines.append(f"  store   {hide_credentials(url)}/{folder}")
    if result.missing:
        missing_ids = format_ids(result.missing)
        lines.append(f"  missing {missing_ids}: the data set is incomplete")
    if result.dataset_sha256:
        lines.append(f"  hash    {result.dataset_sha256}")
    lines.append(f"  check   {result.verdict}")
    return lines
