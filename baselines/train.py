"""Train a baseline: seeded, resumable, on one device or several.

Most baselines take steps over windows; models with a closed form are fitted to whole
scenarios instead. A step draws its windows and its noise from (seed, step, process)
alone. So a training that was interrupted and resumed ends, on one thread, with the bits
of an uninterrupted one. An interrupt lets the running step end and stores the state; a
second one stops at once.

``torchrun --nproc-per-node N -m lagbench train ...`` starts several processes, which
average their gradients (DDP).
"""

from __future__ import annotations

import csv
import json
import math
import os
import platform
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from itertools import chain, count, islice, pairwise
from pathlib import Path
from types import FrameType

import numpy as np
import torch
import torch.distributed
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader, Sampler

from lagbench.atomic import check_writable, write_atomically
from lagbench.data.checksums import round_digits
from lagbench.data.layout import expand_home
from lagbench.data.local import check_contents, locate
from lagbench.data.registry import Registry
from lagbench.errors import DataError, UsageError
from lagbench.store.copy import scenario_files
from lagbench.submission.budget import MOST_VALIDATIONS, Budget, Track, track_of
from lagbench.tensors import Batch, collate
from lagbench.torch import WindowDataset, WindowSampler
from lagbench.work.run import Meter, Progress

from .augmentation import check_symmetry
from .baseline import Baseline, DatasetInfo, count_parameters
from .catalogue import find
from .checkpoint import Checkpoint, load, load_weights, round_weights, save
from .dataset_info import find_forcing, read_dataset_info
from .machine import choose_device, hardware, is_helper, use_threads
from .optimisation import Optimisation
from .randomness import derive_seed, preserve_generators, seed_generators
from .recipe import Recipe, TrainingOptions, recipe_for
from .rollout import Validation, load_validation, scenario_batch
from .start import start_from
from .training_log import OVER, STOPPED_EARLY, TrainingLog

WEIGHTS = "weights.safetensors"  # the best weights in bfloat16, to predict from
CHECKPOINT = "checkpoint.safetensors"  # the last state, to go on from
LOG = "training.json"  # the log of the training
LOSSES = "losses.csv"  # loss terms and learning rate of some steps
LOG_FORMAT = 1  # of training.json
# libraries whose versions decide the result
LIBRARIES = ("lagbench", "torch", "torch-geometric", "numpy", "scipy")


@dataclass(frozen=True, kw_only=True)
class TrainingResult:
    """Files, state and costs of a training."""

    baseline: str  # name of the baseline
    split: str  # name of the split
    size: str  # name of the size
    recipe: str  # name of the recipe
    folder: Path  # folder of the run
    weights: Path  # weights to predict from
    checkpoint: Path  # last state, to go on from
    state: str  # finished, stopped early or interrupted
    start: str  # weights of its start; empty for random ones
    first_step: int  # optimiser steps that were there when this call began
    step: int  # optimiser steps made
    steps: int  # steps of the whole training; a fit counts as one
    parameters: int  # trainable parameters
    # raw loss terms of the last step, and their weighted sum 'total'
    loss: dict[str, float]
    windows_seen: int  # training windows of all steps
    epochs: float  # the same over the windows of the training subsets
    # metric of validations, lower is better; None without a validation
    metric: str | None
    best_value: float | None  # its least value
    best_step: int | None
    device: str  # processor or GPU
    threads: int  # of a process on the CPU
    track: Track | None  # equal compute, converged or none
    cpu_seconds: float  # processor time in all runs [s]
    validation_cpu_seconds: float  # of it that of validations [s]
    is_fitted: bool  # whether the model was fitted as a whole, without steps
    gpu_seconds: float  # time times the GPUs in use [s]
    wall_seconds: float  # time of all runs [s]


class UnseenForcingWarning(UserWarning):
    """A model is trained that does not see what drives the flow."""


