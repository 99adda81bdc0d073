"""Train a baseline: seeded, resumable, on one processor or several.

A step draws its windows and its noise from (seed, step, process) alone, so that a training
that was interrupted and resumed ends, on one thread, with the same bits as one that was not.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lagbench.atomic import check_writable
from lagbench.errors import DataError, UsageError
from lagbench.locating import locate
from lagbench.progress import Meter, Progress
from lagbench.registry import Registry

from .baseline import Baseline
from .catalogue import find
from .chance import generators_kept, reseed, seed_of
from .checkpoint import Checkpoint
from .facts import Facts, facts_of
from .job import Job, parameter_count
from .ledger import Ledger
from .machine import bound_memory, chosen_device, is_helper, memory_errors_told, threads_used
from .recipe import recipe_for
from .run_folder import RunFolder, default_folder
from .symmetry import check_symmetry

__all__ = ["TrainingResult", "train"]

SMALLER = "lower --set training.batch=1, then the model: model.latent, .layers, .widths or .lags"


@dataclass(frozen=True, kw_only=True)
class TrainingResult:
    """What a training made.

    Attributes:
        baseline: name of the baseline.
        split: name of the split.
        size: name of the size.
        recipe: name of the recipe.
        folder: folder of the run.
        weights: weights to predict from.
        checkpoint: last state, to go on from.
        state: finished, stopped early or interrupted.
        step: optimiser steps made.
        steps: steps of the whole training.
        parameters: trainable parameters.
        loss: raw loss terms of the last step, and their weighted sum ``total``.
        best_rmse: position RMSE of the best validation [length]; None without one.
        best_step: its step.
        cpu_seconds: processor time in all runs [s].
        wall_seconds: time of all runs [s].
    """

    baseline: str
    split: str
    size: str
    recipe: str
    folder: Path
    weights: Path
    checkpoint: Path
    state: str
    step: int
    steps: int
    parameters: int
    loss: dict[str, float]
    best_rmse: float | None
    best_step: int | None
    cpu_seconds: float
    wall_seconds: float


def train(
    baseline: str,
    split: str,
    size: str = "full",
    *,
    recipe: str | None = None,
    settings: tuple[str, ...] = (),
    seed: int | None = None,
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
        size: name of the size.
        recipe: variant of the recipe, or a YAML file of recipes.
        settings: changes to the recipe, as in ``training.steps=100``.
        seed: seed in place of the recipe's.
        root: folder of all data sets; else ``LAGBENCH_ROOT``, else the user data folder.
        output: folder of the run; ``runs/<split>/<size>/<baseline>-<seed>`` by default.
        resume: go on with what an earlier run left there.
        fresh: train anew whatever is there.
        device: ``cpu``, ``cuda`` or ``auto``.
        processes: processes, one device each (torchrun's own number where that started us).
        threads: threads of a process on the CPU; by default its share of the cores.
        workers: processes that read windows ahead; 0 reads them in between.
        progress: called as the work advances.
        registry: where splits are described; ours when None.

    Raises:
        UsageError: unknown baseline, split, size, recipe or key; images that gravity forbids; or
            the folder holds another training, or weights without their checkpoint.
        DataError: the data set is missing or damaged.
        UnreadableFileError: the checkpoint in the folder is damaged.
        WorkFailedError: the loss is not finite, memory or disk is full.
        KeyboardInterrupt: interrupted; the state after the last step is stored.
    """
    entry = find(baseline)
    tier, home, known = locate(split, size, root=root, registry=registry)
    plan = recipe_for(entry, tier.split, size, variant=recipe, settings=settings, seed=seed)
    check_symmetry(plan.model.get("symmetry"), tier)
    facts = facts_of(tier.split, size, root=home, registry=known)
    folder = RunFolder(Path(output) if output else default_folder(plan))
    check_writable(folder.path, option="--output")
    shared = int(os.environ.get("WORLD_SIZE", processes))
    earlier = folder.earlier(plan, resume=resume, fresh=fresh)
    _check_same(earlier, facts, shared, folder)
    if earlier is None and not is_helper():
        folder.clear()
    job = Job(
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
    with generators_kept(), threads_used(threads, processes=here), memory_errors_told(SMALLER):
        reseed(seed_of(plan.training.seed))
        model = entry.model.build(plan.model, facts)
        ledger, steps = _run(job, model)
    return _result(job, ledger, model, steps)


def _run(job: Job, model: Baseline) -> tuple[Ledger, int]:
    """Fit or train; Lightning is imported only here."""
    if getattr(model, "closed_form", False):
        from .fitting import fit

        return fit(job, model)
    from .descent import descend

    return descend(job, model)


def _check_same(earlier: Checkpoint | None, facts: Facts, processes: int, folder: RunFolder) -> None:
    """Refuse to go on with other data, or with another number of processes."""
    if earlier is None:
        return
    if earlier.facts.dataset_sha256 != facts.dataset_sha256:
        raise DataError(
            "the training began on another version of the data set",
            where=str(folder.path),
            expected=earlier.facts.dataset_sha256,
            got=facts.dataset_sha256,
            fix="train anew with --fresh",
        )
    if earlier.training.get("processes") != processes:
        raise UsageError(
            "the training began with another number of processes",
            where="--processes",
            expected=earlier.training.get("processes"),
            got=processes,
            fix="the learning rate and the order of windows follow from it; or train anew with --fresh",
        )


def _result(job: Job, ledger: Ledger, model: Baseline, steps: int) -> TrainingResult:
    return TrainingResult(
        baseline=job.recipe.baseline,
        split=job.facts.split,
        size=job.facts.size,
        recipe=job.recipe.name,
        folder=job.folder.path,
        weights=job.folder.weights,
        checkpoint=job.folder.checkpoint,
        state=ledger.state,
        step=ledger.step,
        steps=steps,
        parameters=parameter_count(model),
        loss=ledger.loss,
        best_rmse=ledger.best_rmse,
        best_step=ledger.best_step,
        cpu_seconds=ledger.cpu_seconds,
        wall_seconds=ledger.wall_seconds,
    )
