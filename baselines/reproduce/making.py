"""Train, predict, score: whatever of a run is not there yet."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lagbench.errors import DataError, UsageError
from lagbench.progress import Progress
from lagbench.score_card import JSON_NAME
from lagbench.score_file import NETCDF_NAME, read_statistics
from lagbench.submission import open_predictions

from ..ledger import OVER
from .evidence import RECORD_NAME, read_json
from .plan import Plan
from .roster import Model

__all__ = ["check_training", "make_run", "make_training"]

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

    Args:
        plan: what was asked for.
        split: name of the split.
        model: what to train.
        seed: seed of the training.
        progress: called as the work advances.
        say: called with what is made again, and why.

    Raises:
        UsageError: the folder holds a training with another recipe.
        DataError: it holds a training on other data.
        LagbenchError: as training, prediction and scoring do.
    """
    folder = plan.folder(split, model, seed)
    predictions, scores = folder / PREDICTIONS, folder / NETCDF_NAME
    check_training(plan, split, model, seed, folder=folder)
    _drop_stale(plan.hash(split), folder, say)
    if scores.is_file() and (folder / JSON_NAME).is_file():
        return folder
    if not predictions.is_file():
        make_training(plan, split, model, seed, folder=folder, progress=progress)
        from ..prediction import predict

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
    from lagbench.scoring import score

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
    """Train a model unless its training is complete.

    Args:
        plan: what was asked for.
        split: name of the split.
        model: what to train.
        seed: seed of the training.
        folder: folder of the run.
        progress: called as the work advances.

    Raises:
        LagbenchError: as :func:`lagbench.baselines.training.train` does.
    """
    if _complete(folder):
        return
    from ..training import train

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
    """Refuse a folder whose training is not the one that was asked for.

    Args:
        plan: what was asked for.
        split: name of the split.
        model: what to train.
        seed: seed of the training.
        folder: folder of the run; one without a record passes.

    Raises:
        UsageError: it was trained with another recipe.
        DataError: it was trained on other data.
    """
    record = read_json(folder / RECORD_NAME)
    if not record:
        return
    from ..catalogue import find
    from ..recipe import recipe_for
    from ..run_folder import first_difference

    settings, variant = (*model.settings, *plan.settings), model.recipe or plan.recipe
    entry = find(model.baseline)
    asked = recipe_for(entry, split, plan.size, variant=variant, settings=settings, seed=seed).as_json()
    if record.get("recipe") != asked:
        difference = first_difference(asked, record.get("recipe"))
        raise UsageError("the run has another recipe", where=str(folder), expected=difference, fix=OTHER)
    data = plan.hash(split)
    if data is not None and record.get("dataset_sha256") != data:
        got = record.get("dataset_sha256")
        raise DataError("the run was trained on other data", where=str(folder), expected=data, got=got, fix=OTHER)


def _drop_stale(data: str | None, folder: Path, say: Callable[[str], None]) -> None:
    """Remove scores of other data than those of a hash, and the predictions that they are of."""
    for path in (folder / NETCDF_NAME, folder / PREDICTIONS):
        if data is None or not path.is_file():
            continue
        held = read_statistics(path).identity["dataset_sha256"] if path.name == NETCDF_NAME else _made_on(path)
        if held != data:
            say(f"{path}: of another version of the data; made again")
            path.unlink()


def _made_on(predictions: Path) -> str:
    """Return the hash of the data that predictions are for."""
    with open_predictions(predictions) as found:
        return found.dataset_sha256


def _complete(folder: Path) -> bool:
    """Tell whether weights are there, and their training is over or cannot be gone on with."""
    record = folder / RECORD_NAME
    if not (folder / "weights.pt").is_file():
        return False
    if not (folder / "checkpoint.pt").is_file() or not record.is_file():
        return True
    return read_json(record).get("state") in OVER