def train(
    baseline: str,
    split: str,
    size: str | None = None,
    *,
    recipe: str | None = None,
    settings: tuple[str, ...] = (),
    seed: int | None = None,
    start: str | Path | None = None,
    root: str | Path | None = None,
    output: str | Path | None = None,
    fresh: bool = False,
    device: str = "auto",
    threads: int | None = None,
    progress: Callable[[Progress], None] | None = None,
    registry: Registry | None = None,
) -> TrainingResult:
    """Train a baseline on the windows of a split; go on with an earlier run if any.

    Args:
        baseline: name of the baseline.
        split: name of the split, or the path of a local one.
        size: name of the size; the only one that is there when None.
        recipe: variant of the recipe, or a YAML file of recipes.
        settings: changes to the recipe, as in ``training.steps=100``.
        seed: seed in place of the recipe's.
        start: weights to start from, perhaps of another size; random ones when None.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder.
        output: folder of the run; by default
            ``runs/<split>/<size>[-<variant>]/<baseline>[-further]-<seed>``.
        fresh: train anew, and replace what an earlier run left in the folder.
        device: ``cpu``, ``cuda`` or ``auto``.
        threads: threads of a process on the CPU; by default its share of the cores.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    An :class:`UnseenForcingWarning` tells of a force or an obstacle that the model does
    not see.

    Raises:
        UsageError: unknown baseline, split, size, recipe or key; images that gravity
            or a force forbids; the folder holds another training; weights to start from
            that do not fit.
        DataError: the data set is missing or damaged.
        UnreadableFileError: the checkpoint in the folder is damaged.
        WorkFailedError: the loss is not finite, or the disk is full.
        KeyboardInterrupt: interrupted; the state after the last step is stored. Of a
            model that is fitted as a whole nothing is stored.
    """
    entry = find(baseline)
    tier, root_folder, known_splits = locate(split, size, root=root, registry=registry)
    initial = None
    if start is not None:
        initial = start_from(
            start, entry, tier, root=root_folder, registry=known_splits
        )
    plan = recipe_for(
        entry,
        tier.split,
        tier.name,
        variant=recipe,
        settings=settings,
        seed=seed,
        learned=None if initial is None else initial.options,
    )
    forcing = find_forcing(tier, root_folder)
    check_symmetry(plan.model.get("symmetry"), tier, forcing)
    if initial is not None:
        info = initial.info
        plan = replace(plan, start=initial.record)
    else:
        info = read_dataset_info(
            tier.split, tier.name, root=root_folder, registry=known_splits
        )

    if output is None:
        further = "-further" if initial is not None else ""
        name = f"{baseline}{further}-{plan.training.seed}"
        output = Path("runs") / plan.name / name
    folder = expand_home(output, "--output")
    check_writable(folder, option="--output")
    earlier = None
    if fresh and not is_helper():
        for file_name in (WEIGHTS, CHECKPOINT, LOG, LOSSES):
            (folder / file_name).unlink(missing_ok=True)
    elif (folder / CHECKPOINT).exists():
        earlier = _load_earlier(folder, plan, info)

    with (
        preserve_generators(),
        use_threads(threads),
        _connected_processes(choose_device(device)) as machine,
    ):
        seed_generators(derive_seed(plan.training.seed))
        model = entry.model.build(plan.model, info)
        if earlier is not None:
            load_weights(model, earlier.weights, where=str(folder / CHECKPOINT))
        elif initial is not None:
            initial.load_into(model)
        if not is_helper() and model.forcing_seen is not None:
            unseen = sorted(forcing - model.forcing_seen)
            if unseen:
                message = (
                    f"{model.method} does not see the {' and '.join(unseen)} of "
                    f"{tier.split}: it can only learn the mean effect; graph networks "
                    f"see it with --set model.{unseen[0]}=true"
                )
                warnings.warn(message, UnseenForcingWarning, stacklevel=2)
        training = _Training(
            plan=plan,
            info=info,
            folder=folder,
            model=model,
            earlier=earlier,
            root=root_folder,
            registry=known_splits,
            device=machine,
            meter=Meter(progress),
        )
        if model.closed_form:
            return training.fit()
        return training.descend()


