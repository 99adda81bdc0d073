"""Weights that a training starts from: those of an earlier one, of the same size or of
another.

A model that knows the velocities and distances of one size goes on in their units at
another, and with the options that it has, so that its first step there predicts what
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
from lagbench.data.registry import Registry, Size
from lagbench.errors import UnreadableFileError, UsageError
from lagbench.submission.budget import Budget

from .baseline import Baseline, Facts, rescaled
from .catalogue import Entry
from .checkpoint import RECIPE_NAME, Checkpoint, check_data, load, load_weights, restore

WHERE = "--start"
MOST_HOURS = 1e9
MOST_STEPS = 10**12  # more are not believed


@dataclass(frozen=True, kw_only=True)
class Start:
    """Weights to start from."""

    path: Path  # their file
    # public figures of the data at hand, in the units that the weights know
    facts: Facts
    weights: Mapping[str, Tensor]
    # options of the model that they are of, without those of its training
    options: Mapping[str, Any]
    # what records say of them: recipe, sha256, and what they took
    record: Mapping[str, Any]

    def fill(self, model: Baseline) -> None:
        """Copy the weights into a model; refuse those of another network or of another
        meaning there.
        """
        ours = model.options.model_dump(mode="json")
        adapted, options = model.adapted(self.weights, self.options)
        other = sorted(name for name, value in options.items() if ours[name] != value)
        held, needed = (
            {name: value.shape for name, value in weights.items()}
            for weights in (adapted, model.state_dict())
        )
        if held != needed or model.options.of_weights.intersection(other):
            raise UsageError(
                "the weights do not fit the model",
                where=WHERE,
                expected="weights of the network that is trained",
                got="weights of one with "
                + ", ".join(f"model.{name}={self.options[name]}" for name in other)[
                    :500
                ],
                fix="leave out what was --set of these, or start from other weights",
            )
        load_weights(model, adapted, where=str(self.path))


class LastStateWarning(UserWarning):
    """What is taken are not the best weights of a training."""


def warn_of_last_state(checkpoint: Checkpoint, path: Path) -> None:
    """Warn where a file holds the last state of a training whose best weights lie
    beside it.
    """
    best = path.with_name("weights.pt")
    if checkpoint.optimizer is not None and best.is_file():
        message = f"{path} holds the last state of a training; the best weights on valid are {best}"
        warnings.warn(message, LastStateWarning, stacklevel=3)


def start_from(
    path: str | Path, entry: Entry, size: Size, *, root: Path, registry: Registry
) -> Start:
    """Return the weights of a file, perhaps of another size, for a training on the data
    at hand.
    """
    if getattr(entry.model, "closed_form", False):
        message = f"{entry.model.method} is fitted as a whole, without steps"
        raise UsageError(
            message, where=WHERE, got=str(path), fix="leave the option out"
        )
    file = Path(path)
    found = load(file)
    before = file.stat()
    warn_of_last_state(found, file)
    sha256 = file_sha256(file)
    after = file.stat()
    if any(
        getattr(before, name) != getattr(after, name)
        for name in ("st_ino", "st_size", "st_mtime_ns")
    ):
        raise UnreadableFileError(
            "the file changed while it was read",
            where=str(file),
            fix="start from a copy",
        )
    for what, asked, got in (
        ("baseline", entry.name, found.baseline),
        ("split", size.split, found.facts.split),
    ):
        if asked != got:
            fix = f"start from weights of {asked}"
            raise UsageError(
                f"weights of another {what}",
                where=WHERE,
                expected=asked,
                got=got,
                fix=fix,
            )
    try:
        here = check_data(
            found, root=root, registry=registry, size=size.name, where=f"{WHERE} {file}"
        )
    except UsageError as error:
        fix = f"start from weights of {size.name}"
        raise UsageError(
            error.what, where=WHERE, expected=error.expected, got=error.got, fix=fix
        ) from error
    facts = rescaled(found.facts, here)
    options = restore(replace(found, facts=facts), where=str(file)).options
    name = str(found.training.get("recipe", {}).get("name", ""))
    if re.fullmatch(RECIPE_NAME, name):
        name = name
    else:
        name = "unnamed"
    budget = found.budget or Budget()
    hours = {
        each: getattr(budget, each)
        for each in ("cpu_hours", "validation_hours", "gpu_hours")
    }
    if any(value is None or value > MOST_HOURS for value in hours.values()):
        hours = dict.fromkeys(hours)  # where one is not known, their sum is not
    if budget.steps is None:
        made = found.training.get("step", 0)
    else:
        made = budget.steps
    steps = int(made) + (budget.start_steps or 0)
    return Start(
        path=file,
        facts=facts,
        weights=found.weights,
        options=options.model_dump(mode="json", exclude=set(options.in_training)),
        record={
            "recipe": name,
            "sha256": sha256,
            "took": {**hours, "steps": min(steps, MOST_STEPS)},
        },
    )
