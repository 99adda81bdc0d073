"""The start of a training from weights of an earlier one, perhaps of another size.

A model that knows the velocities and distances of one size goes on in their units at
another, and with the options that it has. So its first step there predicts what
``lagbench predict --size`` does.
"""

from __future__ import annotations

import re
import warnings
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
from .checkpoint import Checkpoint, check_data, load, load_weights, restore

WHERE = "--start"
RECIPE_NAME = r"^[A-Za-z0-9._/*-]{1,100}$"
# larger numbers in a stranger's file are not believed
MOST_HOURS = 1e9
MOST_STEPS = 10**12


@dataclass(frozen=True, kw_only=True)
class TrainingStart:
    """Weights that a training starts from."""

    path: Path  # their file
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
        model_options = model.options.model_dump(mode="json")
        adapted, options = model.adapt_weights(self.weights, self.options)
        changed = []
        for name, value in options.items():
            if model_options[name] != value:
                changed.append(name)

        shapes = {name: value.shape for name, value in adapted.items()}
        state = model.state_dict()
        expected_shapes = {name: value.shape for name, value in state.items()}
        changes_meaning = model.options.of_weights.intersection(changed)
        if shapes != expected_shapes or changes_meaning:
            settings = [
                f"model.{name}={self.options[name]}" for name in sorted(changed)
            ]
            raise UsageError(
                "the weights do not fit the model",
                where=WHERE,
                expected="weights of the network that is trained",
                got="weights of one with " + ", ".join(settings)[:500],
                fix="leave out the --set of these options, or start from other weights",
            )
        load_weights(model, adapted, where=str(self.path))


class LastStateWarning(UserWarning):
    """The weights are not the best ones of a training."""


def warn_of_last_state(checkpoint: Checkpoint, path: Path) -> None:
    """Warn of a training's last state if its best weights lie beside the file."""
    best = path.with_name("weights.safetensors")
    if checkpoint.optimizer is not None and best.is_file():
        message = (
            f"{path} holds the last state of a training; the best weights on valid "
            f"are {best}"
        )
        warnings.warn(message, LastStateWarning, stacklevel=3)


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
        UnreadableFileError: the file is no checkpoint, or changed while it was read.
        DataError: the data set is missing, or of another version than the weights'.
    """
    if entry.model.closed_form:
        raise UsageError(
            f"{entry.model.method} is fitted as a whole, without steps",
            where=WHERE,
            expected="a model that is trained by steps",
            got=str(path),
            fix="leave the option out",
        )
    file = expand_home(path, WHERE)
    checkpoint, sha256 = _load_and_hash(file)
    _check_same("baseline", entry.name, checkpoint.baseline)
    _check_same("split", size.split, checkpoint.info.split)
    try:
        target = check_data(
            checkpoint,
            root=root,
            registry=registry,
            size=size.name,
            where=f"{WHERE} {file}",
        )
    except UsageError as error:
        raise UsageError(
            error.what,
            where=WHERE,
            expected=error.expected,
            got=error.got,
            fix=f"start from weights of {size.name}",
        ) from error

    info = rescale(checkpoint.info, target)
    model = restore(replace(checkpoint, info=info), where=str(file))
    in_training = set(model.options.in_training)
    options = model.options.model_dump(mode="json", exclude=in_training)
    return TrainingStart(
        path=file,
        info=info,
        weights=checkpoint.weights,
        options=options,
        record={
            "recipe": _recipe_name(checkpoint),
            "sha256": sha256,
            "took": _read_costs(checkpoint),
        },
    )


def _load_and_hash(file: Path) -> tuple[Checkpoint, str]:
    """Return a checkpoint and the SHA-256 of its file."""
    checkpoint = load(file)
    before = file.stat()
    warn_of_last_state(checkpoint, file)
    sha256 = file_sha256(file)
    after = file.stat()
    for name in ("st_ino", "st_size", "st_mtime_ns"):
        if getattr(before, name) != getattr(after, name):
            raise UnreadableFileError(
                "the file changed while it was read",
                where=str(file),
                expected="a file that stays as it is",
                got="another one",
                fix="start from a copy",
            )
    return checkpoint, sha256


def _check_same(kind: str, expected: str, got: str) -> None:
    if expected != got:
        raise UsageError(
            f"weights of another {kind}",
            where=WHERE,
            expected=expected,
            got=got,
            fix=f"start from weights of {expected}",
        )


def _recipe_name(checkpoint: Checkpoint) -> str:
    """Return the name of the recipe of the weights, if it is one."""
    recipe = checkpoint.training.get("recipe", {})
    name = str(recipe.get("name", ""))
    if re.fullmatch(RECIPE_NAME, name):
        return name
    return "unnamed"


def _read_costs(checkpoint: Checkpoint) -> dict[str, float | int | None]:
    """Return hours and steps behind the weights; no hours where some are unknown."""
    budget = checkpoint.budget or Budget()
    costs: dict[str, float | int | None] = {
        "cpu_hours": budget.cpu_hours,
        "validation_hours": budget.validation_hours,
        "gpu_hours": budget.gpu_hours,
    }
    hours = list(costs.values())
    if any(value is None or value > MOST_HOURS for value in hours):
        costs = dict.fromkeys(costs)
    steps = budget.steps
    if steps is None:
        steps = int(checkpoint.training.get("step", 0))
    if budget.start_steps is not None:
        steps += budget.start_steps
    costs["steps"] = min(steps, MOST_STEPS)
    return costs