def _load_earlier(folder: Path, plan: Recipe, info: DatasetInfo) -> Checkpoint:
    """Return the state of an earlier training, if it is of the same recipe and data.

    Raises:
        UsageError: the folder holds another training.
        DataError: the training began on another version of the data set.
    """
    earlier = load(folder / CHECKPOINT)
    asked = plan.as_json()
    differences = []
    for key in ("baseline", "name", "model", "training", "start"):
        if earlier.recipe.get(key) != asked.get(key):
            differences.append(key)
    if earlier.training.get("processes", 1) != _count_processes():
        differences.append("number of processes")
    if differences:
        raise UsageError(
            f"the folder holds a training with another {', '.join(differences)}; name "
            "another folder with --output, or train anew with --fresh",
            where=str(folder),
        )
    if earlier.info.dataset_sha256 != info.dataset_sha256:
        raise DataError(
            "the training began on another version of the data set; train anew with "
            "--fresh",
            where=str(folder),
        )
    return earlier


def _count_processes() -> int:
    """Return the processes that train together, as torchrun tells."""
    return int(os.environ.get("WORLD_SIZE", "1"))


@contextmanager
def _connected_processes(device: str) -> Iterator[torch.device]:
    """Yield the device of this process; connect the processes of torchrun."""
    machine = torch.device("cpu")
    if device == "cuda":
        machine = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
        torch.cuda.set_device(machine)
    if _count_processes() == 1:
        yield machine
        return
    torch.distributed.init_process_group("nccl" if device == "cuda" else "gloo")
    try:
        yield machine
    finally:
        torch.distributed.destroy_process_group()


@contextmanager
def _noting_interrupts() -> Iterator[threading.Event]:
    """Note the first interrupt of a user, and let a second one through."""
    interrupt = threading.Event()

    def note(number: int, frame: FrameType | None) -> None:
        del number, frame
        if interrupt.is_set():
            raise KeyboardInterrupt
        interrupt.set()

    handlers = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            handlers[number] = signal.signal(number, note)
    try:
        yield interrupt
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


class StepBatches(Sampler[list[int]]):
    """Windows of each step of a training, from any step on.

    A random share of them is replaced by windows that begin in the first frames of a
    scenario, evenly drawn.
    """

    def __init__(
        self,
        sampler: WindowSampler,
        options: TrainingOptions,
        *,
        first: int,
        last: int,
    ) -> None:
        self.sampler = sampler  # draws the windows of one process, epoch after epoch
        self.batch = options.batch  # windows of a step
        self.steps = range(first, last)
        self.opening_share = options.opening_share  # share that is replaced
        openings = []
        for start, stop in pairwise(sampler.data.starts):
            last_opening = min(start + options.opening_frames, stop)
            openings.append(np.arange(start, last_opening))
        self.openings = np.concatenate(openings)  # windows that replace others

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.steps)

    def __iter__(self) -> Iterator[list[int]]:
        """Yield the windows of each step."""
        sampler = self.sampler
        windows_before = self.steps.start * self.batch
        epoch, used = divmod(windows_before, len(sampler))
        sampler.seek(epoch, used * sampler.ranks)
        endless = chain.from_iterable(sampler for _ in count())
        for step in self.steps:
            windows = np.array(list(islice(endless, self.batch)))
            place_in_training = [sampler.seed, step, sampler.rank, sampler.ranks]
            seed = np.random.SeedSequence(place_in_training)
            generator = np.random.Generator(np.random.PCG64(seed))
            # NumPy promises the same bits for `random` alone.
            chance, share = generator.random((2, self.batch))
            opening = self.openings[(share * len(self.openings)).astype(np.intp)]
            yield np.where(chance < self.opening_share, opening, windows).tolist()


