"""The provenance of weights: the training that their file records."""

from __future__ import annotations

from pydantic import ValidationError

from lagbench.errors import UnreadableFileError
from lagbench.submission.provenance import StartWeights, TrainingProvenance

from .checkpoint import Checkpoint
from .recipe_changes import list_settings

START_DIGITS = 12  # digits of a SHA-256 that provenance names


def training_provenance(checkpoint: Checkpoint) -> TrainingProvenance:
    """Return the training behind weights.

    Raises:
        UnreadableFileError: the record of the training in the weights is damaged.
    """
    info = checkpoint.info
    recipe = checkpoint.training.get("recipe", {})
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
            overrides=list_settings(recipe),
            start=start_weights,
        )
    except (ValidationError, TypeError, KeyError) as error:
        raise UnreadableFileError(
            "the weights record a damaged training",
            where=f"{info.split} {info.size}",
            expected="a recipe, subsets and a step, as `lagbench train` records them",
            got=type(error).__name__,
            fix="train the model with `lagbench train`",
        ) from error
