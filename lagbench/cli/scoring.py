"""Commands around submissions: template, validate, score, compare."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lagbench.errors import UsageError

from .options import (
    JsonFlag,
    PresentSizeOption,
    QuietFlag,
    RootOption,
    SchedulerOption,
    SplitArgument,
    SplitOption,
    WorkersOption,
    chosen,
    option,
)
from .output import (
    complain,
    counted,
    print_blocks,
    print_json,
    progress_bar,
    say,
    show,
    spell_bytes,
)

if TYPE_CHECKING:
    from lagbench.scoring.card import ScoreCard
    from lagbench.submission.issues import ValidationResult

OwnSplitOption = Annotated[
    str | None,
    option("--split NAME", "Split that they must be for; a local one by its folder."),
]
EveryFlag = Annotated[bool, option("--all", "Show every metric.")]


def template(
    name: SplitArgument = None,
    split: SplitOption = None,
    size: PresentSizeOption = None,
    output: Annotated[Path, option("--output -o FILE", "File to write.")] = Path(
        "predictions.nc"
    ),
    overwrite: Annotated[
        bool, option("--overwrite", "Replace a file of that name.")
    ] = False,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Write a valid predictions.nc to fill: the persistence prediction."""
    from lagbench.submission.writer import template as run

    result = run(
        chosen(name, split), size, output=output, overwrite=overwrite, root=root
    )
    first, last = result.frames
    shape = f"{len(result.scenarios)} scenarios, frames {first} to {last}, {result.particles} particles"
    words = [f"{result.path}: {shape}, {spell_bytes(result.bytes)}"]
    show(result, words, as_json=as_json, quiet=quiet)


