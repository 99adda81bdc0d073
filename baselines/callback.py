"""What happens between the steps of a training: look, validate, store, stop."""

from __future__ import annotations

import math
import signal
import threading
from types import FrameType
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer

from lagbench.work.progress import Meter

from .baseline import Batch
from .checkpoint import Checkpoint, rounded_weights, save
from .job import STOPPED_EARLY, RunFolder, TrainingRecord
from .machine import return_memory
from .module import TOTAL, TrainingModule
from .rollout import validate

__all__ = [
    "TrainingCallback",
]


class TrainingCallback(Callback):
    """Logs, validates and stores a training, and stops it early or when a user interrupts.

    An interrupt lets the running step end and stores the state; a second one stops at once.
    """

    def __init__(
        self,
        folder: RunFolder,
        ledger: TrainingRecord,
        *,
        about: Checkpoint,
        record: dict[str, Any],
        validation: Batch | None,
        meter: Meter,
    ) -> None:
        self.folder = folder  # where files go
        self.ledger = ledger  # what the training has done so far
        self.about = about  # fields of the checkpoint that do not change
        self.record = record  # entries of training.json that do not change
        self.validation = validation  # windows of 'valid' with their truth; None validates never
        self.meter = meter  # counts steps
        self._interrupted = False
        self._handlers: dict[int, Any] = {}

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        """Listen to interrupts; begin to count."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._interrupt)
        steps = _of(module).steps
        self.meter.begin("training", total=steps, scenarios=steps, done=_of(module).step)

    def on_train_batch_end(
        self, trainer: Trainer, module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        """Do what is due after a step."""
        trained = _of(module)
        step, steps, recipe = trained.step, trained.steps, trained.recipe
        self.ledger.step = step
        last = step >= steps
        if last or step % recipe.log_every == 0 or step == 1:
            self._log(trainer, trained)
            return_memory()
        self.meter.count(1, scenarios=1)
        every = max(1, steps // 10) if recipe.validate_every is None else recipe.validate_every
        if self.validation is not None and every and (last or step % every == 0):
            self._validate(trainer, trained)
        stop = trainer.strategy.reduce_boolean_decision(self._interrupted, all=False)
        if stop or trainer.should_stop or last:
            over = last or self.ledger.state == STOPPED_EARLY
            self.ledger.state = "interrupted" if stop and not over else self.ledger.state
            trainer.should_stop = True
        if trainer.should_stop or step % (recipe.checkpoint_every or max(1, steps // 20)) == 0:
            self._store(trainer, trained)

    def on_train_end(self, trainer: Trainer, module: LightningModule) -> None:
        """Give the signals back."""
        self._release()

    def on_exception(self, trainer: Trainer, module: LightningModule, exception: BaseException) -> None:
        """Give the signals back; enter the failure. The checkpoint stays as it is."""
        self._release()
        if trainer.is_global_zero and isinstance(exception, Exception):
            self.ledger.state = "failed"
            self.ledger.read_clocks(trainer.world_size)
            self.folder.write_record({**self.record, **self.ledger.as_json()})

    def _release(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        """Note the first interrupt; let a second one through."""
        if self._interrupted:
            raise KeyboardInterrupt
        self._interrupted = True

    def _log(self, trainer: Trainer, module: TrainingModule) -> None:
        self.ledger.loss = {name: float(value) for name, value in module.terms.items()}
        if not math.isfinite(self.ledger.loss[TOTAL]) and trainer.world_size == 1:
            raise module.not_finite()
        self.meter.stage = f"loss {self.ledger.loss[TOTAL]:.3g}"
        if trainer.logger is not None:
            values = {f"loss/{name}": value for name, value in self.ledger.loss.items()}
            trainer.logger.log_metrics({**values, "learning_rate": module.learning_rate}, step=module.step)

    def _validate(self, trainer: Trainer, module: TrainingModule) -> None:
        """Validate in the first process; all act on what it finds."""
        rmse = 0.0
        if trainer.is_global_zero and self.validation is not None:
            rmse = validate(module.model, self.validation)
        rmse = float(trainer.strategy.broadcast(rmse))
        better = self.ledger.validated(rmse)
        if trainer.logger is not None:
            trainer.logger.log_metrics({"validation/position_rmse": rmse}, step=module.step)
        if better and trainer.is_global_zero:
            self._write_weights(module)
        patience = module.recipe.patience
        if patience is not None and self.ledger.since_best() >= patience and module.step < module.steps:
            self.ledger.state = STOPPED_EARLY
            trainer.should_stop = True

    def _store(self, trainer: Trainer, module: TrainingModule) -> None:
        """Write checkpoint and record; a model whose weights are not finite is not stored."""
        if self.ledger.state == "running" and module.step >= module.steps:
            self.ledger.state = "finished"
        if not trainer.is_global_zero:
            return
        state = module.model.state_dict()
        if not all(bool(torch.isfinite(value).all()) for value in state.values()):
            raise module.not_finite()
        self.ledger.read_clocks(trainer.world_size)
        training = {**self.about.training, **self.ledger.as_json()}
        optimizer = trainer.optimizers[0].state_dict()
        save(self.folder.checkpoint, self._checkpoint(state, training, optimizer))
        if self.validation is None or not self.folder.weights.exists():
            self._write_weights(module)
        self.folder.write_record({**self.record, **self.ledger.as_json()})

    def _write_weights(self, module: TrainingModule) -> None:
        training = {**self.about.training, **self.ledger.as_json()}
        save(self.folder.weights, self._checkpoint(rounded_weights(module.model), training, None))

    def _checkpoint(
        self, weights: dict[str, torch.Tensor], training: dict[str, Any], optimizer: dict[str, Any] | None
    ) -> Checkpoint:
        return Checkpoint(
            baseline=self.about.baseline,
            options=self.about.options,
            facts=self.about.facts,
            weights=weights,
            training=training,
            optimizer=optimizer,
        )


def _of(module: LightningModule) -> TrainingModule:
    if not isinstance(module, TrainingModule):
        raise TypeError(type(module).__name__)
    return module
