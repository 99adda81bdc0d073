"""Train, predict, score: whatever of a run is not there yet."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lagbench.progress import Progress
from lagbench.score_card import JSON_NAME
from lagbench.score_file import NETCDF_NAME

from .evidence import read_json
from .plan import Plan
from .roster import Model

__all__ = ["make_run", "make_training"]

DONE = ("finished", "stopped early")
"""States of a training that is not to be gone on with."""

PREDICTIONS = "predictions.nc"


def make_run(
    plan: Plan,
    split: str,
    model: Model,
    seed: int,
    *,
    progress: Callable[[Progress], None] | None = None,
) -> Path:
    """Return the folder of a run whose predictions are scored; make what is missing.

    An interrupted training goes on where it stopped.

    Args:
        plan: what was asked for.
        split: name of the split.
        model: what to train.
        seed: seed of the training.
        progress: called as the work advances.

    Raises:
        LagbenchError: as training, prediction and scoring do.
    """
    folder = plan.folder(split, model, seed)
    predictions, scores = folder / PREDICTIONS, folder / NETCDF_NAME
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


def _complete(folder: Path) -> bool:
    """Tell whether weights are there, and their training is over or cannot be gone on with."""
    record = folder / "training.json"
    if not (folder / "weights.pt").is_file():
        return False
    if not (folder / "checkpoint.pt").is_file() or not record.is_file():
        return True
    return read_json(record).get("state") in DONE
