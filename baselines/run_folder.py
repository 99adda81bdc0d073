"""The folder of a training: its paths, and the checks before a training goes on there.

It holds checkpoint.safetensors, weights.safetensors, training.json and tensorboard/.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from lagbench.atomic import write_atomically
from lagbench.errors import (
    DataError,
    LagbenchError,
    UnreadableFileError,
    UsageError,
    check_regular,
)

from .baseline import DatasetInfo
from .checkpoint import Checkpoint, load, save
from .recipe import Recipe
from .recipe_changes import describe_start, first_difference
from .training_log import OVER

LARGEST_LOG = 4 << 20  # longest training.json that is read [bytes]


class RunFolder:
    """Paths of a training's files, and the files of an earlier run there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoint = (
            path / "checkpoint.safetensors"
        )  # the last state, to go on from
        # the best weights in bfloat16, to predict from
        self.weights = path / "weights.safetensors"
        self.log = path / "training.json"  # the log of the training
        self.tensorboard = path / "tensorboard"  # folder of TensorBoard's files
        # files of an earlier training that are still there
        self._earlier_files: list[Path] = []

    def find_checkpoint(
        self,
        recipe: Recipe,
        info: DatasetInfo,
        *,
        processes: int,
        resume: bool,
        fresh: bool,
    ) -> Checkpoint | None:
        """Return the checkpoint to go on from; None for a training from the start.

        Raises:
            UsageError: the folder holds another training, or one that cannot go on.
            DataError: the training began on another version of the data set.
        """
        files = (self.checkpoint, self.weights, self.log)
        is_empty = not any(file.exists() for file in files)
        if fresh or is_empty:
            return None
        if not self.checkpoint.exists():
            if not resume:
                raise self._occupied()
            if self.weights.exists():
                raise self._without_checkpoint(recipe)
            return None  # that training failed before its first checkpoint

        checkpoint = self._load_checkpoint()
        checks = [
            *self._recipe_checks(checkpoint, recipe),
            (resume, self._occupied()),
            *self._resume_checks(checkpoint, info, processes),
        ]
        for fits, error in checks:
            if not fits:
                raise error
        return checkpoint

    def _load_checkpoint(self) -> Checkpoint:
        """Return the last state; the error of an unreadable file says how to go on."""
        try:
            return load(self.checkpoint)
        except UnreadableFileError as error:
            raise UnreadableFileError(
                f"cannot go on from this checkpoint: {error.what}",
                where=error.where,
                expected=error.expected,
                got=error.got,
                fix="train anew with --fresh, or name another folder with --output",
            ) from error

    def _recipe_checks(
        self, checkpoint: Checkpoint, recipe: Recipe
    ) -> list[tuple[bool, LagbenchError]]:
        """Return whether start and recipe are those of the checkpoint, with errors."""
        asked = recipe.as_json()
        logged = checkpoint.training.get("recipe", {})
        start = asked.get("start")
        logged_start = logged.get("start")
        return [
            (
                start == logged_start,
                UsageError(
                    "the folder holds a training that started from other weights",
                    where=f"--start, {self.path}",
                    expected=describe_start(logged_start)
                    or "random weights: no --start",
                    got=describe_start(start) or "no --start",
                    fix="give the same --start, name another folder with --output, or "
                    "train anew with --fresh",
                ),
            ),
            (
                asked == logged,
                UsageError(
                    "the folder holds a training with another recipe",
                    where=str(self.path),
                    expected="the recipe of the training that lies there",
                    got=first_difference(asked, logged),
                    fix="name another folder with --output, or train anew with --fresh",
                ),
            ),
        ]

    def _resume_checks(
        self, checkpoint: Checkpoint, info: DatasetInfo, processes: int
    ) -> list[tuple[bool, LagbenchError]]:
        """Return whether data and processes are the checkpoint's, with errors."""
        data_hash = checkpoint.info.dataset_sha256
        process_count = checkpoint.training.get("processes")
        return [
            (
                info.dataset_sha256 == data_hash,
                DataError(
                    "the training began on another version of the data set",
                    where=str(self.path),
                    expected=data_hash,
                    got=info.dataset_sha256,
                    fix="train anew with --fresh",
                ),
            ),
            (
                processes == process_count,
                UsageError(
                    "the training began with another number of processes",
                    where="--processes",
                    expected=process_count,
                    got=processes,
                    fix="go on with the old number of processes, or train anew with "
                    "--fresh",
                ),
            ),
        ]

    def _occupied(self) -> UsageError:
        """Return the error of a folder in which a training lies."""
        return UsageError(
            "the folder holds a training",
            where=str(self.path),
            expected="a folder without one, or the same recipe",
            got="a training",
            fix="go on with the recipe of the folder, train anew with --fresh, or name "
            "another --output",
        )

    def _without_checkpoint(self, recipe: Recipe) -> UsageError:
        """Return the error of weights without a checkpoint.

        No training can go on from such weights, and none may replace them.
        """
        log = self._read_log()
        is_same = log.get("recipe") == recipe.as_json()
        if is_same and log.get("state") in OVER:
            what = "the training is finished"
            instead = "predict from its weights"
        else:
            what = "the folder holds weights, and no checkpoint to go on from"
            instead = "name another folder with --output"
        return UsageError(
            what,
            where=str(self.path),
            expected=f"{self.checkpoint.name}, or an empty folder",
            got=f"{self.weights.name} without {self.checkpoint.name}",
            fix=f"{instead}, or train anew with --fresh",
        )

    def unfinished_steps(self, training: Mapping[str, Any]) -> tuple[int, int] | None:
        """Return step and steps of a training that is not over; None if it is.

        ``training`` is the log in the weights. The log in the folder counts only if it
        has the same recipe.
        """
        log = self._read_log()
        if log.get("state") in OVER or log.get("recipe") != training.get("recipe"):
            return None
        step = log.get("step")
        steps = log.get("steps")
        if isinstance(step, int) and isinstance(steps, int):
            return (step, steps)
        return None

    def has_log_of(self, training: Mapping[str, Any]) -> bool:
        """Return whether training.json is the log of a training that is over.

        Args:
            training: the log in its checkpoint.
        """
        log = self._read_log()
        is_same = log.get("recipe") == training.get("recipe")
        has_all_steps = log.get("step") == training.get("step")
        return is_same and has_all_steps and log.get("state") in OVER

    def _read_log(self) -> dict[str, Any]:
        """Return the content of training.json; nothing where there is no log."""
        try:
            check_regular(self.log, longest=LARGEST_LOG)
            log = json.loads(self.log.read_bytes())
        except (UnreadableFileError, OSError, ValueError, RecursionError):
            return {}
        if isinstance(log, dict):
            return log
        return {}

    def holds(self, file: Path) -> bool:
        """Return whether a file is a checkpoint of this folder, perhaps by a link."""
        for path in (self.weights, self.checkpoint):
            if path.exists() and path.samefile(file):
                return True
        return False

    def note_earlier_files(self) -> None:
        """Note the files of an earlier training, before a new one begins.

        They stay until the first :meth:`save`: if the new training fails before, the
        earlier one is not lost. Logs without a model are removed at once.
        """
        files = (self.checkpoint, self.weights, self.log, *self._list_logs())
        self._earlier_files = [file for file in files if file.exists()]
        if not self.checkpoint.exists() and not self.weights.exists():
            for file in self._earlier_files:
                file.unlink()
            self._forget_earlier_files()

    @property
    def has_earlier_files(self) -> bool:
        """Whether the files of an earlier training are still there."""
        return bool(self._earlier_files)

    def save(self, path: Path, checkpoint: Checkpoint) -> None:
        """Save a checkpoint; the first one replaces the earlier training.

        Args:
            path: :attr:`checkpoint` or :attr:`weights`.
            checkpoint: what to save.

        Raises:
            WorkFailedError: the disk is full, or nobody may write there. All files stay
                as they are.
        """
        replaced = [file for file in self._earlier_files if file != path]
        save(path, checkpoint)
        for file in replaced:
            file.unlink(missing_ok=True)
        self._forget_earlier_files()

    def remove_new_logs(self) -> None:
        """Remove the logs of a training that has stored nothing."""
        for file in self._list_logs():
            if file not in self._earlier_files:
                file.unlink()

    def _list_logs(self) -> list[Path]:
        """Return the files of TensorBoard."""
        events = self.tensorboard.glob("events.out.tfevents.*")
        parameters = self.tensorboard / "hparams.yaml"
        logs = [*events]
        if parameters.exists():
            logs.append(parameters)
        return logs

    def _forget_earlier_files(self) -> None:
        self._earlier_files = []
        with suppress(OSError):  # a folder that holds other files is not removed
            self.tensorboard.rmdir()

    def write_log(self, log: Mapping[str, Any]) -> None:
        """Write training.json; it appears whole or not at all."""
        text = json.dumps(log, indent=2, sort_keys=True)
        write_atomically(self.log, text.encode() + b"\n", option="--output")
