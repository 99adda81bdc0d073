"""The command that shows everything once, from nothing to a leaderboard: demo.

Data at size ``tiny``, a trained model, its scores, a page. Everything lies under one
root folder, which the demo may fill as it likes: the data sets, ``pictures/``,
``runs/`` and a leaderboard of its own, never the one of the repository.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    check_installed,
)

from .options import JsonFlag, QuietFlag, RootOption, WorkersOption
from .output import print_table, progress_bar, show, spell_seconds

if TYPE_CHECKING:
    from lagbench.baselines.predict import PredictionResult
    from lagbench.baselines.train import TrainingResult
    from lagbench.board.build import BuildResult
    from lagbench.board.publish import SubmitResult
    from lagbench.data.registry import Registry
    from lagbench.make.generate import GenerationResult
    from lagbench.make.verify import VerificationResult
    from lagbench.scoring.card import ScoreCard
    from lagbench.work.progress import Progress

    from .machine import SolverBench


DEMO_SIZE = "tiny"
MODEL = "neuralmpm"
# the baseline that the demo trains, and the split that it learns
MODEL_SPLIT = "cavity"
SETTINGS = ("training.steps=150",)
"""Changes to the recipe of size tiny: half a minute, and better than what costs no
learning with any seed.
"""

METRICS = ("position_rmse_20", "vorticity_pearson", "outside_share")
"""What the table of scores shows beside the metric that ranks."""


@dataclass(frozen=True, kw_only=True)
class DemoResult:
    """One split of the demo: what was generated, how it verified, and its picture."""

    generation: GenerationResult  # result of generate
    verification: VerificationResult  # result of verify
    picture: Path  # PNG of the first test scenario at its last frame of interest


@dataclass(frozen=True, kw_only=True)
class ModelResult:
    """The model of the demo: how it was trained, what it predicted, how it scored, the
    page.
    """

    training: TrainingResult  # result of train
    prediction: PredictionResult  # result of predict
    card: ScoreCard  # its scores beside those of the floors
    # what our solver takes here; None where it cannot be timed
    solver: SolverBench | None
    entry: SubmitResult  # its entry of the leaderboard
    page: BuildResult  # the leaderboard's page


def demo_splits(registry: Registry) -> list[str]:
    """Return the splits that have a size ``tiny``; those of other packages need not."""
    return [name for name, split in registry.splits.items() if DEMO_SIZE in split.sizes]


def demo_split(
    split: str,
    *,
    root: str | Path | None = None,
    workers: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> DemoResult:
    """Generate, verify and draw one split at size ``tiny``; the picture lies in
    ``pictures/`` of the root.
    """
    from lagbench.data.local import resolve_root
    from lagbench.data.registry import load
    from lagbench.figures.plot import plot_frame
    from lagbench.make.generate import generate
    from lagbench.make.verify import verify

    folder = resolve_root(root)
    size = load().size(split, DEMO_SIZE)
    generation = generate(
        split, DEMO_SIZE, root=folder, workers=workers, progress=progress
    )
    verification = verify(split, DEMO_SIZE, root=folder, complete=True)
    verification.check()
    pictures = folder / "pictures"
    pictures.mkdir(exist_ok=True)
    first = size.subsets["test"][0]
    frame = size.task.frames_of_interest[-1]
    picture = plot_frame(size.path(folder, first), frame, pictures / f"{split}.png")
    return DemoResult(generation=generation, verification=verification, picture=picture)


def model_left_out(registry: Registry) -> str | None:
    """Return why there can be no model, and what helps; None where there can be one."""
    if MODEL_SPLIT not in demo_splits(registry):
        return f"the registry has no {MODEL_SPLIT} {DEMO_SIZE}"
    try:
        for module in ("torch", "torch_geometric", "lightning_fabric"):
            check_installed(module, extra="baselines")
    except UsageError as error:
        return f"{error.what}; {error.fix}"
    return None


def demo_board(root: str | Path | None = None) -> Path:
    """Return the folder of the demo's leaderboard; refuse one with entries of other
    sizes.
    """
    from lagbench.board.folder import Folder
    from lagbench.data.local import resolve_root

    board = Folder(resolve_root(root) / "leaderboard")
    others = [path for path in board.entries() if path.parts[2] != DEMO_SIZE]
    if others:
        raise UsageError(
            "the demo would write into another leaderboard",
            where=str(board.path),
            expected=f"entries of size {DEMO_SIZE} only, or none",
            got=others[0].as_posix(),
            fix="give the demo a folder of its own: --root demo",
        )
    return board.path


def demo_model(
    *,
    root: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> ModelResult:
    """Train a small model, predict, score and submit it, draw the page.

    The data set must be there, see :func:`demo_split`. One thread: a model as small as
    this gains nothing by a second, and the same machine trains the same weights.
    Interrupted, it goes on with the training at the next call.
    """
    from lagbench.baselines.catalogue import find
    from lagbench.baselines.predict import predict
    from lagbench.baselines.train import train
    from lagbench.board.build import build
    from lagbench.board.entry import Meta
    from lagbench.board.submit import submit
    from lagbench.data.checksums import round_digits
    from lagbench.data.local import resolve_root
    from lagbench.scoring.score import score

    folder = resolve_root(root)
    board = demo_board(root)
    run = folder / "runs" / f"{MODEL_SPLIT}-{MODEL}"
    here: dict[str, Any] = {
        "root": folder,
        "device": "cpu",
        "threads": 1,
        "progress": progress,
    }
    begin = partial(
        train, MODEL, MODEL_SPLIT, DEMO_SIZE, settings=SETTINGS, output=run, **here
    )
    try:
        training = begin()
    except (UsageError, DataError, UnreadableFileError):
        # What is left of another version or was damaged is the demo's own: not worth an
        # error.
        training = begin(fresh=True)
    prediction = predict(training.weights, run / "predictions.nc", method=MODEL, **here)
    solver = _solver_time()
    said = Meta(
        method=MODEL,
        name=f"{find(MODEL).model.method}, {training.steps} steps",
        authors=("lagbench demo",),
        licence="MIT",
        notes="Trained for seconds to show the way; it says little of what such a "
        "model can do.",
        hardware=prediction.device,
        command="lagbench demo",
        solver_seconds_per_frame=None
        if solver is None
        else round_digits(solver.seconds_per_frame, 6),
    )
    entry = submit(
        [prediction.path], said, board=board, root=folder, replace=True, new_board=True
    )
    return ModelResult(
        training=training,
        prediction=prediction,
        card=score(prediction.path, root=folder),
        solver=solver,
        entry=entry,
        page=build(board),
    )


def _solver_time() -> SolverBench | None:
    from .machine import bench_apart

    try:
        return bench_apart(MODEL_SPLIT, DEMO_SIZE)
    except LagbenchError:
        return None


def demo(
    root: RootOption = None,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """From nothing to data sets, a trained model, its scores and a leaderboard page."""
    from lagbench.data.registry import load

    started = time.monotonic()
    registry = load()
    left_out = model_left_out(registry)
    if left_out is None:
        demo_board(root)
    splits: dict[str, DemoResult] = {}
    for split in demo_splits(registry):
        if not quiet:
            typer.echo(f"{split}: generating, verifying, drawing", err=True)
        with progress_bar(quiet=quiet) as draw:
            splits[split] = demo_split(split, root=root, workers=workers, progress=draw)
    if not (as_json or quiet):
        rows = [
            (
                split,
                (one.generation.dataset_sha256 or "")[:16],
                one.verification.verdict,
                one.picture,
            )
            for split, one in splits.items()
        ]
        print_table("", ("split", "hash", "data set", "picture"), rows)
    model = None
    if left_out is None:
        if not quiet:
            what = f"training {MODEL}, predicting, scoring, submitting"
            typer.echo(f"{MODEL_SPLIT}: {what}", err=True)
        with progress_bar(quiet=quiet, counted="done") as draw:
            model = demo_model(root=root, progress=draw)
    seconds = time.monotonic() - started
    if model is None:
        made = None
    else:
        made = {**vars(model), "card": model.card.as_json()}
    value = {
        "splits": splits,
        "model": made,
        "model_left_out": left_out,
        "seconds": seconds,
    }
    show(
        value,
        _summary(len(splits), model, left_out, seconds),
        as_json=as_json,
        quiet=quiet,
    )


def _summary(
    splits: int, model: ModelResult | None, left_out: str | None, seconds: float
) -> Iterator[str]:
    done = f"{splits} data sets, verified and drawn"
    if model is None:
        yield f"{done}, in {spell_seconds(seconds)}"
        yield f"no model, no leaderboard: {left_out}"
    else:
        card = model.card
        training = model.training
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