@dataclass(kw_only=True)
class _Training:
    """A training in one process, beside others perhaps."""

    plan: Recipe
    info: DatasetInfo
    folder: Path
    model: Baseline
    earlier: Checkpoint | None  # state to go on from; None at the start
    root: Path
    registry: Registry
    device: torch.device
    meter: Meter
    windows: int = 0  # of the training subsets
    steps: int = 1  # of the whole training; a fit counts as one
    optimisation: Optimisation | None = None  # None in a fit

    def __post_init__(self) -> None:
        """Begin the log, or go on with that of the earlier run."""
        self.processes = _count_processes()
        self.log = TrainingLog()
        if self.earlier is not None:
            self.log = TrainingLog.continue_from(self.earlier.training)
        self.first_step = self.log.step

    def descend(self) -> TrainingResult:
        """Train the model by steps.

        Raises:
            KeyboardInterrupt: a user interrupted it; the state is stored.
        """
        log = self.log
        options = self.plan.training
        model = self.model.to(self.device)
        data = WindowDataset(
            self.info.split,
            subset=options.windows,
            size=self.info.size,
            root=self.root,
            registry=self.registry,
            history=model.history,
            future=model.future,
            origin=model.origin,
            verify=True,
        )
        self.windows = len(data)
        self.steps = options.total_steps(len(data), processes=self.processes)
        if log.step >= self.steps:
            log.state = "finished"
        if log.state in OVER:
            return self._result()

        log.state = "running"
        if options.compile:
            model.compile_layers()
        optimisation = Optimisation(
            model,
            options,
            steps=self.steps,
            processes=self.processes,
            step=log.step,
            state=None if self.earlier is None else self.earlier.optimizer,
        )
        self.optimisation = optimisation
        rank = int(os.environ.get("RANK", "0"))
        sampler = WindowSampler(
            data, seed=options.seed, rank=rank, ranks=self.processes
        )
        batches = StepBatches(sampler, options, first=log.step, last=self.steps)
        loader = DataLoader(data, batch_sampler=batches, collate_fn=collate)
        validation = load_validation(
            options, self.info, root=self.root, registry=self.registry
        )
        validations = 0
        if validation is not None:
            validations = options.count_validations(
                self.steps,
                trained=options.batch * model.future,
                rolled=sum(validation.frames.values()),
            )

        forward: torch.nn.Module = model
        if self.processes > 1:
            forward = DistributedDataParallel(model)
        model.train()
        self.meter.begin(
            "training", total=self.steps, scenarios=self.steps, done=log.step
        )
        with _noting_interrupts() as interrupt:
            if validation is not None and self.plan.start and not log.validation:
                self._validate(validation)
                self._store()
            for batch in loader:
                seed = derive_seed(options.seed, log.step, rank)
                seed_generators(seed)
                generator = torch.Generator(device=self.device).manual_seed(seed)
                terms = forward(batch.to(self.device), generator)
                try:
                    optimisation.make_step(optimisation.weigh(terms))
                except Exception:
                    log.state = "failed"
                    self._write_log()
                    raise

                log.step = optimisation.step
                log.windows_seen = log.step * options.batch * self.processes
                log.epochs = log.windows_seen / self.windows
                is_last = log.step >= self.steps
                if is_last or log.step == 1 or log.step % options.log_every == 0:
                    self._log_loss(optimisation)
                self.meter.count(1, scenarios=1)

                if validation is not None and options.is_validated(
                    log.step, steps=self.steps, validations=validations
                ):
                    self._validate(validation)
                patience = options.patience
                if is_last:
                    log.state = "finished"
                elif patience is not None and log.validations_since_best() >= patience:
                    log.state = STOPPED_EARLY
                elif self._sum_over_processes(float(interrupt.is_set())) > 0:
                    log.state = "interrupted"
                every = options.checkpoint_every or max(1, self.steps // 20)
                if log.state != "running" or log.step % every == 0:
                    self._store()
                if log.state == "interrupted":
                    raise KeyboardInterrupt
                if log.state in OVER:
                    break
        return self._result()

    def fit(self) -> TrainingResult:
        """Fit the model to scenarios of train; a finished fit is not repeated.

        :class:`Baseline` describes what the method ``fit`` of the model gets and
        returns.
        """
        log = self.log
        if self.earlier is not None:
            log.state = "finished"
            return self._result()
        size = self.registry.size(self.info.split, self.info.size)
        paths: list[Path] = []
        for subset in self.plan.training.windows:
            files = scenario_files(size, self.root, (subset,))
            check_contents(size, self.root, files)
            paths += files.values()

        def read() -> Iterator[Batch]:
            for path in paths:
                yield scenario_batch(path, viscosity=size.viscosity())
                self.meter.count(1, scenarios=1)

        self.meter.begin(
            "reading", total=len(paths), scenarios=len(paths), unit="scenarios"
        )
        numbers = self.model.fit(read())  # type: ignore[operator]
        for name, value in numbers.items():
            log.loss[name] = float(value)
        log.step = self.steps
        log.epochs = 1.0
        validation = load_validation(
            self.plan.training, self.info, root=self.root, registry=self.registry
        )
        if validation is not None:
            self._validate(validation)
        log.state = "finished"
        self._store()
        return self._result()

    def _log_loss(self, optimisation: Optimisation) -> None:
        """Log the loss of a step; append it to the CSV file.

        After a crash the file may have rows of steps that are made again.
        """
        terms = {name: float(value) for name, value in optimisation.terms.items()}
        self.log.loss = terms
        self.meter.stage = f"loss {terms['total']:.3g}"
        if is_helper():
            return
        row = {
            "step": optimisation.step,
            "learning_rate": optimisation.learning_rate,
            **terms,
        }
        path = self.folder / LOSSES
        is_new = not path.exists()
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, [*row])
            if is_new:
                writer.writeheader()
            writer.writerow(row)

    def _validate(self, validation: Validation) -> None:
        """Validate in the first process; all processes act on the value."""
        self._read_clocks()
        before = self.log.cpu_seconds
        value = 0.0
        if not is_helper():
            with self._mean_weights():
                value = validation.measure(self.model)
        value = self._sum_over_processes(value)
        self._read_clocks()
        self.log.validation_cpu_seconds += self.log.cpu_seconds - before
        if self.log.add_validation(validation.metric, value):
            self._publish()

    def _mean_weights(self) -> AbstractContextManager[None]:
        """Replace the weights by their running means for a while, if there are any."""
        if self.optimisation is None:
            return nullcontext()
        return self.optimisation.use_mean()

    def _sum_over_processes(self, value: float) -> float:
        if self.processes == 1:
            return value
        total = torch.tensor(value, dtype=torch.float64, device=self.device)
        torch.distributed.all_reduce(total)
        return float(total)

    def _publish(self) -> None:
        """Write the weights to predict from."""
        if is_helper():
            return
        with self._mean_weights():
            weights = round_weights(self.model)
            save(self.folder / WEIGHTS, self._checkpoint(weights))

    def _store(self) -> None:
        """Write checkpoint and log; the weights get the budget of the whole training.

        Raises:
            WorkFailedError: weights are not finite; the files stay as they are.
        """
        if is_helper():
            return
        weights = self.model.state_dict()
        state = None
        if self.optimisation is not None:
            for value in weights.values():
                if not torch.isfinite(value).all():
                    raise self.optimisation.not_finite()
            state = self.optimisation.state_tensors()
        self._read_clocks()
        save(self.folder / CHECKPOINT, self._checkpoint(weights, state))
        self._write_log()
        if self.log.best_step is None:
            self._publish()
            return
        best = load(self.folder / WEIGHTS)
        budget = self._budget().model_dump(mode="json")
        training = {**best.training, "budget": budget}
        save(self.folder / WEIGHTS, replace(best, training=training))

    def _read_clocks(self) -> None:
        self.log.read_clocks(self.processes, device=self.device.type)

    def _checkpoint(
        self, weights: Mapping[str, Tensor], state: Mapping[str, Tensor] | None = None
    ) -> Checkpoint:
        """Return a checkpoint of the present step."""
        training = {
            "recipe": self.plan.as_json(),
            "processes": self.processes,
            **asdict(self.log),
            "budget": self._budget().model_dump(mode="json"),
        }
        return Checkpoint(
            baseline=self.plan.baseline,
            options=self.plan.model,
            info=self.info,
            weights=weights,
            training=training,
            optimizer=state,
        )

    def _write_log(self) -> None:
        if is_helper():
            return
        info = self.info
        budget = self._budget()
        versions = {name: version(name) for name in LIBRARIES}
        content = {
            "format": LOG_FORMAT,
            "baseline": self.plan.baseline,
            "method": self.model.method,
            "recipe": self.plan.as_json(),
            "split": info.split,
            "size": info.size,
            "dataset_version": info.version,
            "dataset_sha256": info.dataset_sha256,
            "parameters": count_parameters(self.model),
            "processes": self.processes,
            "hardware": hardware(self.device.type),
            "versions": {"python": platform.python_version(), **versions},
            "budget": budget.model_dump(mode="json"),
            "track": track_of(info.size, budget),
            "steps": self.steps,
            "windows": self.windows,
            **asdict(self.log),
        }
        text = json.dumps(content, indent=2, sort_keys=True)
        write_atomically(self.folder / LOG, text.encode() + b"\n", option="--output")

    def _budget(self) -> Budget:
        """Return the budget of the training so far, for predictions and entries.

        Hours include those of the weights of its start; epochs, steps and validations
        are its own.
        """
        log = self.log
        machine = hardware(self.device.type)
        name = machine["processor" if self.device.type == "cpu" else "device"]
        took = (self.plan.start or {}).get("took", {})

        def sum_hours(seconds: float, key: str) -> float | None:
            start_hours = took.get(key, 0.0)
            if start_hours is None:
                return None
            return round_digits(seconds / 3600.0 + start_hours, 6)

        validations = []
        for entry in log.validation:
            value = entry[str(log.metric)]
            if math.isfinite(value):
                validations.append((int(entry["step"]), value))
        # Of too many validations every n-th stays, the last one among them.
        stride = max(1, math.ceil(len(validations) / MOST_VALIDATIONS))
        chosen = validations[::-1][::stride]
        training_seconds = log.cpu_seconds - log.validation_cpu_seconds
        return Budget(
            windows=log.windows_seen or None,
            epochs=round_digits(log.epochs, 6),
            steps=log.step,
            start_steps=took.get("steps"),
            cpu_hours=sum_hours(training_seconds, "cpu_hours"),
            validation_hours=sum_hours(log.validation_cpu_seconds, "validation_hours"),
            gpu_hours=sum_hours(log.gpu_seconds, "gpu_hours"),
            device=str(name).encode("ascii", "replace").decode()[:100],
            threads=machine["threads"],
            metric=log.metric,
            best=log.best_value,
            best_step=log.best_step,
            validations=tuple(chosen[::-1]),
        )

    def _result(self) -> TrainingResult:
        """Return the result of the training, with the log but for its validations."""
        budget = self._budget()
        log_values = asdict(self.log)
        del log_values["validation"]
        start = self.plan.start
        start_words = ""
        if start:
            start_words = f"{start['recipe']}, weights {start['sha256'][:12]}"
        return TrainingResult(
            baseline=self.plan.baseline,
            split=self.info.split,
            size=self.info.size,
            recipe=self.plan.name,
            folder=self.folder,
            weights=self.folder / WEIGHTS,
            checkpoint=self.folder / CHECKPOINT,
            steps=self.steps,
            parameters=count_parameters(self.model),
            device=budget.device or "",
            threads=budget.threads or 0,
            track=track_of(self.info.size, budget),
            start=start_words,
            is_fitted=self.model.closed_form,
            first_step=self.first_step,
            **log_values,
        )
