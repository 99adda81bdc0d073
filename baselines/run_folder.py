"""The folder of a training: checkpoint.pt, weights.pt, training.json, tensorboard/."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lagbench.atomic import write_atomically
from lagbench.errors import UsageError

from .checkpoint import Checkpoint, load
from .ledger import OVER
from .recipe import Recipe

__all__ = ["RunFolder", "default_folder", "first_difference"]


def default_folder(recipe: Recipe) -> Path:
    """Return ``runs/<split>/<size>/<baseline>-<seed>`` in the present folder."""
    return Path("runs") / recipe.name / f"{recipe.baseline}-{recipe.training.seed}"


@dataclass(frozen=True)
class RunFolder:
    """Paths of a training's files, and what an earlier run left there."""

    path: Path

    @property
    def checkpoint(self) -> Path:
        """The last state, to go on from."""
        return self.path / "checkpoint.pt"

    @property
    def weights(self) -> Path:
        """The best weights in bfloat16, to predict from."""
        return self.path / "weights.pt"

    @property
    def record(self) -> Path:
        """What the training did and cost, as JSON."""
        return self.path / "training.json"

    @property
    def logs(self) -> Path:
        """Folder of TensorBoard's files."""
        return self.path / "tensorboard"

    def earlier(self, recipe: Recipe, *, resume: bool, fresh: bool) -> Checkpoint | None:
        """Return the checkpoint to go on from; None for a training from the start.

        Args:
            recipe: the recipe of the training.
            resume: go on from what is there; else anything there is an error.
            fresh: train anew whatever is there.

        Raises:
            UsageError: the folder holds another training, or one that must not be resumed.
            UnreadableFileError: its checkpoint is damaged.
        """
        left = [file for file in (self.checkpoint, self.weights, self.record) if file.exists()]
        if fresh or not left:
            return None
        if self.checkpoint not in left:
            if resume and self.weights not in left:  # it failed before there was anything to keep
                return None
            raise self._without_checkpoint(recipe) if resume else self._taken()
        found = load(self.checkpoint)
        if found.training.get("recipe") != recipe.as_json():
            raise UsageError(
                "the folder holds a training with another recipe",
                where=str(self.path),
                expected=first_difference(recipe.as_json(), found.training.get("recipe")),
                fix="name another folder with --output, or train anew with --fresh",
            )
        if not resume:
            raise self._taken()
        return found

    def _taken(self) -> UsageError:
        return UsageError(
            "the folder holds a training",
            where=str(self.path),
            fix="go on with --resume, train anew with --fresh, or name another --output",
        )

    def _without_checkpoint(self, recipe: Recipe) -> UsageError:
        """Return the error for weights that no training can go on from, and that none may replace."""
        said = self._recorded()
        over = said.get("recipe") == recipe.as_json() and said.get("state") in OVER
        return UsageError(
            "the training is finished"
            if over
            else "the folder holds weights, and no checkpoint to go on from",
            where=str(self.path),
            got=f"{self.weights.name} without {self.checkpoint.name}",
            fix=("predict from its weights, " if over else "name another folder with --output, ")
            + "or train anew with --fresh",
        )

    def _recorded(self) -> dict[str, Any]:
        """Return what training.json says; nothing where it is not there or no record."""
        try:
            said = json.loads(self.record.read_bytes())
        except (OSError, ValueError, RecursionError):
            return {}
        return said if isinstance(said, dict) else {}

    def clear(self) -> None:
        """Remove what an earlier training left, and nothing else."""
        logs = (*self.logs.glob("events.out.tfevents.*"), self.logs / "hparams.yaml")
        for file in (self.checkpoint, self.weights, self.record, *logs):
            file.unlink(missing_ok=True)
        with suppress(OSError):  # what is not ours stays
            self.logs.rmdir()

    def write_record(self, record: dict[str, Any]) -> None:
        """Write training.json; it appears whole or not at all."""
        text = json.dumps(record, indent=2, sort_keys=True)
        write_atomically(self.record, text.encode() + b"\n", option="--output")


def first_difference(wanted: dict[str, Any], found: object, path: str = "") -> str:
    """Return the first key whose value differs, with both values."""
    theirs = found if isinstance(found, dict) else {}
    for key in sorted({*wanted, *theirs}):
        mine, other = wanted.get(key), theirs.get(key)
        if mine != other:
            if isinstance(mine, dict) and isinstance(other, dict):
                return first_difference(mine, other, f"{path}{key}.")
            return f"{path}{key} = {mine!r}, as asked for; the folder has {other!r}"
    return "the same recipe"
