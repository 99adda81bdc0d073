"""The loop of a training: steps, logs, validations, checkpoints, and its early end.

An interrupt, or a terminal that closes, lets the running step end and stores the state;
a second interrupt stops at once.
Lightning Fabric starts the processes and connects them.
"""

from __future__ import annotations

import logging
import math
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType

import torch
from lightning_fabric import Fabric
from torch.utils.data import DataLoader
from torch.utils.tensorboard import SummaryWriter

from lagbench.errors import WorkFailedError
from lagbench.tensors import Batch, TensorWindow

from .checkpoint import Checkpoint, load, round_weights
from .job import TrainingJob
from .machine import multiplies_bfloat16, return_memory
from .optimisation import TOTAL, Optimisation
from .randomness import derive_seed, seed_generators
from .rollout import Validation
from .training_log import STOPPED_EARLY, TrainingLog

# returns the batches of a process, by its rank among so many processes
Loader = Callable[[int, int], DataLoader[TensorWindow]]


def launch_fabric(job: TrainingJob) -> Fabric:
    """Return Fabric with the processes of a job started."""
    accelerator = "cpu"
    if job.device == "cuda":
        accelerator = "gpu"
    strategy = "auto"
    if job.processes > 1:
        strategy = "ddp"
    fabric = Fabric(
        accelerator=accelerator,
        # the processes on this machine: torchrun's number where it started us
        devices=int(os.environ.get("LOCAL_WORLD_SIZE", job.processes)),
        num_nodes=int(os.environ.get("GROUP_WORLD_SIZE", "1")),
        strategy=strategy,
    )
    fabric.launch()
    return fabric


def uses_bfloat16(job: TrainingJob) -> bool:
    """Return whether a training multiplies matrices in bfloat16."""
    precision = job.recipe.training.precision
    if precision == "auto":
        return multiplies_bfloat16(job.device)
    return precision == "bf16"


class Interrupts:
    """Notes the first interrupt of a user, and lets a second one through.

    A terminal that closes interrupts too. It may say so twice, by the shell and by the
    system, so a second one of these signals changes nothing. Where a user has them
    ignored, as with nohup, they stay ignored.
    """

    def __init__(self) -> None:
        self.is_set = False

    @contextmanager
    def listen(self) -> Iterator[None]:
        """Listen for a while; signals are the main thread's alone."""
        handlers = {}
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                handlers[number] = signal.signal(number, self._note)
            hangup = getattr(signal, "SIGHUP", None)  # Windows has none
            if hangup is not None and signal.getsignal(hangup) != signal.SIG_IGN:
                handlers[hangup] = signal.signal(hangup, self._note_hangup)
        try:
            yield
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.is_set:
            raise KeyboardInterrupt
        self.is_set = True

    def _note_hangup(self, number: int, frame: FrameType | None) -> None:
        self.is_set = True


