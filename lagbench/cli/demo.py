"""The command demo: from nothing to data sets, a trained model and a leaderboard.

Everything lies under one root folder: the data sets of size ``tiny``, ``pictures/``,
``runs/``, and a leaderboard of the demo's own, never that of the repository.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.board.entry import Meta
from lagbench.board.folder import Folder
from lagbench.board.page import BuildResult, build
from lagbench.board.submit import SubmitResult, submit
from lagbench.data.checksums import round_digits
from lagbench.data.local import resolve_root
from lagbench.data.registry import Registry, load
from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
)
from lagbench.figures.canvas import save
from lagbench.figures.plot import draw_frame
from lagbench.make.generate import GenerationResult, generate
from lagbench.make.verify import VerificationResult, verify
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score
from lagbench.work.run import Progress

from .model_options import TRAINING_LIBRARIES, require_libraries
from .options import JsonFlag, QuietFlag, RootOption, WorkersOption
from .output import format_seconds, print_result, print_table, progress_bar
from .solver_bench import SolverBench, bench_in_own_process
from .stderr import print_on_stderr

if TYPE_CHECKING:
    from lagbench.baselines.predict import PredictionResult
    from lagbench.baselines.train import TrainingResult

DEMO_SIZE = "tiny"
# the reference model that the demo trains, and the split that it learns
MODEL = "neuralmpm"
MODEL_SPLIT = "cavity"
SETTINGS = ("training.steps=150",)
"""Changes to the recipe of size tiny.

So many steps take half a minute. With any seed the model then beats the naive
baselines.
"""

NOT_IN_DEMO = (
    "decaying-vortices",
    "poiseuille",
    "curl-noise-3d",
    "cavity-3d",
    "fluid-3d",
    "multimaterial-3d",
    "cylinder",
)
"""Splits whose kernels the demo would have to compile besides."""

METRICS = ("position_rmse_20", "vorticity_pearson", "outside_share")
"""Metrics that the table of scores shows beside the one that ranks."""


@dataclass(frozen=True, kw_only=True)
class DemoResult:
    """One split of the demo."""

    generation: GenerationResult
    verification: VerificationResult
    picture: Path  # PNG of the first test scenario at its last frame of interest


@dataclass(frozen=True, kw_only=True)
class ModelResult:
    """The model of the demo, from its training to the leaderboard's page."""

    training: TrainingResult
    prediction: PredictionResult
    card: ScoreCard  # its scores beside those of the reference predictors
    # cost of our solver on this machine; None where it cannot be timed
    solver: SolverBench | None
    entry: SubmitResult
    page: BuildResult


def demo_command(
    *,
    root: RootOption = None,
    workers: WorkersOption = None,
    as_json: JsonFlag = False,
    quiet: QuietFlag = False,
) -> None:
    """Make data sets, train a model, score it and draw a leaderboard page.

    An interrupted call goes on where it stopped.
    """
    start = time.monotonic()
    registry = load()
    model_left_out = explain_missing_model(registry)
    if model_left_out is None:
        demo_board(root)

    splits: dict[str, DemoResult] = {}
    for split in demo_splits(registry):
        if not quiet:
            print_on_stderr(f"{split}: generating, verifying, drawing")
        with progress_bar(quiet=quiet) as progress:
            splits[split] = demo_split(
                split, root=root, workers=workers, progress=progress
            )
    if not (as_json or quiet):
        _print_splits(splits)

    model = None
    if model_left_out is None:
        if not quiet:
            steps = f"training {MODEL}, predicting, scoring, submitting"
            print_on_stderr(f"{MODEL_SPLIT}: {steps}")
        with progress_bar(quiet=quiet, unit="done") as progress:
            model = demo_model(root=root, progress=progress)

    seconds = time.monotonic() - start
    model_value = None
    if model is not None:
        model_value = {**vars(model), "card": model.card.as_json()}
    value = {
        "splits": splits,
        "model": model_value,
        "model_left_out": model_left_out,
        "seconds": seconds,
    }
    print_result(
        value,
        _describe(len(splits), model, model_left_out=model_left_out, seconds=seconds),
        as_json=as_json,
        quiet=quiet,
    )


def demo_splits(registry: Registry) -> list[str]:
    """Return the splits that have a size ``tiny``; those of other packages need not.

    Our splits of periodic and solid boxes are left out, so that the demo stays short.
    """
    names = []
    for name, split in registry.splits.items():
        if DEMO_SIZE in split.sizes and name not in NOT_IN_DEMO:
            names.append(name)
    return names


