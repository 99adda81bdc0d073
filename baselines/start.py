"""Weights that a training starts from: those of an earlier one, of the same size or of another.

A model that knows the velocities and distances of one size goes on in their units at another, so that its
first step there predicts what ``lagbench predict --size`` does.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from lagbench.data.checksums import file_sha256
from lagbench.data.registry import Registry, Size
from lagbench.errors import UsageError
from lagbench.submission.budget import Budget, budget_in

from .baseline import Baseline, Facts, rescaled
from .checkpoint import Checkpoint, check_data, load, load_weights
from .recipe import Recipe

WHERE = "--start"


@dataclass(frozen=True, kw_only=True)
class Start:
    """Weights to start from."""

    path: Path  # their file
    facts: Facts  # public figures of the data at hand, in the units that the weights know
    weights: Mapping[str, Tensor]
    options: Mapping[str, Any]  # options of the model that they are of
    record: Mapping[str, Any]  # what records say of them: sha256, recipe, and the hours that they took

    def fill(self, model: Baseline) -> None:
        """Copy the weights into a model.

        Raises:
            UsageError: the weights are those of another network, or mean something else.
            UnreadableFileError: they are not finite.
        """
        ours, kind = model.options.model_dump(mode="json"), type(model.options)
        other = {name for name in set(ours) & set(self.options) if self.options[name] != ours[name]}
        held, needed = (
            {name: value.shape for name, value in weights.items()}
            for weights in (self.weights, model.state_dict())
        )
        if held != needed or other & kind.of_weights:
            told = [f"model.{name}={self.options[name]}" for name in sorted(other - kind.in_training)]
            raise UsageError(
                "the weights do not fit the model",
                where=WHERE,
                expected="weights of the network that is trained",
                got=f"weights of one with {', '.join(told)}"[:500] if told else "weights of another",
                fix="train the network that they are of, with --set, or start from other weights",
            )
        load_weights(model, self.weights, where=str(self.path))


def start_from(path: str | Path, recipe: Recipe, size: Size, *, root: Path, registry: Registry) -> Start:
    """Return the weights of a file for a training on the data at hand.

    Args:
        path: weights.pt or checkpoint.pt of a training, perhaps at another size of the split.
        recipe: what is to be trained.
        size: on which data.
        root: folder of all data sets.
        registry: where splits are described.

    Raises:
        UnreadableFileError: the file is damaged or unsafe.
        UsageError: weights of another baseline, split, box or interval of frames.
        DataError: the data are missing, or of another version than those that the weights were trained on.
    """
    file = Path(path)
    found = load(file)
    for what, asked, got in (
        ("baseline", recipe.baseline, found.baseline),
        ("split", size.split, found.facts.split),
    ):
        if asked != got:
            fix = f"start from weights of {asked}"
            raise UsageError(f"weights of another {what}", where=WHERE, expected=asked, got=got, fix=fix)
    here = check_data(found, root=root, registry=registry, size=size.name, where=f"{WHERE} {file}")
    return Start(
        path=file,
        facts=rescaled(found.facts, here),
        weights=found.weights,
        options=found.options,
        record=_record(file, found),
    )


def _record(file: Path, found: Checkpoint) -> dict[str, Any]:
    """Return what records say of the weights; hours that nobody knows are None."""
    budget = budget_in(json.dumps(found.training.get("budget"))) or Budget()
    hours = ("cpu_hours", "validation_hours", "gpu_hours")
    return {
        "sha256": file_sha256(file),
        "recipe": str(found.training.get("recipe", {}).get("name", "")),
        **{name: getattr(budget, name) for name in hours},
    }
