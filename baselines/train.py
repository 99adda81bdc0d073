"""Train a baseline: seeded, resumable, on one device or several.

Most baselines take steps over windows; models with a closed form are fitted to whole
scenarios instead. A step draws its windows and its noise from (seed, step, process)
alone. So a training that was interrupted and resumed ends, on one thread, with the bits
of an uninterrupted one.
"""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain, count, islice, pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import DataLoader, Sampler

from lagbench.atomic import check_writable
from lagbench.data.layout import expand_home
from lagbench.data.local import check_contents, locate
from lagbench.data.registry import Registry, Size
from lagbench.errors import UsageError
from lagbench.submission.budget import Track, track_of
from lagbench.tensors import Batch, TensorWindow, collate
from lagbench.torch import WindowDataset, WindowSampler
from lagbench.work.run import Meter, Progress

from .augmentation import check_symmetry
from .baseline import Baseline, count_parameters
from .catalogue import check_data_set, find
from .checkpoint import load_weights, round_weights
from .dataset_info import find_forcing, read_dataset_info
from .job import TrainingJob
from .machine import (
    bound_memory,
    check_compiler,
    choose_device,
    explain_memory_errors,
    is_helper,
    use_threads,
)
from .optimisation import Optimisation
from .randomness import derive_seed, preserve_generators, seed_generators
from .recipe import Recipe, TrainingOptions, recipe_for
from .recipe_changes import describe_start
from .rollout import load_validation, scenario_batch, scenario_paths
from .run_folder import RunFolder
from .start import TrainingStart, start_from
from .training_log import STOPPED_EARLY, TrainingLog
from .training_loop import TrainingLoop, launch_fabric, silence_lightning

MEMORY_HINT = (
    "lower --set training.batch=1, then the model: model.latent, .layers, .widths or "
    ".lags"
)
FIT_STEPS = 1  # a closed form counts as one step
READING = "reading"  # the stage in which a fit reads scenarios
FITTING = "fitting"  # the stage in which it evaluates

# what an interrupted training says that has stored nothing yet
NOTHING_STORED = "the earlier training in the folder is still there"


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
    steps: int  # steps of the whole training
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


FORCING = {
    "body_force": "the force that drives the flow",
    "obstacle": "the obstacle in the flow",
}
"""What drives a flow beside walls, by its name in batches."""


class UnseenForcingWarning(UserWarning):
    """A model is trained that does not see what drives the flow."""


