"""A baseline as pytorch-lightning trains it: seeded steps, and what happens between
them.

Random numbers are a function of seed, step and process, and of nothing else, so that no
state of any generator has to be stored: a training that was interrupted draws, at every
step, what an uninterrupted one draws there, whatever happened in between.
"""

from __future__ import annotations

import logging
import math
import random
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from types import FrameType
from typing import Any

import numpy as np
import torch
from pytorch_lightning import Callback, LightningModule, Trainer
from torch import Tensor
from torch.optim import AdamW, Optimizer
from torch.utils.data import DataLoader

from lagbench.errors import UsageError, WorkFailedError
from lagbench.tensors import TensorWindow

from .baseline import Baseline, Batch
from .checkpoint import load, rounded_weights, save
from .job import STOPPED_EARLY, TrainingJob, TrainingRecord
from .machine import return_memory
from .recipe import TrainingOptions
from .rollout import Validation, replaced

MEAN = "mean"  # name of a weight's running mean in the optimiser's state
TOTAL = "total"  # name of the weighted sum among the loss terms


class TrainingModule(LightningModule):
    """Trains a baseline."""

    def __init__(
        self,
        model: Baseline,
        options: TrainingOptions,
        *,
        loader: Callable[[int, int], DataLoader[TensorWindow]],
        steps: int,
        processes: int = 1,
        step: int = 0,
        optimizer: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.model = model  # the baseline
        self.recipe = options
        self.steps = steps  # steps of the whole training
        self.step = step  # optimiser steps made
        # raw loss terms of the last step, and their weighted sum as 'total'
        self.terms: dict[str, Tensor] = {}
        self._rate = options.learning_rate * processes
        # returns the batches of a process, by its rank among so many
        self._loader = loader
        self._resumed = optimizer

    @property
    def learning_rate(self) -> float:
        """Rate of the next step."""
        plan = self.recipe.schedule
        return self._rate * plan.at(
            self.step, steps=self.steps, warmup=self.recipe.warmup_steps
        )

    def train_dataloader(self) -> DataLoader[TensorWindow]:
        """Return the batches of this process, from the next step on."""
        return self._loader(self.global_rank, self.trainer.world_size)

    def configure_optimizers(self) -> Optimizer:
        """Return AdamW, which is Adam where weights do not decay, as an earlier run
        left it.
        """
        if next(self.model.parameters(), None) is None:
            raise UsageError(
                "a model without parameters",
                where=type(self.model).__qualname__,
                expected="one that learns",
                fix="write its predictions without a training: "
                "lagbench.submission.write",
            )
        self._optimizer = AdamW(
            self.model.parameters(),
            lr=self._rate,
            weight_decay=self.recipe.weight_decay,
            fused=True,
        )
        if self._resumed is not None:
            self._optimizer.load_state_dict(dict(self._resumed))
        return self._optimizer

    def training_step(self, batch: Batch, index: int) -> Tensor:
        """Return the loss of a batch, and keep its raw terms."""
        del index
        where = f"{type(self.model).__qualname__}.forward"
        seed = seed_of(self.recipe.seed, self.step, self.global_rank)
        reseed(seed)
        terms = self.model(batch, torch.Generator(device=self.device).manual_seed(seed))
        if isinstance(terms, Mapping):
            named = terms
        else:
            named = {"no dict": terms}
        fit = named is terms and all(
            isinstance(one, Tensor) and one.numel() == 1 for one in named.values()
        )
        if not named or not fit:
            shapes = [
                f"{name}: {getattr(one, 'shape', type(one).__name__)}"
                for name, one in named.items()
            ]
            raise UsageError(
                "a model returned no loss",
                where=where,
                expected="a dict of terms, tensors of one number each",
                got=", ".join(shapes) or "an empty dict",
                fix="mend that class; docs/baselines.md has an example",
            )
        weights = {name: self.model.weights.get(name, 1.0) for name in terms}
        parts = [
            terms[name].reshape(()) * weight
            for name, weight in weights.items()
            if weight != 0
        ]
        if not parts:
            raise WorkFailedError(
                "every term of the loss has weight 0", got=", ".join(terms)
            )
        total = torch.stack(parts).sum()
        if not total.requires_grad:
            raise UsageError(
                "nothing can be learned from the loss",
                where=where,
                expected="a term, of a weight above 0, that depends on the model's "
                "parameters",
                got=", ".join(terms),
                fix="mend that class, or the weights",
            )
        self.terms = {
            name: value.detach() for name, value in (*terms.items(), (TOTAL, total))
        }
        return total

    def configure_gradient_clipping(
        self,
        optimizer: Optimizer,
        gradient_clip_val: float | None = None,
        gradient_clip_algorithm: str | None = None,
    ) -> None:
        """Clip the gradient; refuse one that is not finite before it reaches the
        weights.

        Over several processes the gradient is their mean by now, so that all of them
        stop.
        """
        del gradient_clip_val, gradient_clip_algorithm
        gradients = [p.grad for p in self.model.parameters() if p.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients, foreach=None)
        if not math.isfinite(float(norm)):
            raise self.not_finite()
        if self.recipe.clip is not None:
            torch.nn.utils.clip_grads_with_norm_(
                self.model.parameters(), self.recipe.clip, norm
            )
        for group in optimizer.param_groups:
            group["lr"] = self.learning_rate

    def optimizer_step(self, *args: Any, **kwargs: Any) -> None:  # noqa: ANN401 (Lightning's)
        """Make a step, count it, and let the mean of the weights follow.

        The mean is kept in the optimiser's state, which checkpoints hold. It follows
        faster at first: where training starts is soon forgotten.
        """
        super().optimizer_step(*args, **kwargs)
        self.step += 1
        if self.recipe.ema > 0.0:
            kept = min(self.recipe.ema, self.step / (self.step + 9.0))
            for parameter, state in self._optimizer.state.items():
                if MEAN not in state:
                    state[MEAN] = parameter.detach().clone()
                state[MEAN].lerp_(parameter.detach(), 1.0 - kept)

    def published(self) -> AbstractContextManager[None]:
        """Put the mean of the weights in their place for a while, where one is kept."""
        states = self._optimizer.state.items()
        return replaced(
            {parameter: state[MEAN] for parameter, state in states if MEAN in state}
        )

    def not_finite(self) -> WorkFailedError:
        """Return the error that names step and terms."""
        broken = [
            name
            for name, value in self.terms.items()
            if not torch.isfinite(value).all()
        ]
        named = [name for name in broken if name != TOTAL] or [
            "none of the terms: the gradient"
        ]
        return WorkFailedError(
            "the loss is not finite",
            where=f"step {self.step + 1}",
            got=f"NaN or infinite: {', '.join(named)}",
            fix="lower training.learning_rate or set training.clip=1;"
            " checkpoint.pt holds the last good weights",
        )


class TrainingCallback(Callback):
    """Logs, validates and stores a training, and stops it early or when a user
    interrupts.

    An interrupt lets the running step end and stores the state; a second one stops at
    once.
    """

    def __init__(
        self,
        job: TrainingJob,
        ledger: TrainingRecord,
        *,
        validation: Validation | None,
        windows: int,
    ) -> None:
        self.job = job  # the training that was asked for
        self.ledger = ledger  # what it has done so far
        self.validation = validation  # None validates never
        self.windows = windows  # of the training subsets
        self._interrupted = False
        self._handlers: dict[int, Any] = {}

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        """Listen to interrupts; begin to count; validate weights that the training
        starts from.
        """
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._interrupt)
        steps = _of(module).steps
        step = _of(module).step
        self.job.meter.begin("training", total=steps, scenarios=steps, done=step)
        if (
            self.validation is not None
            and self.job.recipe.start
            and not self.ledger.validation
        ):
            self._validate(trainer, _of(module), self.validation)
            # weights without a checkpoint could not be gone on with
            self._store(trainer, _of(module))

    def on_train_batch_end(
        self,
        trainer: Trainer,
        module: LightningModule,
        outputs: object,
        batch: object,
        batch_idx: int,
    ) -> None:
        """Do what is due after a step."""
        trained = _of(module)
        step = trained.step
        steps = trained.steps
        recipe = trained.recipe
        seen = step * recipe.batch * trainer.world_size
        self.ledger.step = step
        self.ledger.windows_seen = seen
        self.ledger.epochs = seen / self.windows
        last = step >= steps
        if last or step % recipe.log_every == 0 or step == 1:
            terms = self.ledger.loss = {
                name: float(value) for name, value in trained.terms.items()
            }
            if not math.isfinite(terms[TOTAL]) and trainer.world_size == 1:
                raise trained.not_finite()
            self.job.meter.stage = f"loss {terms[TOTAL]:.3g}"
            if trainer.logger is not None:
                values = {f"loss/{name}": value for name, value in terms.items()}
                trainer.logger.log_metrics(
                    {**values, "learning_rate": trained.learning_rate}, step=step
                )
            return_memory()
        self.job.meter.count(1, scenarios=1)
        if self.validation is not None:
            predicted = (
                recipe.batch * trained.model.future,
                sum(self.validation.frames.values()),
            )
            count = recipe.validations(steps, trained=predicted[0], rolled=predicted[1])
            if recipe.is_validated(step, steps=steps, validations=count):
                self._validate(trainer, trained, self.validation)
        stop = trainer.strategy.reduce_boolean_decision(self._interrupted, all=False)
        if stop or trainer.should_stop or last:
            over = last or self.ledger.state == STOPPED_EARLY
            if stop and not over:
                self.ledger.state = "interrupted"
            else:
                self.ledger.state = self.ledger.state
            trainer.should_stop = True
        if (
            trainer.should_stop
            or step % (recipe.checkpoint_every or max(1, steps // 20)) == 0
        ):
            self._store(trainer, trained)

    def on_train_end(self, trainer: Trainer, module: LightningModule) -> None:
        """Give the signals back."""
        self._release()

    def on_exception(
        self, trainer: Trainer, module: LightningModule, exception: BaseException
    ) -> None:
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

    def _validate(
        self, trainer: Trainer, module: TrainingModule, validation: Validation
    ) -> None:
        """Validate in the first process; all act on what it finds."""
        value = 0.0
        with self.ledger.validating(trainer.world_size, device=self.job.device):
            if trainer.is_global_zero:
                with module.published():
                    value = validation(module.model)
            value = float(trainer.strategy.broadcast(value))
        better = self.ledger.validated(validation.metric, value)
        if trainer.logger is not None:
            trainer.logger.log_metrics(
                {f"validation/{validation.metric}": value}, step=module.step
            )
        if better and trainer.is_global_zero:
            self._publish(module)
        patience = module.recipe.patience
        if (
            patience is not None
            and self.ledger.since_best() >= patience
            and module.step < module.steps
        ):
            self.ledger.state = STOPPED_EARLY
            trainer.should_stop = True

    def _publish(self, module: TrainingModule) -> None:
        """Write the weights to predict from."""
        with module.published():
            save(
                self.job.folder.weights,
                self.job.checkpoint(self.ledger, rounded_weights(module.model)),
            )

    def _store(self, trainer: Trainer, module: TrainingModule) -> None:
        """Write checkpoint and record; a model whose weights are not finite is not
        stored.
        """
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
            self._publish(module)
        else:  # the weights stay those of the best step, their budget is that of the training
            best = load(folder.weights)
            budget = self.job.budget(self.ledger).model_dump(mode="json")
            save(
                folder.weights,
                replace(best, training={**best.training, "budget": budget}),
            )

    def _write_record(self, trainer: Trainer, module: TrainingModule) -> None:
        self.ledger.read_clocks(trainer.world_size, device=self.job.device)
        record = self.job.record(
            module.model, self.ledger, steps=module.steps, windows=self.windows
        )
        self.job.folder.write_record(record)


def _of(module: LightningModule) -> TrainingModule:
    if not isinstance(module, TrainingModule):
        raise TypeError(type(module).__name__)
    return module


def seed_of(seed: int, *place: int) -> int:
    """Return a seed of 63 bits for a place in a training, such as (step, process)."""
    return int(
        np.random.SeedSequence((seed, *place)).generate_state(1, np.uint64)[0]
        >> np.uint64(1)
    )


def reseed(seed: int) -> None:
    """Set the global generators of Python, NumPy and torch, which layers of others draw
    from.
    """
    random.seed(seed)
    np.random.seed(seed % 2**32)  # noqa: NPY002 (what PyTorch Geometric may draw from)
    torch.manual_seed(seed)


@contextmanager
def generators_kept() -> Iterator[None]:
    """Give the caller's global generators back as they were."""
    python = random.getstate()
    numpy = np.random.get_state()  # noqa: NPY002 (the global one)
    with torch.random.fork_rng():
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(numpy)  # noqa: NPY002


@contextmanager
def quiet() -> Iterator[None]:
    """Keep Lightning's advice from our users: none of it is about what they asked
    for.
    """
    names = (
        "lightning.pytorch",
        "lightning.fabric",
        "pytorch_lightning",
        "lightning_fabric",
    )
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", module=r"(pytorch_lightning|lightning_fabric|tensorboard)(\..*)?"
        )
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)
