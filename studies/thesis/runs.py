"""Make the runs that a plan needs: train, predict and score what is missing."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.atomic import write_atomically
from lagbench.baselines.training_log import OVER
from lagbench.errors import DataError, LagbenchError, UsageError
from lagbench.scoring.card import JSON_NAME
from lagbench.scoring.score_file import NETCDF_NAME, read_statistics
from lagbench.submission.predictions import open_predictions
from lagbench.work.pool import Report, crash_error
from lagbench.work.run import run_all

from .plan import (
    PREDICTIONS,
    SHARES,
    STUDY_FILE,
    TABLES,
    Plan,
    study_folder,
    study_name,
    study_rows,
)
from .published import MLPStudy
from .roster import RosterModel
from .split_results import RECORD_NAME, read_json

if TYPE_CHECKING:
    from lagbench.baselines.recipe import Recipe

OTHER_RUN = "name another folder of runs with --runs, or remove this run"

WEIGHTS_NAME = "weights.safetensors"

Run = tuple[str, RosterModel, int]
"""Split, model and seed."""

MOST_WINDOWS = 4096
"""Windows of a subset that an error is measured over, evenly spaced."""

ERROR_BATCH = 128  # windows of one call of the model


def make_runs(plan: Plan, runs: Sequence[Run], *, workers: int = 1) -> int:
    """Make runs, ``workers`` of them side by side.

    A run that fails is reported and noted in the plan; the others are made. Side by
    side pays on one GPU as on many cores: small models keep a GPU waiting for their
    processor.

    Returns:
        0, or the exit code of the last run that failed. A worker that dies three times
        ends all runs.
    """
    jobs = {}
    for split, model, seed in runs:
        job_name = f"{split} {plan.size} {model.name}-{seed}"
        jobs[job_name] = (plan, job_name, (split, model, seed))
    try:
        codes = run_all(_make_named, jobs, workers=workers)
    except LagbenchError as error:
        complain(error)
        return error.exit_code

    last_code = 0
    for (split, model, seed), code in zip(runs, codes, strict=True):
        if code:
            plan.failed.add(plan.folder(split, model.name, seed))
            last_code = code
    return last_code


def _make_named(job: tuple[Plan, str, Run], _: Report) -> int:
    plan, job_name, (split, model, seed) = job
    note(job_name)
    try:
        make_run(plan, split, model=model, seed=seed)
    except LagbenchError as error:
        complain(error, job_name)
        return error.exit_code
    except Exception as error:  # the other runs go on
        failure = crash_error(error)
        complain(failure, job_name)
        return failure.exit_code
    return 0


def note(text: str) -> None:
    """Report progress on stderr."""
    sys.stderr.write(f"-- {text}\n")


def complain(error: LagbenchError, where: str = "") -> None:
    """Report an error on stderr."""
    prefix = f"{where}: " if where else ""
    sys.stderr.write(f"error: {prefix}{error}\n")


def make_run(plan: Plan, split: str, *, model: RosterModel, seed: int) -> None:
    """Train, predict and score what is missing of a run.

    An interrupted training is continued. Predictions and scores of other data are made
    again, with a note.
    """
    folder = plan.folder(split, model.name, seed)
    check_training(plan, split, model=model, seed=seed, folder=folder)
    for path in _stale_files(plan.hash(split), folder):
        note(f"{path}: of another version of the data; made again")
        path.unlink()

    has_scores = (folder / NETCDF_NAME).is_file() and (folder / JSON_NAME).is_file()
    if has_scores:
        return
    if not (folder / PREDICTIONS).is_file():
        make_training(plan, split, model=model, seed=seed, folder=folder)
        _predict(plan, folder / WEIGHTS_NAME, folder=folder, name=model.name)
    _score(plan, folder)


def score_committed(plan: Plan, split: str, model: RosterModel) -> None:
    """Make a run of a model's committed weights of the least seed.

    Nothing happens if there are no such weights, or if a run was scored already.
    """
    for name, _, folder in plan.sources.run_folders(split, plan.size):
        if name == model.name and (folder / NETCDF_NAME).is_file():
            return

    committed_name = model.name
    if plan.recipe:
        committed_name = f"{model.name}-{plan.recipe}"
    weights_by_seed = {}
    weights_folder = plan.weights / split / plan.size
    for path in weights_folder.glob(f"{committed_name}_*.safetensors"):
        seed_text = path.stem.removeprefix(f"{committed_name}_")
        if seed_text.isdecimal():
            weights_by_seed[int(seed_text)] = path
    if not weights_by_seed:
        return

    seed = min(weights_by_seed)
    weights = weights_by_seed[seed]
    folder = plan.folder(split, model.name, seed)
    note(f"{folder}: from {weights}")
    # predict first: it refuses weights of other data, and then nothing is written
    if not (folder / PREDICTIONS).is_file():
        _predict(plan, weights, folder=folder, name=model.name)
    # with its record the run is one like any other: a later training checks its recipe
    copies = {weights: WEIGHTS_NAME, weights.with_suffix(".json"): RECORD_NAME}
    for source, target_name in copies.items():
        if source.is_file():
            write_atomically(folder / target_name, source.read_bytes())
    _score(plan, folder)


def _predict(plan: Plan, weights: Path, *, folder: Path, name: str) -> None:
    from lagbench.baselines.predict import predict  # loads torch

    predict(
        weights,
        folder / PREDICTIONS,
        root=plan.root,
        device=plan.device,
        threads=plan.threads,
        method=name,
        registry=plan.registry,
    )


def _score(plan: Plan, folder: Path) -> None:
    from lagbench.scoring.score import score

    score(
        folder / PREDICTIONS, root=plan.root, output_dir=folder, registry=plan.registry
    )


def make_training(
    plan: Plan, split: str, *, model: RosterModel, seed: int, folder: Path
) -> None:
    """Train a model into a folder, unless its training there is complete."""
    if _is_complete(folder):
        return
    from lagbench.baselines.train import train  # loads torch

    train(
        model.baseline,
        split,
        plan.size,
        recipe=model.recipe or plan.recipe,
        settings=(*model.settings, *_settings_for(plan, model)),
        seed=seed,
        root=plan.root,
        output=folder,
        device=plan.device,
        threads=plan.threads,
        registry=plan.registry,
    )


def check_training(
    plan: Plan, split: str, *, model: RosterModel, seed: int, folder: Path
) -> None:
    """Refuse a folder whose training has another recipe or other data.

    A folder without a record passes.

    Raises:
        UsageError: the recipe is another one.
        DataError: the data are others.
    """
    record = read_json(folder / RECORD_NAME)
    if not record:
        return
    recipe = _recipe(plan, split, model=model, seed=seed).as_json()
    if record.get("recipe") != recipe:
        raise UsageError(f"the run has another recipe; {OTHER_RUN}", where=str(folder))
    data_hash = plan.hash(split)
    trained_hash = record.get("dataset_sha256")
    if data_hash is not None and trained_hash != data_hash:
        raise DataError(
            "the run was trained on other data",
            where=str(folder),
            expected=data_hash,
            got=trained_hash,
            fix=OTHER_RUN,
        )


def study_model(plan: Plan, study: MLPStudy) -> RosterModel:
    """Return the model of a row.

    At ``full`` it has a recipe of its own, else the size's recipe with changes.
    """
    name = study_name(study)
    no_validation = "training.validate_every=0"
    if plan.size == "full":
        # the part of a row's recipe that differs from the others of its table
        ending = {
            "4.2": study.activation,
            "4.3": study.widths[0],
            "4.4": len(study.widths),
            "4.5": study.row,
        }[study.table]
        return RosterModel(
            name,
            name,
            variant_of="mlp",
            settings=(no_validation,),
            recipe=f"table-{study.table}-{ending}",
        )

    share, divisor = SHARES[plan.size]
    epochs = max(1.0, share * study.epochs)
    settings = (
        no_validation,
        f"model.widths={list(study.widths)}",
        f"model.activation={study.activation}",
        "model.target=state",
        "model.noise_std=0",
        "model.material=false",
        f"training.epochs={epochs:g}",
        f"training.batch={study.batch // divisor}",
        "training.learning_rate=0.001",
        "training.schedule=constant",
    )
    return RosterModel(name, name, variant_of="mlp", settings=settings)


def make_studies(plan: Plan, name: str) -> None:
    """Train the rows of a table and measure their errors, where that is missing."""
    _, split = TABLES[name]
    seed = plan.seeds[0]
    path = plan.home(split) / STUDY_FILE
    for study in study_rows(name):
        folder = study_folder(plan, name, study)
        model = study_model(plan, study)
        check_training(plan, split, model=model, seed=seed, folder=folder)
        results = read_json(path)
        has_errors = results.get(model.name, {}).get("seed") == seed
        if has_errors and (folder / WEIGHTS_NAME).is_file():
            continue

        make_training(plan, split, model=model, seed=seed, folder=folder)
        results[model.name] = {
            "seed": seed,
            "train": one_step_error(plan, split, folder=folder, subset="train"),
            "valid": one_step_error(plan, split, folder=folder, subset="valid"),
            "training": read_json(folder / RECORD_NAME),
        }
        content = json.dumps(results, indent=1, sort_keys=True)
        write_atomically(path, content.encode())


def one_step_error(plan: Plan, split: str, *, folder: Path, subset: str) -> float:
    """Return the mean of Eq. 4.16 over the windows of a subset [standardised^2]."""
    import torch

    from lagbench.baselines.checkpoint import load, restore
    from lagbench.tensors import collate
    from lagbench.torch import WindowDataset

    model = restore(load(folder / WEIGHTS_NAME)).eval()
    data = WindowDataset(
        split,
        subset=subset,
        size=plan.size,
        root=plan.root,
        history=model.history,
        registry=plan.registry,
    )
    count = min(len(data), MOST_WINDOWS)
    indices = [i * len(data) // count for i in range(count)]
    total = 0.0
    with torch.no_grad():
        for first in range(0, count, ERROR_BATCH):
            windows = [data[i] for i in indices[first : first + ERROR_BATCH]]
            terms = model(collate(windows))
            batch_error = float(terms["position"] + terms["velocity"]) / 2.0
            total += len(windows) * batch_error
    return total / count


def describe_run(plan: Plan, split: str, *, model: RosterModel, seed: int) -> str:
    """Return in words what :func:`make_run` would do; nothing is made."""
    folder = plan.folder(split, model.name, seed)
    check_training(plan, split, model=model, seed=seed, folder=folder)
    stale = _stale_files(plan.hash(split), folder)
    valid_names = {path.name for path in folder.glob("*") if path not in stale}
    if {NETCDF_NAME, JSON_NAME} <= valid_names:
        return "there"
    if PREDICTIONS in valid_names:
        return "to score"
    if _is_complete(folder):
        return "to predict and score"

    recipe = _recipe(plan, split, model=model, seed=seed)
    if recipe.training.steps is not None:
        budget = f"{recipe.training.steps:,} steps"
    elif recipe.training.epochs is not None:
        budget = f"{recipe.training.epochs:g} epochs"
    else:
        budget = "a fit"
    return f"to train, {recipe.name}: {budget}"


def _recipe(plan: Plan, split: str, *, model: RosterModel, seed: int) -> Recipe:
    """Return the recipe that the plan gives a model."""
    # these load torch
    from lagbench.baselines.catalogue import find
    from lagbench.baselines.recipe import recipe_for

    return recipe_for(
        find(model.baseline),
        split,
        plan.size,
        variant=model.recipe or plan.recipe,
        settings=(*model.settings, *_settings_for(plan, model)),
        seed=seed,
    )


def _settings_for(plan: Plan, model: RosterModel) -> tuple[str, ...]:
    """Return the changes of the plan that a model can use.

    A plan holds for all models of a split. One that is fitted takes no steps; it is
    made without the options of the training.
    """
    from lagbench.baselines.catalogue import find  # loads torch

    if not find(model.baseline).model.closed_form:
        return plan.settings
    return tuple(
        setting for setting in plan.settings if not setting.startswith("training.")
    )


def _stale_files(data_hash: str | None, folder: Path) -> list[Path]:
    """Return the predictions and scores of a run that are of other data."""
    if data_hash is None:
        return []
    predictions = folder / PREDICTIONS
    scores = folder / NETCDF_NAME
    if predictions.is_file():
        with open_predictions(predictions) as file:
            predicted_hash = file.header.dataset_sha256
        if predicted_hash != data_hash:
            return [path for path in (predictions, scores) if path.is_file()]
    if scores.is_file():
        scored_hash = read_statistics(scores).identity["dataset_sha256"]
        if scored_hash != data_hash:
            return [scores]
    return []


def _is_complete(folder: Path) -> bool:
    """Return whether a folder has weights, and a record that is over if it has one."""
    if not (folder / WEIGHTS_NAME).is_file():
        return False
    record = folder / RECORD_NAME
    return not record.is_file() or read_json(record).get("state") in OVER
