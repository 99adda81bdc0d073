"""The command that shows everything once: demo."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from .options import JsonFlag, QuietFlag, RootOption, WorkersOption
from .output import print_json, print_table, progress_bar, say, spell_seconds

if TYPE_CHECKING:
    from .demo_steps import DemoResult, ModelResult

__all__ = ["demo"]

METRICS = ("position_rmse_20", "vorticity_pearson", "outside_share")
"""What the table of scores shows beside the metric that ranks."""


def demo(
    root: RootOption = None,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """From nothing to data sets, a trained model, its scores and a leaderboard page."""
    from lagbench.data.registry import load

    from .demo_steps import demo_board, demo_splits, model_left_out

    started = time.monotonic()
    registry = load()
    left_out = model_left_out(registry)
    if left_out is None:
        demo_board(root)
    splits = _data(demo_splits(registry), root, workers, quiet=quiet)
    if not (as_json or quiet):
        _show_data(splits)
    model = _model(root, quiet=quiet) if left_out is None else None
    seconds = time.monotonic() - started
    if as_json:
        made = None if model is None else model.as_json()
        print_json({"splits": splits, "model": made, "model_left_out": left_out, "seconds": seconds})
        return
    if model is not None and not quiet:
        _show_model(model)
    say("\n".join(_summary(len(splits), model, left_out, seconds)), quiet=quiet)


def _data(names: list[str], root: Path | None, workers: int | None, *, quiet: bool) -> dict[str, DemoResult]:
    from .demo_steps import demo as run

    results = {}
    for split in names:
        if not quiet:
            typer.echo(f"{split}: generating, verifying, drawing", err=True)
        with progress_bar(quiet=quiet) as draw:
            results[split] = run(split, root=root, workers=workers, progress=draw)
    return results


def _model(root: Path | None, *, quiet: bool) -> ModelResult:
    from .demo_steps import MODEL, MODEL_SPLIT, demo_model

    if not quiet:
        typer.echo(f"{MODEL_SPLIT}: training {MODEL}, predicting, scoring, submitting", err=True)
    with progress_bar(quiet=quiet, counted="done") as draw:
        return demo_model(root=root, progress=draw)


def _show_data(splits: Mapping[str, DemoResult]) -> None:
    rows = [
        (split, (one.generation.dataset_sha256 or "")[:16], one.verification.verdict, one.picture)
        for split, one in splits.items()
    ]
    print_table("", ("split", "hash", "data set", "picture"), rows)


def _show_model(model: ModelResult) -> None:
    """Print how the model was trained, and its scores beside the floors'."""
    card, training = model.card, model.training
    names = tuple(dict.fromkeys((card.ranking, *METRICS)))
    rows = [
        (training.baseline if row == "submission" else row, *(_spelt(scores[name].mean) for name in names))
        for row, scores in card.scores.items()
    ]
    title = (
        f"{training.baseline}, {training.steps} steps, on {training.split} {training.size}, test scenarios"
    )
    print_table(title, ("method", *names), rows)


def _spelt(value: float) -> str:
    return "-" if value != value else f"{value:.4g}"


def _summary(splits: int, model: ModelResult | None, left_out: str | None, seconds: float) -> Iterator[str]:
    yield (
        f"{splits} data sets, verified and drawn, in {spell_seconds(seconds)}"
        if model is None
        else (
            f"{splits} data sets, verified and drawn; a model trained, predicted, scored and submitted;"
            f" in {spell_seconds(seconds)}"
        )
    )
    if model is None:
        yield f"no model, no leaderboard: {left_out}"
    else:
        yield f"leaderboard page: {model.page.page}"
    yield "next: lagbench generate --split cavity --size mini"
