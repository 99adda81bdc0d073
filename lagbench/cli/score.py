"""The command score."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from lagbench.data.local import locate_split
from lagbench.errors import UsageError
from lagbench.figures.report.report import check_folder, write_report
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import check_extras, score
from lagbench.scoring.tables import brief_table, card_lines, card_tables

from .options import (
    ExpectedSplitOption,
    JsonFlag,
    OutputOption,
    QuietFlag,
    RootOption,
    SchedulerOption,
    WorkersOption,
)
from .output import print_errors, print_json, print_line, print_tables, progress_bar


def score_command(
    predictions: list[Path],
    /,
    *,
    split: ExpectedSplitOption = None,
    root: RootOption = None,
    output: OutputOption = None,
    report: Path | None = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    extras: str = "",
    every: Annotated[bool, Parameter(name="--all")] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Score a predictions.nc; write scores.json and scores.nc.

    It shows the skill and the first metrics beside those of the best reference
    predictor.

    Args:
        predictions: A predictions.nc; several with --report.
        output: Folder of the scores; by default gns/ beside gns.nc.
        report: Write index.html with all figures there.
        extras: Also compute the metrics of these extras, as in transport.
        every: Show every metric, frame of interest, scenario and reference predictor.
    """
    extra_names = tuple(name for name in extras.split(",") if name)
    check_extras(extra_names)
    if len(predictions) > 1 and report is None:
        raise UsageError(
            "several files are scored together for a report only; add --report FOLDER, "
            "or score one after the other",
            where="FILE",
        )
    if len(predictions) > 1 and output is not None:
        raise UsageError(
            "the scores of several files lie beside each of them; leave it out",
            where="--output",
        )
    data_root: str | Path | None = root
    if split is not None:
        data_root = locate_split(split, root=root).root
    if report is not None:
        check_folder(report)

    cards = []
    for path in predictions:
        with progress_bar(quiet=quiet) as progress:
            card = score(
                path,
                split=split,
                root=data_root,
                output_dir=output,
                workers=workers,
                scheduler=scheduler,
                extras=extra_names,
                progress=progress,
                examined=print_errors,
            )
        cards.append(card)

    page = None
    try:
        # The report comes before the first printed word: a reader such as head may
        # close the pipe.
        if report is not None:
            page = write_report(report, cards, predictions, root=data_root)
    finally:
        if as_json:
            values = [card.as_json() for card in cards]
            print_json(values[0] if len(values) == 1 else values)
        elif not quiet:
            _print_cards(cards, every=every)
    if page is not None:
        print_line(f"report: {page}", quiet=quiet or as_json)


def _print_cards(cards: Sequence[ScoreCard], *, every: bool) -> None:
    for card in cards:
        if every:
            print_tables(card_tables(card))
        else:
            print_tables([brief_table(card)])
        for line in card_lines(card, every=every):
            print_line(line)
        print_line(f"written: {', '.join(map(str, card.files))}")
    if not every:
        print_line("more: --all shows every metric, frame of interest and scenario")