class DamagedLogWarning(UserWarning):
    """A training is finished, but training.json is missing, damaged or of another."""


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
        start: weights to start from, perhaps of another size; random weights when
            None.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data
            folder.
        output: folder of the run; by default
            ``runs/<split>/<size>[-<variant>]/<baseline>[-further]-<seed>``.
        resume: go on with what an earlier run left there.
        fresh: train anew; it wins over ``resume``. An earlier training in the folder is
            replaced when the new one stores its first file.
        device: ``cpu``, ``cuda`` or ``auto``.
        processes: processes, one device each (torchrun's own number where that started
            us).
        threads: threads of a process on the CPU; by default its share of the cores.
        workers: processes that read windows ahead; 0 reads them in between.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    An :class:`UnseenForcingWarning` tells of a force or an obstacle that the model does
    not see. A :class:`DamagedLogWarning` tells that a training is finished, and that
    its training.json is missing, damaged or the log of another training.

    Raises:
        UsageError: unknown baseline, split, size, recipe or key; images that gravity
            or a force forbids; or the folder holds another training, or weights
            without their checkpoint; weights to start from that do not fit; a model
            whose weights no file can hold.
        DataError: the data set is missing or damaged.
        UnreadableFileError: the checkpoint in the folder is damaged.
        WorkFailedError: the loss is not finite, memory or disk is full.
        KeyboardInterrupt: interrupted; the state after the last step is stored. Of a
            model that is fitted as a whole nothing is stored; the exception says so.
    """
    entry = find(baseline)
    tier, root_folder, known_splits = locate(split, size, root=root, registry=registry)
    initial = None
    learned_options = None
    if start is not None:
        initial = start_from(
            start, entry, tier, root=root_folder, registry=known_splits
        )
        learned_options = initial.options
    check_data_set(entry, tier)
    plan = recipe_for(
        entry,
        tier.split,
        tier.name,
        variant=recipe,
        settings=settings,
        seed=seed,
        learned=learned_options,
    )
    check_symmetry(
        plan.model.get("symmetry"),
        tier,
        find_forcing=functools.partial(find_forcing, tier, root_folder),
    )
    if initial is not None:
        info = initial.info
        plan = replace(plan, start=initial.record)
    else:
        info = read_dataset_info(
            tier.split, tier.name, root=root_folder, registry=known_splits
        )

    folder = _open_folder(output, plan, initial)
    # torchrun's number of processes where it started us
    world_size = int(os.environ.get("WORLD_SIZE", processes))
    local_world_size = int(os.environ.get("LOCAL_WORLD_SIZE", processes))
    earlier = folder.find_checkpoint(
        plan, info, processes=world_size, resume=resume, fresh=fresh
    )
    job = TrainingJob(
        recipe=plan,
        info=info,
        folder=folder,
        earlier=earlier,
        root=root_folder,
        registry=known_splits,
        device=choose_device(device),
        processes=world_size,
        workers=workers,
        meter=Meter(progress),
    )
    bound_memory()
    with (
        preserve_generators(),
        use_threads(threads, processes=local_world_size),
        explain_memory_errors(MEMORY_HINT),
    ):
        model = _build_model(job, entry.model, initial)
        _warn_of_unseen_forcing(model, tier, root_folder)
        return _train_model(job, model)


def _train_model(job: TrainingJob, model: Baseline) -> TrainingResult:
    """Fit a model or descend on its loss."""
    if job.earlier is None and not is_helper():
        job.folder.note_earlier_files()
    if model.closed_form:
        try:
            log, steps = fit(job, model)
        except KeyboardInterrupt:
            advice = "a fit stores nothing before its end: the same command begins anew"
            raise KeyboardInterrupt(advice) from None
    else:
        log, steps = descend(job, model)
    result = _result(job, model, log, steps)
    if job.earlier is not None and result.first_step == result.step:
        _warn_of_damaged_log(job)
    return result


def _warn_of_damaged_log(job: TrainingJob) -> None:
    """Warn where training.json is not the log of a training that was over before.

    It is not written anew: hardware and versions of the training may be others than
    those of today.
    """
    if is_helper() or job.earlier is None:
        return
    folder = job.folder
    if folder.has_log_of(job.earlier.training):
        return
    message = (
        f"{folder.log} is missing, damaged, or not the log of the finished training "
        "beside it; restore the file from a copy, or train anew with --fresh"
    )
    warnings.warn(message, DamagedLogWarning, stacklevel=4)


def _warn_of_unseen_forcing(model: Baseline, size: Size, root: Path) -> None:
    """Warn before a training whose model does not see what drives the flow."""
    if is_helper() or model.forcing_seen is None:
        return
    unseen = sorted(find_forcing(size, root) - model.forcing_seen)
    if not unseen:
        return
    names = " and ".join(FORCING[name] for name in unseen)
    keys = " and ".join(unseen)
    message = (
        f"{model.method} does not see {names} of {size.split} ({keys}): it can only "
        f"learn the mean effect; {_show_forcing(model, unseen)}"
    )
    warnings.warn(message, UnseenForcingWarning, stacklevel=3)


def _show_forcing(model: Baseline, unseen: Sequence[str]) -> str:
    """Return which option or model shows what drives the flow."""
    known_options = type(model.options).model_fields
    if all(name in known_options for name in unseen):
        options = " ".join(f"--set model.{name}=true" for name in unseen)
        return f"to show it to the model, add {options}"
    settings = " and ".join(f"model.{name}=true" for name in unseen)
    networks = f"graph networks, MLP and LSTM see it with {settings}"
    if "body_force" in unseen:
        return f"{networks}, and NeuralMPM with model.body_force=true"
    return f"{networks}, and NeuralMPM without an option"


def _open_folder(
    output: str | Path | None, recipe: Recipe, initial: TrainingStart | None
) -> RunFolder:
    """Return the folder of a run, if it can be written.

    Refuse one whose checkpoint or weights are the start: they would be overwritten.
    """
    if output is None:
        name = recipe.baseline
        if initial is not None:
            name += "-further"
        output = Path("runs") / recipe.name / f"{name}-{recipe.training.seed}"
    folder = RunFolder(expand_home(output, "--output"))
    check_writable(folder.path, option="--output")
    if initial is not None and folder.holds(initial.path):
        raise UsageError(
            "this training would overwrite the weights that it starts from",
            where="--start",
            expected="weights in another folder",
            got=str(initial.path),
            fix="name another folder with --output",
        )
    return folder


def _build_model(
    job: TrainingJob, model_class: type[Baseline], initial: TrainingStart | None
) -> Baseline:
    """Return the model with the weights of checkpoint or start, else random ones."""
    seed_generators(derive_seed(job.recipe.training.seed))
    model = model_class.build(job.recipe.model, job.info)
    if job.earlier is not None:
        load_weights(model, job.earlier.weights, where=str(job.folder.checkpoint))
    elif initial is not None:
        initial.load_into(model)
    return model


def _result(
    job: TrainingJob, model: Baseline, log: TrainingLog, steps: int
) -> TrainingResult:
    """Return the result of a training, with the log but for its validations."""
    first_step = 0
    if job.earlier is not None:
        first_step = int(job.earlier.training.get("step", 0))
    budget = job.budget(log)
    log_values = asdict(log)
    del log_values["validation"]
    return TrainingResult(
        baseline=job.recipe.baseline,
        split=job.info.split,
        size=job.info.size,
        recipe=job.recipe.name,
        folder=job.folder.path,
        weights=job.folder.weights,
        checkpoint=job.folder.checkpoint,
        steps=steps,
        parameters=count_parameters(model),
        device=budget.device or "",
        threads=budget.threads or 0,
        track=track_of(job.info.size, budget),
        start=describe_start(job.recipe.start),
        is_fitted=model.closed_form,
        first_step=first_step,
        **log_values,
    )


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
        windows_before = self.steps.start * self.batch
        epoch, used = divmod(windows_before, len(self.sampler))
        self.sampler.seek(epoch, used * self.sampler.ranks)
        endless = chain.from_iterable(self.sampler for _ in count())
        for step in self.steps:
            drawn = list(islice(endless, self.batch))
            windows = self._replace_some(np.array(drawn), step)
            yield windows.tolist()

    def _replace_some(self, windows: NDArray[np.intp], step: int) -> NDArray[np.intp]:
        """Return the windows of a step, some of them replaced."""
        sampler = self.sampler
        place_in_training = [sampler.seed, step, sampler.rank, sampler.ranks]
        seed = np.random.SeedSequence(place_in_training)
        generator = np.random.Generator(np.random.PCG64(seed))
        # NumPy promises the same bits for `random` alone.
        chance, share = generator.random((2, self.batch))
        place = share * len(self.openings)
        index = place.astype(np.intp)
        opening = self.openings[index]
        is_replaced = chance < self.opening_share
        return np.where(is_replaced, opening, windows)


def descend(job: TrainingJob, model: Baseline) -> tuple[TrainingLog, int]:
    """Train a model by steps; return the log and the steps of the whole training.

    Raises:
        KeyboardInterrupt: a user interrupted it; the state is stored.
    """
    info = job.info
    options = job.recipe.training
    data = WindowDataset(
        info.split,
        subset=options.windows,
        size=info.size,
        root=job.root,
        registry=job.registry,
        history=model.history,
        future=model.future,
        origin=model.origin,
        verify=True,
    )
    steps = options.total_steps(len(data), processes=job.processes)
    log = job.start_log()
    if log.state == STOPPED_EARLY:
        return log, steps
    if log.step >= steps:
        log.state = "finished"
        return log, steps
    log.state = "running"
    if options.compile:
        check_compiler(job.device)
        model.compile_layers()

    validation = load_validation(options, info, root=job.root, registry=job.registry)
    with silence_lightning():
        fabric = launch_fabric(job)
        optimizer_state = None
        if job.earlier is not None:
            optimizer_state = job.earlier.optimizer
        optimisation = Optimisation(
            model.to(fabric.device),
            options,
            steps=steps,
            processes=job.processes,
            step=log.step,
            optimizer_state=optimizer_state,
        )
        loop = TrainingLoop(
            job,
            log,
            fabric=fabric,
            optimisation=optimisation,
            validation=validation,
            windows=len(data),
        )

        def load_batches(rank: int, ranks: int) -> DataLoader[TensorWindow]:
            sampler = WindowSampler(data, seed=options.seed, rank=rank, ranks=ranks)
            batches = StepBatches(sampler, options, first=log.step, last=steps)
            return _make_loader(data, batches, workers=job.workers)

        loop.run(load_batches)
    if log.state == "interrupted":
        if job.folder.has_earlier_files:
            raise KeyboardInterrupt(NOTHING_STORED)
        raise KeyboardInterrupt
    return log, steps


def _make_loader(
    data: WindowDataset, batches: StepBatches, *, workers: int
) -> DataLoader[TensorWindow]:
    """Return a loader of batches, with processes that read ahead if asked."""
    if not workers:
        return DataLoader(data, batch_sampler=batches, collate_fn=collate)
    return DataLoader(
        data,
        batch_sampler=batches,
        collate_fn=collate,
        num_workers=workers,
        persistent_workers=True,
        multiprocessing_context="spawn",
    )


def fit(job: TrainingJob, model: Baseline) -> tuple[TrainingLog, int]:
    """Fit a model to scenarios of train; return the log and the number of steps, 1.

    A fit that was finished before is not repeated. :class:`Baseline` describes what the
    method ``fit`` of the model gets and returns.
    """
    log = job.start_log()
    if job.earlier is not None:
        log.state = "finished"
        return log, FIT_STEPS
    options = job.recipe.training
    if options.compile:
        model.compile_layers()  # refuses: a closed form has none
    if options.ema:
        raise UsageError(
            f"{model.method} takes no steps to average over",
            where="training.ema",
            expected=0.0,
            got=options.ema,
            fix="leave the option out",
        )

    if model.fits_batches:
        most = getattr(model.options, "scenarios", None)
        scenarios = _read_scenarios(job, most=most)
        evaluations = int(getattr(model, "evaluations", 0))
        count = functools.partial(_count_evaluations, job.meter, evaluations)
        numbers = model.fit(scenarios, count=count)  # type: ignore[operator]
    else:
        positions = _positions(_read_scenarios(job))
        numbers = model.fit(positions)  # type: ignore[operator]
    log.step = FIT_STEPS
    for name, value in numbers.items():
        log.loss[name] = float(value)
    log.epochs = 1.0
    validation = load_validation(
        options, job.info, root=job.root, registry=job.registry
    )
    if validation is not None:
        with log.time_validation(device=job.device):
            value = validation.measure(model)
        log.add_validation(validation.metric, value)
    log.state = "finished"
    log.read_clocks(device=job.device)

    exact_weights = {}
    for name, weight in model.state_dict().items():
        exact_weights[name] = weight.detach()
    rounded = job.checkpoint(log, round_weights(model))
    exact = job.checkpoint(log, exact_weights)
    job.folder.save(job.folder.weights, rounded)
    job.folder.save(job.folder.checkpoint, exact)
    job.folder.write_log(job.log_as_json(model, log, steps=FIT_STEPS))
    return log, FIT_STEPS


def _positions(scenarios: Iterator[Batch]) -> Iterator[NDArray[np.float32]]:
    """Yield the positions of each scenario, shape [frame, particle, 2]."""
    for scenario in scenarios:
        yield scenario.position.transpose(0, 1).numpy()


def _count_evaluations(meter: Meter, evaluations: int, evaluated: int) -> None:
    """Count what a fit has evaluated. The first count begins a stage of its own.

    A scenario is read in less time than an evaluation takes, so they are not counted
    together: the rate would be of both.

    Args:
        meter: counts the work of the training.
        evaluations: how many evaluations the fit makes, at most.
        evaluated: how many were made since the last count.
    """
    if meter.stage == FITTING:
        meter.count(evaluated, scenarios=evaluated)
        return
    meter.begin(
        FITTING,
        total=evaluations,
        scenarios=evaluations,
        done=evaluated,
        unit="evaluations",
    )


def _read_scenarios(job: TrainingJob, *, most: int | None = None) -> Iterator[Batch]:
    """Yield each training scenario as a batch of one window.

    Args:
        job: the training.
        most: scenarios to read, the first ones; all when None.
    """
    size = job.registry.size(job.info.split, job.info.size)
    viscosity = size.viscosity()
    paths: list[Path] = []
    for subset in job.recipe.training.windows:
        files = scenario_paths(
            job.info.split,
            subset=subset,
            size=job.info.size,
            root=job.root,
            registry=job.registry,
        )
        check_contents(size, job.root, files)
        paths += files.values()
    paths = paths[:most]
    job.meter.begin(READING, total=len(paths), scenarios=len(paths), unit="scenarios")
    for path in paths:
        scenario = scenario_batch(path, viscosity=viscosity)
        # A fit may evaluate what it has read before it reads on.
        if job.meter.stage == READING:
            job.meter.count(1, scenarios=1)
        yield scenario
