"""Train, predict, score: whatever of a run is not there yet."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.baselines.job import OVER
from lagbench.errors import DataError, UsageError
from lagbench.scoring.card import JSON_NAME
from lagbench.scoring.score_file import NETCDF_NAME, read_statistics
from lagbench.submission import open_predictions
from lagbench.work.progress import Progress

from .evidence import RECORD_NAME, read_json
from .plan import Plan
from .roster import Model

if TYPE_CHECKING:
    from lagbench.baselines.recipe import Recipe

__all__ = ["check_training", "make_run", "make_training", "outlook"]

PREDICTIONS = "predictions.nc"

OTHER = "name another folder of runs with --runs, or remove this run"


def make_run(
    plan: Plan,
    split: str,
    model: Model,
    seed: int,
    *,
    progress: Callable[[Progress], None] | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Path:
    """Return the folder of a run whose predictions are scored; make what is missing.

    An interrupted training goes on where it stopped; predictions and scores of other data are
    made again.
    """
    folder = plan.folder(split, model, seed)
    predictions, scores = folder / PREDICTIONS, folder / NETCDF_NAME
    check_training(plan, split, model, seed, folder=folder)
    for path in _stale(plan.hash(split), folder):
        say(f"{path}: of another version of the data; made again")
        path.unlink()
    if scores.is_file() and (folder / JSON_NAME).is_file():
        return folder
    if not predictions.is_file():
        make_training(plan, split, model, seed, folder=folder, progress=progress)
        from lagbench.baselines.predict import predict

        predict(
            folder / "weights.pt",
            predictions,
            root=plan.root,
            device=plan.device,
            threads=plan.threads,
            method=model.name,
            progress=progress,
            registry=plan.registry,
        )
    from lagbench.scoring.score import score

    score(predictions, root=plan.root, registry=plan.registry, progress=progress)
    return folder


def make_training(
    plan: Plan,
    split: str,
    model: Model,
    seed: int,
    *,
    folder: Path,
    progress: Callable[[Progress], None] | None = None,
) -> None:
    """Train a model unless its training is complete."""
    if _complete(folder):
        return
    from lagbench.baselines.train import train

    train(
        model.baseline,
        split,
        plan.size,
        recipe=model.recipe or plan.recipe,
        settings=(*model.settings, *plan.settings),
        seed=seed,
        root=plan.root,
        output=folder,
        device=plan.device,
        threads=plan.threads,
        progress=progress,
        registry=plan.registry,
    )


def check_training(plan: Plan, split: str, model: Model, seed: int, *, folder: Path) -> None:
    """Refuse a folder whose training is not the one that was asked for."""
    record = read_json(folder / RECORD_NAME)
    if not record:
        return
    from lagbench.baselines.job import first_difference

    asked = _recipe(plan, split, model, seed).as_json()
    if record.get("recipe") != asked:
        difference = first_difference(asked, record.get("recipe"))
        raise UsageError("the run has another recipe", where=str(folder), expected=difference, fix=OTHER)
    data = plan.hash(split)
    if data is not None and record.get("dataset_sha256") != data:
        got = record.get("dataset_sha256")
        raise DataError(
            "the run was trained on other data", where=str(folder), expected=data, got=got, fix=OTHER
        )


def outlook(plan: Plan, split: str, model: Model, seed: int) -> str:
    """Return what :func:`make_run` would do, in words; nothing is made."""
    folder = plan.folder(split, model, seed)
    check_training(plan, split, model, seed, folder=folder)
    stale = _stale(plan.hash(split), folder)
    there = {path.name for path in folder.glob("*") if path not in stale}
    if {NETCDF_NAME, JSON_NAME} <= there:
        return "there"
    if PREDICTIONS in there:
        return "to score"
    if _complete(folder):
        return "to predict and score"
    recipe = _recipe(plan, split, model, seed)
    training = recipe.training
    passes = "closed form" if training.epochs is None else f"{training.epochs:g} epochs"
    return f"to train, {recipe.name}: {passes if training.steps is None else f'{training.steps:,} steps'}"


def _recipe(plan: Plan, split: str, model: Model, seed: int) -> Recipe:
    """Return the recipe that was asked for."""
    from lagbench.baselines.catalogue import find
    from lagbench.baselines.recipe import recipe_for

    settings, variant = (*model.settings, *plan.settings), model.recipe or plan.recipe
    return recipe_for(find(model.baseline), split, plan.size, variant=variant, settings=settings, seed=seed)


def _stale(data: str | None, folder: Path) -> list[Path]:
    """Return the predictions and scores of a run that are of other data than those of a hash."""
    predictions, scores = (folder / name for name in (PREDICTIONS, NETCDF_NAME))
    if data is None:
        return []
    if predictions.is_file() and _predicted_on(predictions) != data:
        return [path for path in (predictions, scores) if path.is_file()]
    return [scores] if scores.is_file() and _scored_on(scores) != data else []


def _predicted_on(predictions: Path) -> str:
    with open_predictions(predictions) as found:
        return found.header.dataset_sha256


def _scored_on(scores: Path) -> str:
    return read_statistics(scores).identity["dataset_sha256"]


def _complete(folder: Path) -> bool:
    """Tell whether weights are there, and their training is over or cannot be gone on with."""
    record = folder / RECORD_NAME
    if not (folder / "weights.pt").is_file():
        return False
    if not (folder / "checkpoint.pt").is_file() or not record.is_file():
        return True
    return read_json(record).get("state") in OVER
