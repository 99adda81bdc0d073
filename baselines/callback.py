"""What happens between the steps of a training: look, validate, store, stop."""

from __future__ import annotations

import math
import signal
import threading
from dataclasses import replace
from types import FrameType
from typing import Any

import torch
from pytorch_lightning import Callback, LightningModule, Trainer

from .checkpoint import load, rounded_weights, save
from .job import STOPPED_EARLY, TrainingJob, TrainingRecord
from .machine import return_memory
from .module import TOTAL, TrainingModule
from .validation import Validation

__all__ = [
    "TrainingCallback",
]


class TrainingCallback(Callback):
    """Logs, validates and stores a training, and stops it early or when a user interrupts.

    An interrupt lets the running step end and stores the state; a second one stops at once.
    """

    def __init__(
        self,
        job: TrainingJob,
        ledger: TrainingRecord,
        *,
        validation: Validation | None,
        steps: int,
        windows: int,
    ) -> None:
        self.job = job  # the training that was asked for
        self.ledger = ledger  # what it has done so far
        self.validation = validation  # None validates never
        self.steps = steps  # of the whole training
        self.windows = windows  # of the training subsets
        self._interrupted = False
        self._handlers: dict[int, Any] = {}

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        """Listen to interrupts; begin to count."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._interrupt)
        steps = self.steps
        self.job.meter.begin("training", total=steps, scenarios=steps, done=_of(module).step)

    def on_train_batch_end(
        self, trainer: Trainer, module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        """Do what is due after a step."""
        trained = _of(module)
        step, steps, recipe = trained.step, self.steps, trained.recipe
        self.ledger.stepped(step, batch=recipe.batch * trainer.world_size, windows=self.windows)
        last = step >= steps
        if last or step % recipe.log_every == 0 or step == 1:
            self._log(trainer, trained)
            return_memory()
        self.job.meter.count(1, scenarios=1)
        if self.validation is not None and self._is_due(trained, self.validation):
            self._validate(trainer, trained, self.validation)
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
            self._write_record(trainer, _of(module))

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
        self.job.meter.stage = f"loss {self.ledger.loss[TOTAL]:.3g}"
        if trainer.logger is not None:
            values = {f"loss/{name}": value for name, value in self.ledger.loss.items()}
            trainer.logger.log_metrics({**values, "learning_rate": module.learning_rate}, step=module.step)

    def _is_due(self, module: TrainingModule, validation: Validation) -> bool:
        """Return whether the step is followed by a validation."""
        recipe, model = module.recipe, module.model
        trained, rolled = recipe.batch * model.future, sum(validation.frames.values())
        count = recipe.validations(self.steps, trained=trained, rolled=rolled)
        return recipe.is_validated(module.step, steps=self.steps, validations=count)

    def _validate(self, trainer: Trainer, module: TrainingModule, validation: Validation) -> None:
        """Validate in the first process; all act on what it finds."""
        value = 0.0
        with self.ledger.validating(trainer.world_size, device=self.job.device):
            if trainer.is_global_zero:
                value = validation(module.model)
            value = float(trainer.strategy.broadcast(value))
        better = self.ledger.validated(validation.metric, value)
        if trainer.logger is not None:
            trainer.logger.log_metrics({f"validation/{validation.metric}": value}, step=module.step)
        if better and trainer.is_global_zero:
            save(self.job.folder.weights, self.job.checkpoint(self.ledger, rounded_weights(module.model)))
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
        self._write_record(trainer, module)
        folder = self.job.folder
        optimizer = trainer.optimizers[0].state_dict()
        save(folder.checkpoint, self.job.checkpoint(self.ledger, state, optimizer))
        if self.ledger.best_step is None or not folder.weights.exists():
            save(folder.weights, self.job.checkpoint(self.ledger, rounded_weights(module.model)))
        else:  # the weights stay those of the best step, their budget is that of the training
            best = load(folder.weights)
            budget = self.job.budget(self.ledger).model_dump(mode="json")
            save(folder.weights, replace(best, training={**best.training, "budget": budget}))

    def _write_record(self, trainer: Trainer, module: TrainingModule) -> None:
        self.ledger.read_clocks(trainer.world_size, device=self.job.device)
        more = {"steps": self.steps, "windows": self.windows}
        self.job.folder.write_record(self.job.record(module.model, self.ledger, **more))


def _of(module: LightningModule) -> TrainingModule:
    if not isinstance(module, TrainingModule):
        raise TypeError(type(module).__name__)
    return module