def validate(
    predictions: Annotated[
        Path, typer.Argument(metavar="FILE", help="A predictions.nc.")
    ],
    split: OwnSplitOption = None,
    root: RootOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Check a predictions.nc and say all that is wrong with it and how to mend it."""
    from lagbench.submission.validation import validate as run

    root, check = _wanted(split, root)
    result = run(predictions, root=root)
    check(result)
    words = [str(finding) for finding in result.findings]
    for reason in dict.fromkeys(result.skipped.values()):
        checks = ", ".join(
            check for check, why in result.skipped.items() if why == reason
        )
        words.append(f"not made, since {reason}: {checks}")
    counts = (
        f"{counted(len(result.errors), 'error')}, "
        f"{counted(len(result.warnings), 'warning')}, "
        f"{counted(len(result.passed), 'check')} passed"
    )
    words.append(f"{result.path}: {result.verdict}, {counts}")
    show(result, words, as_json=as_json, quiet=quiet)
    raise typer.Exit(result.exit_code)


def score(
    predictions: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...", help="A predictions.nc; several with --report."
        ),
    ],
    split: OwnSplitOption = None,
    root: RootOption = None,
    output: Annotated[
        Path | None,
        option(
            "--output -o FOLDER",
            "Where scores go; beside predictions.nc by default, of other and of "
            "several files in folders"
            " named like them.",
        ),
    ] = None,
    report: Annotated[
        Path | None,
        option("--report FOLDER", "Write index.html with all figures there."),
    ] = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    extras: Annotated[
        str, option("--extras NAMES", "Extras with metrics, as in transport.")
    ] = "",
    every: EveryFlag = False,
    floors: Annotated[
        bool, option("--all-floors", "Show every floor, not only the best.")
    ] = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Score a predictions.nc beside its floors; write scores.json and scores.nc."""
    from lagbench.scoring.score import score as run

    if len(predictions) > 1 and report is None:
        raise UsageError(
            "several files are scored for one report", fix="add --report FOLDER"
        )
    targets, (root, check) = _targets(predictions, output), _wanted(split, root)

    def examined(result: ValidationResult) -> None:
        check(result)
        complain(result)

    together = _checked_together(predictions, root) if len(predictions) > 1 else [None]
    if report is not None:
        from lagbench.figures.report.report import check_folder

        check_folder(report)
    cards: list[ScoreCard] = []
    for path, target, validated in zip(predictions, targets, together, strict=True):
        with progress_bar(quiet=quiet) as draw:
            card = run(
                path,
                root=root,
                output_dir=target,
                workers=workers,
                scheduler=scheduler,
                extras=tuple(name for name in extras.split(",") if name),
                progress=draw,
                examined=examined,
                validated=validated,
            )
        cards.append(card)
    written = None
    try:
        if (
            report is not None
        ):  # before a word is printed: a reader such as head may close the pipe
            from lagbench.figures.report.report import write_report

            written = write_report(report, cards, predictions, root=root)
    finally:
        if as_json:
            print_json(
                cards[0].as_json()
                if len(cards) == 1
                else [card.as_json() for card in cards]
            )
        elif not quiet:
            from lagbench.scoring.tables import card_tables, flag_lines

            for card in cards:
                print_blocks(card_tables(card, every=every, floors=floors))
                for line in flag_lines(card):
                    say(line)
                say("written: " + ", ".join(str(path) for path in card.files))
    if written is not None:
        say(f"report: {written}", quiet=quiet or as_json)


def _targets(predictions: Sequence[Path], output: Path | None) -> Sequence[Path | None]:
    """Return the folder for the scores of each file; refuse two files with one
    folder.
    """
    if len(predictions) == 1:
        return [output]
    targets = [(output or path.parent) / path.stem for path in predictions]
    held: dict[Path, Path] = {}
    for path, target in zip(predictions, targets, strict=True):
        other = held.setdefault(target.resolve(), path)
        if other is not path:
            raise UsageError(
                "the scores of two files would go to one folder",
                where=str(target),
                got=f"{other} and {path}",
                fix="name each file once, give them names of their own, or leave "
                "--output out",
            )
    return targets


def _checked_together(
    predictions: Sequence[Path], root: Path | None
) -> list[ValidationResult]:
    """Refuse, before any is scored, an invalid file and one to another split or
    size.
    """
    from lagbench.submission.validation import validate as examine

    results: list[ValidationResult] = []
    for path in predictions:
        result = examine(path, root=root, require_truth=True)
        complain(result)
        result.check()
        results.append(result)
        first = results[0]
        if (result.split, result.size) != (first.split, first.size):
            raise UsageError(
                "one report, two data sets",
                where=str(path),
                expected=f"{first.split} {first.size}, as in {first.path}",
                got=f"{result.split} {result.size}",
                fix="report submissions to one data set together, others on their own",
            )
    return results


def _wanted(
    split: str | None, root: Path | None
) -> tuple[Path | None, Callable[[ValidationResult], None]]:
    """Return the root, which the path of a local split names, and what refuses
    predictions for another.
    """
    name = None
    if split is not None:
        from lagbench.data.local import locate_split

        name, root, _ = locate_split(split, root=root)

    def check(result: ValidationResult) -> None:
        if name is not None and result.split not in (None, name):
            what = "the predictions are for another split"
            fix = "name that one, or leave --split out"
            raise UsageError(
                what,
                where=str(result.path),
                expected=name,
                got=ascii(result.split),
                fix=fix,
            )

    return root, check


def compare(
    first: Annotated[
        str,
        typer.Argument(
            metavar="A",
            help="scores.json or .nc, a folder of one or of seeds, predictions.nc.",
        ),
    ],
    second: Annotated[
        str, typer.Argument(metavar="B", help="Another, or the name of a floor.")
    ],
    metric: Annotated[
        list[str] | None, option("--metric NAME", "Metric to compare by; repeatable.")
    ] = None,
    root: RootOption = None,
    workers: WorkersOption = None,
    every: EveryFlag = False,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Compare two methods over scenarios, and over seeds where there are several: tests
    and intervals.
    """
    from lagbench.scoring.compare import compare as run

    result = run(first, second, metrics=metric or (), root=root, workers=workers)
    if as_json:
        print_json(result.as_json())
    elif not quiet:
        from lagbench.scoring.tables import comparison_tables

        if result.namesakes:
            say(f"{result.first}: {first}")
            say(f"{result.second}: {second}")
        print_blocks(comparison_tables(result, every=every or bool(metric)))
        say(result.verdict)
