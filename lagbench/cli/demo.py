"""The command that shows everything once: demo."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import typer

from .options import JsonFlag, QuietFlag, RootOption, WorkersOption
from .output import print_table, progress_bar, show, spell_seconds

if TYPE_CHECKING:
    from .demo_steps import DemoResult, ModelResult

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

    from . import demo_steps as steps

    started = time.monotonic()
    registry = load()
    left_out = steps.model_left_out(registry)
    if left_out is None:
        steps.demo_board(root)
    splits: dict[str, DemoResult] = {}
    for split in steps.demo_splits(registry):
        if not quiet:
            typer.echo(f"{split}: generating, verifying, drawing", err=True)
        with progress_bar(quiet=quiet) as draw:
            splits[split] = steps.demo(split, root=root, workers=workers, progress=draw)
    if not (as_json or quiet):
        rows = [
            (split, (one.generation.dataset_sha256 or "")[:16], one.verification.verdict, one.picture)
            for split, one in splits.items()
        ]
        print_table("", ("split", "hash", "data set", "picture"), rows)
    model = None
    if left_out is None:
        if not quiet:
            what = f"training {steps.MODEL}, predicting, scoring, submitting"
            typer.echo(f"{steps.MODEL_SPLIT}: {what}", err=True)
        with progress_bar(quiet=quiet, counted="done") as draw:
            model = steps.demo_model(root=root, progress=draw)
    seconds = time.monotonic() - started
    made = None if model is None else model.as_json()
    value = {"splits": splits, "model": made, "model_left_out": left_out, "seconds": seconds}
    show(value, _summary(len(splits), model, left_out, seconds), as_json=as_json, quiet=quiet)


def _summary(splits: int, model: ModelResult | None, left_out: str | None, seconds: float) -> Iterator[str]:
    done = f"{splits} data sets, verified and drawn"
    if model is None:
        yield f"{done}, in {spell_seconds(seconds)}"
        yield f"no model, no leaderboard: {left_out}"
    else:
        card, training = model.card, model.training
        names = tuple(dict.fromkeys((card.ranking, *METRICS)))
        rows = []
        for row, scores in card.scores.items():
            means = [scores[name].mean for name in names]
            spelt = ["-" if math.isnan(mean) else f"{mean:.4g}" for mean in means]
            rows.append((training.baseline if row == "submission" else row, *spelt))
        what = f"{training.baseline}, {training.steps} steps, on {training.split} {training.size}"
        print_table(f"{what}, test scenarios", ("method", *names), rows)
        yield f"{done}; a model trained, predicted, scored and submitted; in {spell_seconds(seconds)}"
        yield f"leaderboard page: {model.page.page}"
    yield "next: lagbench generate --split cavity --size mini"
