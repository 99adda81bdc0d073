"""The provenance of weights: the training that their file records."""

from __future__ import annotations

from pydantic import ValidationError

from lagbench.errors import UnreadableFileError
from lagbench.submission.provenance import StartWeights, TrainingProvenance

from .checkpoint import Checkpoint

START_DIGITS = 12  # digits of a SHA-256 that provenance names


def training_provenance(checkpoint: Checkpoint) -> TrainingProvenance:
    """Return the training behind weights.

    Raises:
        UnreadableFileError: the record of the training in the weights is damaged.
    """
    info = checkpoint.info
    recipe = checkpoint.recipe
    start = recipe.get("start")
    start_weights = None
    try:
        if start:
            start_weights = StartWeights(
                recipe=start["recipe"], weights=start["sha256"][:START_DIGITS]
            )
        return TrainingProvenance(
            split=info.split,
            size=info.size,
            subsets=tuple(recipe.get("training", {}).get("windows", ("train",))),
            recipe=str(recipe.get("name")),
            step=checkpoint.training.get("step", 0),
            overrides=tuple(recipe.get("settings", ())),
            start=start_weights,
        )
    except (ValidationError, TypeError, KeyError) as error:
        raise UnreadableFileError(
            f"the weights record a damaged training: {error!r}"
        ) from error
