"""The start of a training from weights of an earlier one, perhaps of another size.

A model that knows the velocities and distances of one size goes on in their units at
another, and with the options that it has. So its first step there predicts what
``lagbench predict --size`` does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from lagbench.data.checksums import file_sha256
from lagbench.data.layout import expand_home
from lagbench.data.registry import Registry, Size
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.submission.budget import Budget

from .baseline import Baseline, DatasetInfo, rescale
from .catalogue import CatalogueEntry
from .checkpoint import check_data, load, load_weights, restore

WHERE = "--start"


@dataclass(frozen=True, kw_only=True)
class TrainingStart:
    """Weights that a training starts from."""

    # public figures of the data at hand, in the units of the weights
    info: DatasetInfo
    weights: Mapping[str, Tensor]
    # options of the model of the weights, without those of its training
    options: Mapping[str, Any]
    # entry of training logs: recipe, sha256 and budget
    record: Mapping[str, Any]

    def load_into(self, model: Baseline) -> None:
        """Copy the weights into a model.

        Raises:
            UsageError: they are of another network, or mean something else there.
        """
        asked = model.options.model_dump(mode="json")
        changed = []
        for name in sorted(model.options.of_weights):
            if asked[name] != self.options[name]:
                changed.append(name)
        try:
            load_weights(model, self.weights, where=WHERE)
        except UnreadableFileError as error:
            changed.append(error.text)
        if changed:
            raise UsageError(
                f"the weights are of another model: {', '.join(changed)}; leave out "
                "the --set of its options",
                where=WHERE,
            )


def start_from(
    path: str | Path,
    entry: CatalogueEntry,
    size: Size,
    *,
    root: Path,
    registry: Registry,
) -> TrainingStart:
    """Return the weights of a file, for a training on the data at hand.

    Args:
        path: the file; its weights may be of another size.
        entry: the baseline to train.
        size: the size to train on.
        root: folder of all data sets.
        registry: where splits are described.

    Raises:
        UsageError: the weights are of another baseline or split, or cannot be run at
            this size.
        UnreadableFileError: the file is no checkpoint.
        DataError: the data set is missing.
    """
    file = expand_home(path, WHERE)
    checkpoint = load(file)
    if entry.model.closed_form:
        raise UsageError(f"{entry.model.method} is fitted without steps", where=WHERE)
    found = (checkpoint.baseline, checkpoint.info.split)
    if found != (entry.name, size.split):
        raise UsageError(
            f"weights of {' on '.join(found)}; {entry.name} on {size.split} is trained",
            where=WHERE,
        )
    target = check_data(
        checkpoint, root=root, registry=registry, size=size.name, where=WHERE
    )
    info = rescale(checkpoint.info, target)
    model = restore(replace(checkpoint, info=info), where=str(file))
    budget = checkpoint.budget or Budget()
    steps = budget.steps or int(checkpoint.training.get("step", 0))
    return TrainingStart(
        info=info,
        weights=checkpoint.weights,
        options=model.options.model_dump(
            mode="json", exclude=set(model.options.in_training)
        ),
        record={
            "recipe": checkpoint.recipe.get("name", "unnamed"),
            "sha256": file_sha256(file),
            "took": {
                "cpu_hours": budget.cpu_hours,
                "validation_hours": budget.validation_hours,
                "gpu_hours": budget.gpu_hours,
                "steps": steps + (budget.start_steps or 0),
            },
        },
    )
