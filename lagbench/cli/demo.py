"""The command demo: from nothing to data sets, a trained model and a leaderboard.

Everything lies under one root folder: the data sets of size ``tiny``, ``pictures/``,
``runs/``, and a leaderboard of the demo's own, never that of the repository.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lagbench.board.entry import Meta
from lagbench.board.folder import Folder
from lagbench.board.page import build
from lagbench.board.submit import submit
from lagbench.data.checksums import round_digits
from lagbench.data.local import resolve_root
from lagbench.data.registry import load
from lagbench.errors import DataError, UnreadableFileError, UsageError
from lagbench.figures.canvas import save
from lagbench.figures.plot import draw_frame
from lagbench.make.generate import generate
from lagbench.make.verify import verify
from lagbench.scoring.card import ScoreCard
from lagbench.scoring.score import score

from .model_options import TRAINING_LIBRARIES, require_libraries
from .options import JsonFlag, QuietFlag, RootOption, WorkersOption
from .output import Listener, format_seconds, print_result, print_table, progress_bar
from .solver_bench import try_bench
from .stderr import print_on_stderr

SPLITS = ("cavity", "curl-noise", "fluid", "multimaterial")
SIZE = "tiny"
MODEL = "neuralmpm"
MODEL_SPLIT = "cavity"
SETTINGS = ("training.steps=150",)
"""Changes to the recipe of size tiny.

So many steps take half a minute. With any seed the model then beats the naive
baselines.
"""

METRICS = ("position_rmse_20", "vorticity_pearson", "outside_share")
"""Metrics that the table of scores shows beside the one that ranks."""


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
    folder = resolve_root(root)
    model_left_out = None
    try:
        require_libraries(TRAINING_LIBRARIES)
        _refuse_other_board(folder)
    except ImportError as error:
        model_left_out = str(error)

    splits: dict[str, dict[str, Any]] = {}
    for split in SPLITS:
        if not quiet:
            print_on_stderr(f"{split}: generating, verifying, drawing")
        with progress_bar(quiet=quiet) as progress:
            splits[split] = _make_split(split, folder, workers, progress)
    if not (as_json or quiet):
        rows = []
        for split, result in splits.items():
            sha256 = result["generation"].dataset_sha256 or ""
            verdict = result["verification"].verdict
            rows.append((split, sha256[:16], verdict, result["picture"]))
        print_table("", ("split", "hash", "data set", "picture"), rows)

    model = None
    if model_left_out is None:
        if not quiet:
            steps = f"training {MODEL}, predicting, scoring, submitting"
            print_on_stderr(f"{MODEL_SPLIT}: {steps}")
        with progress_bar(quiet=quiet, unit="done") as progress:
            model = _make_model(folder, progress)

    seconds = time.monotonic() - start
    value = {
        "splits": splits,
        "model": model and {**model, "card": model["card"].as_json()},
        "model_left_out": model_left_out,
        "seconds": seconds,
    }
    lines = _describe(model, model_left_out, seconds)
    print_result(value, lines, as_json=as_json, quiet=quiet)


def _refuse_other_board(folder: Path) -> None:
    """Refuse to write into a leaderboard that is not the demo's.

    Raises:
        UsageError: the leaderboard there has entries of other sizes.
    """
    for entry in Folder(folder / "leaderboard").entries():
        if entry.parts[2] != SIZE:
            raise UsageError(
                f"the demo would write into another leaderboard, with {entry}; give it "
                "a folder of its own: --root demo",
                where=str(folder / "leaderboard"),
            )


def _make_split(
    split: str, folder: Path, workers: int | None, progress: Listener | None
) -> dict[str, Any]:
    """Generate and verify one split, and draw its first test scenario."""
    generation = generate(split, SIZE, root=folder, workers=workers, progress=progress)
    verification = verify(split, SIZE, root=folder, complete=True)
    verification.check()

    size = load().size(split, SIZE)
    picture = folder / "pictures" / f"{split}.png"
    picture.parent.mkdir(exist_ok=True)
    scenario_file = size.path(folder, size.subsets["test"][0])
    save(draw_frame(scenario_file, size.task.frames_of_interest[-1]), picture)
    return {
        "generation": generation,
        "verification": verification,
        "picture": picture,
    }


def _make_model(folder: Path, progress: Listener | None) -> dict[str, Any]:
    """Train a small model, predict, score and submit, and draw the leaderboard's page.

    The model is so small that a second thread gains nothing, and with one thread the
    same machine trains the same weights.
    """
    from lagbench.baselines.catalogue import find
    from lagbench.baselines.predict import predict
    from lagbench.baselines.train import train

    run_folder = folder / "runs" / f"{MODEL_SPLIT}-{MODEL}"
    options: dict[str, Any] = {
        "settings": SETTINGS,
        "root": folder,
        "output": run_folder,
        "device": "cpu",
        "threads": 1,
        "progress": progress,
    }
    try:
        training = train(MODEL, MODEL_SPLIT, SIZE, **options)
    except (UsageError, DataError, UnreadableFileError):
        # an earlier training there, of another version, is not worth an error
        training = train(MODEL, MODEL_SPLIT, SIZE, fresh=True, **options)
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
    solver = try_bench(MODEL_SPLIT, SIZE, warning=None)
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
    board = folder / "leaderboard"
    entry = submit(
        [prediction.path], meta, board=board, root=folder, replace=True, new_board=True
    )
    return {
        "training": training,
        "prediction": prediction,
        "card": score(prediction.path, root=folder),
        "solver": solver,
        "entry": entry,
        "page": build(board),
    }


def _describe(
    model: dict[str, Any] | None, model_left_out: str | None, seconds: float
) -> Iterator[str]:
    """Print the table of scores, if there is a model, then yield the lines below it."""
    work = f"{len(SPLITS)} data sets, verified and drawn"
    duration = format_seconds(seconds)
    if model is None:
        yield f"{work}, in {duration}"
        yield f"no model, no leaderboard: {model_left_out}"
    else:
        training = model["training"]
        title = f"{MODEL}, {training.steps} steps, on {MODEL_SPLIT} {SIZE}, test"
        _print_scores(title, model["card"])
        yield f"{work}; a model trained, predicted, scored and submitted; in {duration}"
        yield f"leaderboard page: {model['page'].page}"
    yield "next: lagbench generate --split cavity --size mini"


def _print_scores(title: str, card: ScoreCard) -> None:
    metrics = tuple(dict.fromkeys((card.ranking, *METRICS)))
    rows = []
    for row_name, scores in card.scores.items():
        cells = []
        for metric in metrics:
            mean = scores[metric].mean
            cells.append("-" if math.isnan(mean) else f"{mean:.4g}")
        method = MODEL if row_name == "submission" else row_name
        rows.append((method, *cells))
    print_table(title, ("method", *metrics), rows)