class TrainingLoop:
    """Trains a baseline in one process, beside others perhaps.

    Args:
        job: the training to do.
        log: its log so far.
        fabric: processes and device.
        optimisation: makes the steps.
        validation: scenarios of validations; None validates never.
        windows: windows of the training subsets.
    """

    def __init__(
        self,
        job: TrainingJob,
        log: TrainingLog,
        *,
        fabric: Fabric,
        optimisation: Optimisation,
        validation: Validation | None,
        windows: int,
    ) -> None:
        self.job = job
        self.log = log
        self.fabric = fabric
        self.optimisation = optimisation
        self.validation = validation
        self.windows = windows
        self._interrupts = Interrupts()
        self._uses_bfloat16 = uses_bfloat16(job)
        self._is_over = False
        # weights of the start, not written while an earlier training lies in the folder
        self._start_weights: Checkpoint | None = None
        self._tensorboard: SummaryWriter | None = None

    def run(self, loader: Loader) -> None:
        """Train to the end, or until validations or a user stop it."""
        steps = self.optimisation.steps
        step = self.optimisation.step
        with ExitStack() as stack:
            if self.fabric.is_global_zero:
                writer = _open_tensorboard(self.job.folder.tensorboard)
                self._tensorboard = stack.enter_context(writer)
            try:
                with self._interrupts.listen():
                    self.job.meter.begin(
                        "training", total=steps, scenarios=steps, done=step
                    )
                    self._train(loader)
            except Exception:
                # The checkpoint stays as it is.
                if self.fabric.is_global_zero:
                    self.log.state = "failed"
                    # A disk that takes no log does not hide the first error.
                    with suppress(WorkFailedError):
                        self._read_clocks()
                        self._write_log()
                raise
            finally:
                if self.job.folder.has_earlier_files:
                    self.job.folder.remove_new_logs()

    def _train(self, loader: Loader) -> None:
        fabric = self.fabric
        model = self.optimisation.model
        # One process returns the model; several wrap it in DDP, which averages
        # gradients.
        forward = fabric.strategy.setup_module(model)
        model.train()
        if self.validation is not None and self._starts_from_weights():
            self._validate(self.validation)
            # No training could go on from weights without a checkpoint. The weights
            # of --start alone do not replace an earlier training.
            if not self.job.folder.has_earlier_files:
                self._store()

        for batch in loader(fabric.global_rank, fabric.world_size):
            self._make_step(forward, batch.to(fabric.device))
            self._log_step()
            if self.validation is not None and self._is_validation_due(self.validation):
                self._validate(self.validation)
            self._check_end()
            if self._is_over or self._is_checkpoint_due():
                self._store()
            if self._is_over:
                return

    def _starts_from_weights(self) -> bool:
        """Return whether the training is at its start, and starts from weights."""
        return bool(self.job.recipe.start) and not self.log.validation

    def _make_step(self, forward: torch.nn.Module, batch: Batch) -> None:
        optimisation = self.optimisation
        seed = derive_seed(
            optimisation.options.seed, optimisation.step, self.fabric.global_rank
        )
        seed_generators(seed)
        generator = torch.Generator(device=self.fabric.device).manual_seed(seed)
        # A cache of rounded weights would sum the gradients of their uses in bfloat16.
        with torch.autocast(
            self.fabric.device.type,
            dtype=torch.bfloat16,
            enabled=self._uses_bfloat16,
            cache_enabled=False,
        ):
            terms = forward(batch, generator)
            loss = optimisation.weigh(terms)
        optimisation.make_step(loss)

    def _log_step(self) -> None:
        """Count a step, and log its loss where that is due."""
        step = self.optimisation.step
        options = self.optimisation.options
        seen = step * options.batch * self.fabric.world_size
        self.log.step = step
        self.log.windows_seen = seen
        self.log.epochs = seen / self.windows

        is_last = step >= self.optimisation.steps
        if is_last or step == 1 or step % options.log_every == 0:
            terms = {}
            for name, value in self.optimisation.terms.items():
                terms[name] = float(value)
            self.log.loss = terms
            total = terms[TOTAL]
            if not math.isfinite(total) and self.fabric.world_size == 1:
                raise self.optimisation.not_finite()
            self.job.meter.stage = f"loss {total:.3g}"
            for name, number in terms.items():
                self._plot(f"loss/{name}", number)
            self._plot("learning_rate", self.optimisation.learning_rate)
            return_memory()
        self.job.meter.count(1, scenarios=1)

    def _plot(self, name: str, value: float) -> None:
        """Write a number for TensorBoard."""
        if self._tensorboard is not None:
            self._tensorboard.add_scalar(name, value, self.optimisation.step)

    def _is_validation_due(self, validation: Validation) -> bool:
        options = self.optimisation.options
        steps = self.optimisation.steps
        count = options.count_validations(
            steps,
            trained=options.batch * self.optimisation.model.future,
            rolled=sum(validation.frames.values()),
        )
        return options.is_validated(
            self.optimisation.step, steps=steps, validations=count
        )

    def _validate(self, validation: Validation) -> None:
        """Validate in the first process; all processes act on the value."""
        value = 0.0
        with self.log.time_validation(self.fabric.world_size, device=self.job.device):
            if self.fabric.is_global_zero:
                with self.optimisation.use_mean():
                    value = validation.measure(self.optimisation.model)
            value = float(self.fabric.broadcast(value))
        is_best = self.log.add_validation(validation.metric, value)
        self._plot(f"validation/{validation.metric}", value)
        if is_best and self.fabric.is_global_zero:
            self._publish()

        patience = self.optimisation.options.patience
        is_last = self.optimisation.step >= self.optimisation.steps
        if patience is None or is_last:
            return
        if self.log.validations_since_best() >= patience:
            self.log.state = STOPPED_EARLY
            self._is_over = True

    def _check_end(self) -> None:
        """Find out whether the training ends after this step."""
        if self.optimisation.step >= self.optimisation.steps:
            self._is_over = True
        # An interrupt of one process ends all.
        interrupts = torch.tensor(float(self._interrupts.is_set))
        total = self.fabric.all_reduce(interrupts, reduce_op="sum")
        if float(total) > 0.0:  # type: ignore[arg-type]
            if not self._is_over:
                self.log.state = "interrupted"
            self._is_over = True

    def _is_checkpoint_due(self) -> bool:
        every = self.optimisation.options.checkpoint_every
        if every is None:
            every = max(1, self.optimisation.steps // 20)
        return self.optimisation.step % every == 0

    def _publish(self) -> None:
        """Write the weights to predict from.

        Those of the start wait for the first :meth:`_store` where an earlier training
        lies in the folder.
        """
        folder = self.job.folder
        with self.optimisation.use_mean():
            weights = round_weights(self.optimisation.model)
            if self.log.step == 0 and folder.has_earlier_files:
                copies = {name: value.clone() for name, value in weights.items()}
                self._start_weights = self.job.checkpoint(self.log, copies)
                return
            checkpoint = self.job.checkpoint(self.log, weights)
            folder.save(folder.weights, checkpoint)
        self._start_weights = None

    def _store(self) -> None:
        """Write checkpoint and log.

        An interrupted training that has stored nothing yet leaves an earlier training
        in the folder.

        Raises:
            WorkFailedError: weights are not finite; the files stay as they are.
        """
        is_last = self.optimisation.step >= self.optimisation.steps
        if self.log.state == "running" and is_last:
            self.log.state = "finished"
        if not self.fabric.is_global_zero:
            return
        folder = self.job.folder
        if self.log.state == "interrupted" and folder.has_earlier_files:
            return
        weights = self.optimisation.model.state_dict()
        for value in weights.values():
            if not torch.isfinite(value).all():
                raise self.optimisation.not_finite()
        if self._start_weights is not None:
            folder.save(folder.weights, self._start_weights)
            self._start_weights = None
        self._read_clocks()
        optimizer_state = self.optimisation.state_tensors()
        checkpoint = self.job.checkpoint(self.log, weights, optimizer_state)
        folder.save(folder.checkpoint, checkpoint)
        self._write_log()

        if self.log.best_step is None or not folder.weights.exists():
            self._publish()
            return
        # The weights stay those of the best step; their budget is that of the training.
        best = load(folder.weights)
        budget = self.job.budget(self.log)
        training = dict(best.training)
        training["budget"] = budget.model_dump(mode="json")
        best = replace(best, training=training)
        folder.save(folder.weights, best)

    def _read_clocks(self) -> None:
        self.log.read_clocks(self.fabric.world_size, device=self.job.device)

    def _write_log(self) -> None:
        if self.job.folder.has_earlier_files:
            return  # the log in the folder is that of the earlier training
        log = self.job.log_as_json(
            self.optimisation.model,
            self.log,
            steps=self.optimisation.steps,
            windows=self.windows,
        )
        self.job.folder.write_log(log)


@contextmanager
def _open_tensorboard(folder: Path) -> Iterator[SummaryWriter]:
    """Yield a writer into a folder, and close it.

    The writer has a thread of its own, which may meet an error of the disk. Its
    traceback is not shown: the training meets the same error at its next number.
    """
    before = set(threading.enumerate())
    writer = SummaryWriter(str(folder))
    threads = set(threading.enumerate()) - before
    show = threading.excepthook

    def show_others(details: threading.ExceptHookArgs) -> None:
        if not isinstance(details.exc_value, OSError):
            show(details)

    threading.excepthook = show_others
    try:
        yield writer
        writer.close()
    except BaseException:
        # An error of closing does not hide the first one.
        with suppress(OSError):
            writer.close()
        raise
    finally:
        # A thread that met an error calls the hook a moment later.
        for thread in threads:
            thread.join(timeout=1)
        threading.excepthook = show


@contextmanager
def silence_lightning() -> Iterator[None]:
    """Keep Lightning's and TensorBoard's advice from users, who asked for none."""
    logger = logging.getLogger("lightning_fabric")
    fabric_logger = logging.getLogger("lightning.fabric")
    levels = (logger.level, fabric_logger.level)
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", module=r"(lightning_fabric|tensorboard)(\..*)?"
        )
        logger.setLevel(logging.ERROR)
        fabric_logger.setLevel(logging.ERROR)
        try:
            yield
        finally:
            logger.setLevel(levels[0])
            fabric_logger.setLevel(levels[1])
