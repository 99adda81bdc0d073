"""Train a baseline: seeded, resumable, on one device or several.

Most descend over windows, by pytorch-lightning; models with a closed form are fitted to
whole scenarios instead. A step draws its windows and its noise from (seed, step,
process) alone, so that a training that was interrupted and resumed ends, on one thread,
with the same bits as one that was not.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain, count, islice, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pytorch_lightning import Trainer
from pytorch_lightning.loggers import TensorBoardLogger
from torch.utils.data import DataLoader, Sampler

from lagbench.atomic import check_writable
from lagbench.data.local import locate
from lagbench.data.registry import Registry
from lagbench.errors import UsageError
from lagbench.submission.budget import Track, track_of
from lagbench.tensors import TensorWindow, collate
from lagbench.torch import WindowDataset, WindowSampler
from lagbench.work.progress import Meter, Progress

from .augmentation import check_symmetry
from .baseline import Baseline
from .catalogue import find
from .checkpoint import load_weights, rounded_weights, save
from .facts import facts_of
from .job import (
    STOPPED_EARLY,
    RunFolder,
    TrainingJob,
    TrainingRecord,
    parameter_count,
    start_words,
)
from .machine import (
    bound_memory,
    check_compiler,
    chosen_device,
    is_helper,
    memory_errors_told,
    multiplies_bfloat16,
    threads_used,
)
from .module import (
    TrainingCallback,
    TrainingModule,
    generators_kept,
    quiet,
    reseed,
    seed_of,
)
from .recipe import TrainingOptions, recipe_for
from .rollout import scenario_batch, scenario_paths, validation_of
from .start import start_from

SMALLER = "lower --set training.batch=1, then the model: model.latent, .layers, .widths or .lags"


@dataclass(frozen=True, kw_only=True)
class TrainingResult:
    """What a training made."""

    baseline: str  # name of the baseline
    split: str  # name of the split
    size: str  # name of the size
    recipe: str  # name of the recipe
    folder: Path  # folder of the run
    weights: Path  # weights to predict from
    checkpoint: Path  # last state, to go on from
    state: str  # finished, stopped early or interrupted
    start: str  # weights that it started from, in words; empty for random ones
    first_step: int  # optimiser steps that were there when this call began
    step: int  # optimiser steps made
    steps: int  # steps of the whole training
    parameters: int  # trainable parameters
    # raw loss terms of the last step, and their weighted sum 'total'
    loss: dict[str, float]
    windows_seen: int  # training windows of all steps
    epochs: float  # the same over the windows of the training subsets
    # what was validated by, lower is better; None without a validation
    metric: str | None
    best_value: float | None  # its least value
    best_step: int | None
    device: str  # processor or GPU
    threads: int  # of a process on the CPU
    track: Track | None  # equal compute, converged or none
    cpu_seconds: float  # processor time in all runs [s]
    validation_cpu_seconds: float  # of it that of validations [s]
    gpu_seconds: float  # time times the GPUs that were held [s]
    wall_seconds: float  # time of all runs [s]


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
    resume: bool = True,
    fresh: bool = False,
    device: str = "auto",
    processes: int = 1,
    threads: int | None = None,
    workers: int = 0,
    progress: Callable[[Progress], None] | None = None,
    registry: Registry | None = None,
) -> TrainingResult:
    """Train a baseline on the windows of a split.

    Args:
        baseline: name of the baseline.
        split: name of the split, or the path of a local one.
        size: name of the size; the only one that is there when None.
        recipe: variant of the recipe, or a YAML file of recipes.
        settings: changes to the recipe, as in ``training.steps=100``.
        seed: seed in place of the recipe's.
        start: weights.pt to start from, perhaps of another size; random weights when
            None.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder.
        output: folder of the run; ``runs/<split>/<size>/<baseline>[-further]-<seed>``
            by default.
        resume: go on with what an earlier run left there.
        fresh: train anew whatever is there.
        device: ``cpu``, ``cuda`` or ``auto``.
        processes: processes, one device each (torchrun's own number where that started
            us).
        threads: threads of a process on the CPU; by default its share of the cores.
        workers: processes that read windows ahead; 0 reads them in between.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown baseline, split, size, recipe or key; images that gravity
            forbids; or the folder holds another training, or weights without their
            checkpoint; weights to start from that do not fit.
        DataError: the data set is missing or damaged.
        UnreadableFileError: the checkpoint in the folder is damaged.
        WorkFailedError: the loss is not finite, memory or disk is full.
        KeyboardInterrupt: interrupted; the state after the last step is stored.
    """
    entry = find(baseline)
    tier, home, known = locate(split, size, root=root, registry=registry)
    if start is None:
        initial = None
    else:
        initial = start_from(start, entry, tier, root=home, registry=known)
    if initial:
        learned = initial.options
    else:
        learned = None
    plan = recipe_for(
        entry,
        tier.split,
        tier.name,
        variant=recipe,
        settings=settings,
        seed=seed,
        learned=learned,
    )
    check_symmetry(plan.model.get("symmetry"), tier)
    if initial:
        facts = initial.facts
    else:
        facts = facts_of(tier.split, tier.name, root=home, registry=known)
    if initial:
        plan = replace(plan, start=initial.record)
    else:
        plan = plan
    if initial:
        name = f"{plan.baseline}-further"
    else:
        name = plan.baseline
    own = Path("runs") / plan.name / f"{name}-{plan.training.seed}"
    folder = RunFolder(Path(output) if output else own)
    check_writable(folder.path, option="--output")
    if initial is not None and folder.holds(initial.path):
        raise UsageError(
            "the weights to start from lie in the folder of the training",
            where="--start",
            got=str(start),
            fix="name another folder with --output",
        )
    shared = int(os.environ.get("WORLD_SIZE", processes))
    earlier = folder.earlier(plan, facts, processes=shared, resume=resume, fresh=fresh)
    job = TrainingJob(
        recipe=plan,
        facts=facts,
        folder=folder,
        earlier=earlier,
        root=home,
        registry=known,
        device=chosen_device(device),
        processes=shared,
        workers=workers,
        meter=Meter(progress),
    )
    bound_memory()
    here = int(os.environ.get("LOCAL_WORLD_SIZE", processes))
    with (
        generators_kept(),
        threads_used(threads, processes=here),
        memory_errors_told(SMALLER),
    ):
        reseed(seed_of(plan.training.seed))
        model = entry.model.build(plan.model, facts)
        if earlier is not None:
            load_weights(model, earlier.weights, where=str(folder.checkpoint))
        elif initial is not None:
            initial.fill(model)
        if earlier is None and not is_helper():
            folder.clear()
        ledger, steps = (fit if getattr(model, "closed_form", False) else descend)(
            job, model
        )
        budget = job.budget(ledger)
        done = asdict(ledger)
        del done["validation"]
        return TrainingResult(
            baseline=plan.baseline,
            split=facts.split,
            size=facts.size,
            recipe=plan.name,
            folder=folder.path,
            weights=folder.weights,
            checkpoint=folder.checkpoint,
            steps=steps,
            parameters=parameter_count(model),
            device=budget.device or "",
            threads=budget.threads or 0,
            track=track_of(facts.size, budget),
            start=start_words(plan.start),
            first_step=int(earlier.training.get("step", 0)) if earlier else 0,
            **done,
        )


class StepBatches(Sampler[list[int]]):
    """Windows of each step of a training, from any step on.

    Some of them, at random, are others: windows that begin in the first frames of a
    scenario, evenly drawn.
    """

    def __init__(
        self, sampler: WindowSampler, options: TrainingOptions, *, first: int, last: int
    ) -> None:
        self.sampler = sampler  # draws the windows of one process, epoch after epoch
        self.batch = options.batch  # windows of a step
        self.steps = range(first, last)
        self.share = options.opening_share  # share of the windows that are others
        ends = (
            (start, min(start + options.opening_frames, stop))
            for start, stop in pairwise(sampler.data.starts)
        )
        # those others
        self.openings = np.concatenate([np.arange(*each) for each in ends])

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.steps)

    def __iter__(self) -> Iterator[list[int]]:
        """Yield the windows of each step."""
        epoch, used = divmod(self.steps.start * self.batch, len(self.sampler))
        self.sampler.seek(epoch, used * self.sampler.ranks)
        drawn = chain.from_iterable(self.sampler for _ in count())
        for step in self.steps:
            windows = np.array([*islice(drawn, self.batch)])
            own = np.random.SeedSequence(
                [self.sampler.seed, step, self.sampler.rank, self.sampler.ranks]
            )
            # NumPy promises the same bits for `random` alone
            chance, place = np.random.Generator(np.random.PCG64(own)).random(
                (2, self.batch)
            )
            others = self.openings[(place * len(self.openings)).astype(np.intp)]
            yield np.where(chance < self.share, others, windows).tolist()


def descend(job: TrainingJob, model: Baseline) -> tuple[TrainingRecord, int]:
    """Train a model; return the ledger and the steps of the whole training."""
    facts = job.facts
    options = job.recipe.training
    data = WindowDataset(
        facts.split,
        subset=options.windows,
        size=facts.size,
        root=job.root,
        registry=job.registry,
        history=model.history,
        future=model.future,
        origin=model.origin,
    )
    steps = options.total_steps(len(data), processes=job.processes)
    ledger = job.ledger()
    if ledger.state != STOPPED_EARLY:
        if ledger.step >= steps:
            ledger.state = "finished"
        else:
            ledger.state = "running"
    if ledger.state != "running":
        return ledger, steps
    if options.compile:
        check_compiler(job.device)
        model.compile_layers()

    def loader(rank: int, ranks: int) -> DataLoader[TensorWindow]:
        sampler = WindowSampler(data, seed=options.seed, rank=rank, ranks=ranks)
        batches = StepBatches(sampler, options, first=ledger.step, last=steps)
        return DataLoader(
            data,
            batch_sampler=batches,
            collate_fn=collate,
            num_workers=job.workers,
            persistent_workers=job.workers > 0,
            multiprocessing_context="spawn" if job.workers else None,
        )

    module = TrainingModule(
        model,
        options,
        loader=loader,
        steps=steps,
        processes=job.processes,
        step=ledger.step,
        optimizer=job.earlier.optimizer if job.earlier else None,
    )
    validation = validation_of(options, facts, root=job.root, registry=job.registry)
    keeper = TrainingCallback(job, ledger, validation=validation, windows=len(data))
    half = options.precision == "auto" and multiplies_bfloat16(job.device)
    with quiet():
        trainer = Trainer(
            accelerator="gpu" if job.device == "cuda" else "cpu",
            # the processes on this machine: torchrun's number where it started us
            devices=int(os.environ.get("LOCAL_WORLD_SIZE", job.processes)),
            num_nodes=int(os.environ.get("GROUP_WORLD_SIZE", "1")),
            strategy="ddp" if job.processes > 1 else "auto",
            precision="bf16-mixed"
            if half or options.precision == "bf16"
            else "32-true",
            max_epochs=1,
            logger=TensorBoardLogger(
                job.folder.path, name="", version=job.folder.logs.name
            ),
            callbacks=[keeper],
            default_root_dir=job.folder.path,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
            num_sanity_val_steps=0,
            use_distributed_sampler=False,
        )
        try:
            trainer.fit(module)
        except SystemExit:  # what Lightning makes of a second Ctrl-C
            raise KeyboardInterrupt from None
    if ledger.state == "interrupted":
        raise KeyboardInterrupt
    return ledger, steps


STEPS = 1  # a closed form counts as one step


def fit(job: TrainingJob, model: Baseline) -> tuple[TrainingRecord, int]:
    """Fit a model to every scenario, validate and store it; return the ledger and its
    one step.

    A baseline with ``closed_form = True`` has ``fit`` beside the contract: it sets the
    coefficients from positions, shape [frame, particle, 2], of each scenario, and
    returns figures to log.
    """
    ledger = job.ledger()
    if job.earlier is not None:
        ledger.state = "finished"
        return ledger, STEPS
    if job.recipe.training.compile:
        model.compile_layers()  # refuses: a closed form has none
    if job.recipe.training.ema:
        raise UsageError(
            f"{model.method} takes no steps to average over",
            where="training.ema",
            expected=0.0,
            got=job.recipe.training.ema,
            fix="leave the option out",
        )

    def scenarios() -> Iterator[NDArray[np.float32]]:
        find_in = partial(
            scenario_paths, job.facts.split, size=job.facts.size, root=job.root
        )
        parts = (
            find_in(subset=one, registry=job.registry)
            for one in job.recipe.training.windows
        )
        paths = [path for part in parts for path in part.values()]
        job.meter.begin("fitting", total=len(paths) + 1, scenarios=len(paths))
        for path in paths:
            yield scenario_batch(path).position.transpose(0, 1).numpy()
            job.meter.count(1, scenarios=1)

    figures = model.fit(scenarios())  # type: ignore[operator]
    ledger.step = STEPS
    ledger.loss = {name: float(value) for name, value in figures.items()}
    ledger.epochs = 1.0
    validation = validation_of(
        job.recipe.training, job.facts, root=job.root, registry=job.registry
    )
    if validation is not None:
        with ledger.validating(device=job.device):
            value = validation(model)
        ledger.validated(validation.metric, value)
    ledger.state = "finished"
    ledger.read_clocks(device=job.device)
    state = {name: value.detach() for name, value in model.state_dict().items()}
    save(job.folder.weights, job.checkpoint(ledger, rounded_weights(model)))
    save(job.folder.checkpoint, job.checkpoint(ledger, state))
    job.folder.write_record(job.record(model, ledger, steps=STEPS))
    return ledger, STEPS