def demo_split(
    split: str,
    *,
    root: str | Path | None = None,
    workers: int | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> DemoResult:
    """Generate and verify one split at size ``tiny``, and draw it into ``pictures/``.

    Args:
        split: name of the split.
        root: folder of all data sets.
        workers: worker processes; one per core when None.
        progress: called as the generation advances.
    """
    folder = resolve_root(root)
    size = load().size(split, DEMO_SIZE)
    generation = generate(
        split, DEMO_SIZE, root=folder, workers=workers, progress=progress
    )
    verification = verify(split, DEMO_SIZE, root=folder, complete=True)
    verification.check()

    picture_folder = folder / "pictures"
    picture_folder.mkdir(exist_ok=True)
    scenario_file = size.path(folder, size.subsets["test"][0])
    frame = size.task.frames_of_interest[-1]
    drawn = draw_frame(scenario_file, frame)
    picture = save(drawn, picture_folder / f"{split}.png")
    return DemoResult(generation=generation, verification=verification, picture=picture)


def explain_missing_model(registry: Registry) -> str | None:
    """Return why there can be no model, and what helps; None where there can be one."""
    if MODEL_SPLIT not in demo_splits(registry):
        return f"the registry has no {MODEL_SPLIT} {DEMO_SIZE}"
    try:
        require_libraries(TRAINING_LIBRARIES)
    except UsageError as error:
        return error.text
    return None


def demo_board(root: str | Path | None = None) -> Path:
    """Return the folder of the demo's leaderboard.

    Raises:
        UsageError: the leaderboard there has entries of other sizes.
    """
    board = Folder(resolve_root(root) / "leaderboard")
    for entry in board.entries():
        if entry.parts[2] != DEMO_SIZE:
            raise UsageError(
                "the demo would write into another leaderboard: got "
                f"{entry.as_posix()}, expected entries of size {DEMO_SIZE} only, or "
                "none; give the demo a folder of its own: --root demo",
                where=str(board.path),
            )
    return board.path


def demo_model(
    *,
    root: str | Path | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> ModelResult:
    """Train a small model, predict, score and submit, and draw the leaderboard's page.

    :func:`demo_split` makes the data set before. The model is so small that a second
    thread gains nothing, and with one thread the same machine trains the same weights.
    An interrupted training goes on at the next call.
    """
    from lagbench.baselines.catalogue import find
    from lagbench.baselines.predict import predict

    folder = resolve_root(root)
    board = demo_board(root)
    run_folder = folder / "runs" / f"{MODEL_SPLIT}-{MODEL}"
    training = _train_model(folder, run_folder, progress)
    prediction = predict(
        training.weights,
        run_folder / "predictions.nc",
        overwrite=True,
        method=MODEL,
        root=folder,
        device="cpu",
        threads=1,
        progress=progress,
    )
    solver = bench_demo_solver()
    solver_seconds = None
    if solver is not None:
        solver_seconds = round_digits(solver.seconds_per_frame, 6)
    meta = Meta(
        method=MODEL,
        name=f"{find(MODEL).model.method}, {training.steps} steps",
        authors=("lagbench demo",),
        licence="MIT",
        notes="Trained for seconds to show the way; it says little of what such a "
        "model can do.",
        hardware=prediction.device,
        command="lagbench demo",
        solver_seconds_per_frame=solver_seconds,
    )
    entry = submit(
        [prediction.path], meta, board=board, root=folder, replace=True, new_board=True
    )
    return ModelResult(
        training=training,
        prediction=prediction,
        card=score(prediction.path, root=folder),
        solver=solver,
        entry=entry,
        page=build(board),
    )


def _train_model(
    folder: Path,
    run_folder: Path,
    progress: Callable[[Progress], None] | None,
) -> TrainingResult:
    """Train the model; files of another version or damaged ones are trained anew."""
    from lagbench.baselines.train import train

    train_model = partial(
        train,
        MODEL,
        MODEL_SPLIT,
        DEMO_SIZE,
        settings=SETTINGS,
        root=folder,
        output=run_folder,
        device="cpu",
        threads=1,
        progress=progress,
    )
    try:
        return train_model()
    except (UsageError, DataError, UnreadableFileError):
        # The folder is the demo's own: an earlier training there is not worth an error.
        return train_model(fresh=True)


def bench_demo_solver() -> SolverBench | None:
    """Return the cost of our solver; without it the page shows no speed-up."""
    try:
        return bench_in_own_process(MODEL_SPLIT, DEMO_SIZE)
    except LagbenchError:
        return None


def _print_splits(splits: Mapping[str, DemoResult]) -> None:
    rows = []
    for split, result in splits.items():
        sha256 = result.generation.dataset_sha256 or ""
        rows.append((split, sha256[:16], result.verification.verdict, result.picture))
    print_table("", ("split", "hash", "data set", "picture"), rows)


def _describe(
    split_count: int,
    model: ModelResult | None,
    *,
    model_left_out: str | None,
    seconds: float,
) -> Iterator[str]:
    """Print the table of scores, if there is a model, then yield the lines below it."""
    work = f"{split_count} data sets, verified and drawn"
    duration = format_seconds(seconds)
    if model is None:
        yield f"{work}, in {duration}"
        yield f"no model, no leaderboard: {model_left_out}"
    else:
        _print_scores(model)
        yield (
            f"{work}; a model trained, predicted, scored and submitted; in {duration}"
        )
        yield f"leaderboard page: {model.page.page}"
    yield "next: lagbench generate --split cavity --size mini"


def _print_scores(model: ModelResult) -> None:
    training = model.training
    card = model.card
    metrics = tuple(dict.fromkeys((card.ranking, *METRICS)))
    rows = []
    for row_name, scores in card.scores.items():
        method = row_name
        if row_name == "submission":
            method = training.baseline
        cells = [_format_mean(scores[metric].mean) for metric in metrics]
        rows.append((method, *cells))
    title = (
        f"{training.baseline}, {training.steps} steps, on {training.split} "
        f"{training.size}, test scenarios"
    )
    print_table(title, ("method", *metrics), rows)


def _format_mean(mean: float) -> str:
    if math.isnan(mean):
        return "-"
    return f"{mean:.4g}"
