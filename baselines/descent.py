"""Gradient descent over windows, by pytorch-lightning, on one device or several."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain, count, islice
from typing import Literal

from pytorch_lightning import Trainer
from pytorch_lightning.loggers import TensorBoardLogger
from torch.utils.data import DataLoader, Sampler

from .baseline import Baseline
from .checkpoint import load_weights
from .job import Job
from .keeper import Keeper
from .ledger import STOPPED_EARLY, Ledger
from .machine import multiplies_bfloat16
from .module import TrainingModule
from .validation import validation_windows
from .windows import Window, WindowDataset, WindowSampler, collate

__all__ = ["StepBatches", "descend", "quiet"]

LOGGERS = ("lightning.pytorch", "lightning.fabric", "pytorch_lightning", "lightning_fabric")


class StepBatches(Sampler[list[int]]):
    """Windows of each step of a training, from any step on.

    Args:
        sampler: draws the windows of one process, epoch after epoch.
        batch: windows of a step.
        first: step to begin with, from 0.
        last: step to end before.
    """

    def __init__(self, sampler: WindowSampler, batch: int, *, first: int, last: int) -> None:
        self.sampler = sampler
        self.batch = batch
        self.steps = range(first, last)

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.steps)

    def __iter__(self) -> Iterator[list[int]]:
        """Yield the windows of each step."""
        epoch, used = divmod(self.steps.start * self.batch, len(self.sampler))
        self.sampler.seek(epoch, used * self.sampler.ranks)
        drawn = chain.from_iterable(self.sampler for _ in count())
        for _ in self.steps:
            yield list(islice(drawn, self.batch))


def descend(job: Job, model: Baseline) -> tuple[Ledger, int]:
    """Train a model; return the ledger and the steps of the whole training.

    Raises:
        WorkFailedError: the loss is not finite.
        KeyboardInterrupt: interrupted; the state after the last step is stored.
    """
    facts, options = job.facts, job.recipe.training
    data = WindowDataset(
        facts.split,
        subset=options.windows,
        size=facts.size,
        root=job.root,
        registry=job.registry,
        history=model.history,
        future=model.future,
    )
    steps = options.total_steps(len(data), processes=job.processes)
    ledger = job.ledger()
    module = _module(job, model, data, ledger, steps)
    if ledger.state != STOPPED_EARLY:
        ledger.state = "finished" if ledger.step >= steps else "running"
    if ledger.state != "running":
        return ledger, steps
    keeper = Keeper(
        job.folder,
        ledger,
        about=job.checkpoint(),
        record=job.record(model, steps=steps, windows=len(data)),
        validation=validation_windows(job),
        meter=job.meter,
    )
    with quiet():
        _fit(_trainer(job, keeper), module)
    if ledger.state == "interrupted":
        raise KeyboardInterrupt
    return ledger, steps


def _module(job: Job, model: Baseline, data: WindowDataset, ledger: Ledger, steps: int) -> TrainingModule:
    """Return the module at the step where an earlier run ended."""
    options, earlier = job.recipe.training, job.earlier
    if earlier is not None:
        load_weights(model, earlier.weights, where=str(job.folder.checkpoint))

    def loader(rank: int, ranks: int) -> DataLoader[Window]:
        sampler = WindowSampler(data, seed=options.seed, rank=rank, ranks=ranks)
        batches = StepBatches(sampler, options.batch, first=ledger.step, last=steps)
        return DataLoader(
            data,
            batch_sampler=batches,
            collate_fn=collate,
            num_workers=job.workers,
            persistent_workers=job.workers > 0,
            multiprocessing_context="spawn" if job.workers else None,
        )

    return TrainingModule(
        model,
        options,
        loader=loader,
        steps=steps,
        processes=job.processes,
        step=ledger.step,
        optimizer=earlier.optimizer if earlier else None,
    )


def _trainer(job: Job, keeper: Keeper) -> Trainer:
    options = job.recipe.training
    return Trainer(
        accelerator="gpu" if job.device == "cuda" else "cpu",
        devices=_devices(job),
        num_nodes=int(os.environ.get("GROUP_WORLD_SIZE", "1")),
        strategy="ddp" if job.processes > 1 else "auto",
        precision=_precision(options.precision, job.device),
        max_epochs=1,
        logger=TensorBoardLogger(job.folder.path, name="", version=job.folder.logs.name),
        callbacks=[keeper],
        default_root_dir=job.folder.path,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
    )


def _devices(job: Job) -> int:
    """Return the processes on this machine: torchrun's number where it started us."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", job.processes))


def _precision(name: str, device: str) -> Literal["32-true", "bf16-mixed"]:
    half = name == "bf16" or (name == "auto" and multiplies_bfloat16(device))
    return "bf16-mixed" if half else "32-true"


def _fit(trainer: Trainer, module: TrainingModule) -> None:
    try:
        trainer.fit(module)
    except SystemExit:  # what Lightning makes of a second Ctrl-C
        raise KeyboardInterrupt from None


@contextmanager
def quiet() -> Iterator[None]:
    """Keep Lightning's advice from our users: none of it is about what they asked for."""
    loggers = [logging.getLogger(name) for name in LOGGERS]
    levels = [logger.level for logger in loggers]
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", module=r"(pytorch_lightning|lightning_fabric|tensorboard)(\..*)?")
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)
