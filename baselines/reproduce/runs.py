"""Runs: where they lie, and whatever of them is not there yet: train, predict,
score.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lagbench.atomic import write_atomically
from lagbench.baselines.job import OVER
from lagbench.errors import DataError, LagbenchError, UsageError
from lagbench.scoring.card import JSON_NAME
from lagbench.scoring.score_file import NETCDF_NAME, read_statistics
from lagbench.submission.predictions import open_predictions
from lagbench.work.pool import Report, crash_error
from lagbench.work.run import run_all

from .evidence import RECORD_NAME, read_json
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
from .thesis import Model, Study

if TYPE_CHECKING:
    from lagbench.baselines.recipe import Recipe

OTHER = "name another folder of runs with --runs, or remove this run"


Run = tuple[str, Model, int]
"""Split, model and seed."""


WINDOWS = 4096  # most windows of a subset that an error is measured over, evenly spaced


def make_runs(plan: Plan, runs: Sequence[Run], *, workers: int = 1) -> int:
    """Make runs, ``workers`` of them side by side; what fails is said and entered, the
    others are made.

    On one GPU that pays as it does on many cores: small models keep a GPU waiting for
    their processor. Return 0, or the exit code of the last one that failed; a worker
    that dies three times ends all.
    """
    names = [f"{split} {plan.size} {model.name}-{seed}" for split, model, seed in runs]
    jobs = {name: (plan, name, run) for name, run in zip(names, runs, strict=True)}
    try:
        codes = run_all(_make_named, jobs, workers=workers)
    except LagbenchError as error:
        complain(error)
        return error.exit_code
    for (split, model, seed), code in zip(runs, codes, strict=True):
        if code:
            plan.failed.add(plan.folder(split, model.name, seed))
    return next((code for code in reversed(codes) if code), 0)


def _make_named(job: tuple[Plan, str, Run], _: Report) -> int:
    plan, name, run = job
    note(name)
    try:
        make_run(plan, *run)
    except Exception as error:  # the others go on
        if isinstance(error, LagbenchError):
            told = error
        else:
            told = crash_error(error)
        complain(told, name)
        return told.exit_code
    return 0


def note(text: str) -> None:
    """Say how the work goes on."""
    sys.stderr.write(f"-- {text}\n")


def complain(error: LagbenchError, where: str = "") -> None:
    """Say what failed."""
    sys.stderr.write(f"error: {where + ': ' if where else ''}{error}\n")


def make_run(plan: Plan, split: str, model: Model, seed: int) -> None:
    """Train, predict and score what of a run is missing.

    An interrupted training goes on where it stopped; predictions and scores of other
    data are made again, with a note.
    """
    folder = plan.folder(split, model.name, seed)
    check_training(plan, split, model, seed, folder=folder)
    for path in _stale(plan.hash(split), folder):
        note(f"{path}: of another version of the data; made again")
        path.unlink()
    if (folder / NETCDF_NAME).is_file() and (folder / JSON_NAME).is_file():
        return
    if not (folder / PREDICTIONS).is_file():
        make_training(plan, split, model, seed, folder=folder)
        _predict(plan, folder / "weights.pt", folder, model.name)
    _score(plan, folder)


def score_committed(plan: Plan, split: str, model: Model) -> None:
    """Make a run of a model's committed weights of the least seed, if there are any and
    no run was scored.
    """
    for name, _, folder in plan.sources.run_folders(split, plan.size):
        if name == model.name and (folder / NETCDF_NAME).is_file():
            return
    if plan.recipe:
        known = f"{model.name}-{plan.recipe}"
    else:
        known = model.name
    files = (plan.weights / split / plan.size).glob(f"{known}_*.pt")
    seeds = {
        int(end): path
        for path in files
        if (end := path.stem[len(known) + 1 :]).isdecimal()
    }
    if not seeds:
        return
    seed, weights = min(seeds.items())
    folder = plan.folder(split, model.name, seed)
    note(f"{folder}: from {weights}")
    # predicting comes first: it refuses weights of other data, and then nothing is
    # written
    if not (folder / PREDICTIONS).is_file():
        _predict(plan, weights, folder, model.name)
    # with its record the run is one like any other: a later training checks its recipe
    for source, target in (
        (weights, "weights.pt"),
        (weights.with_suffix(".json"), RECORD_NAME),
    ):
        if source.is_file():
            write_atomically(folder / target, source.read_bytes())
    _score(plan, folder)


def _predict(plan: Plan, weights: Path, folder: Path, name: str) -> None:
    from lagbench.baselines.predict import predict

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

    score(folder / PREDICTIONS, root=plan.root, registry=plan.registry)


def make_training(
    plan: Plan, split: str, model: Model, seed: int, *, folder: Path
) -> None:
    """Train a model unless its training is complete."""
    if _complete(folder):
        return
    from lagbench.baselines.train import train

    train(
        model.baseline,
        split,
        plan.size,
        recipe=model.recipe or plan.recipe,
        settings=(*model.settings, *plan.settings),
        seed=seed,
        root=plan.root,
        output=folder,
        device=plan.device,
        threads=plan.threads,
        registry=plan.registry,
    )


def check_training(
    plan: Plan, split: str, model: Model, seed: int, *, folder: Path
) -> None:
    """Refuse a folder whose training is not the one that was asked for; one without a
    record passes.
    """
    record = read_json(folder / RECORD_NAME)
    if not record:
        return
    from lagbench.baselines.job import first_difference

    asked = _recipe(plan, split, model, seed).as_json()
    if record.get("recipe") != asked:
        difference = first_difference(asked, record.get("recipe"))
        raise UsageError(
            "the run has another recipe",
            where=str(folder),
            expected=difference,
            fix=OTHER,
        )
    data = plan.hash(split)
    got = record.get("dataset_sha256")
    if data is not None and got != data:
        raise DataError(
            "the run was trained on other data",
            where=str(folder),
            expected=data,
            got=got,
            fix=OTHER,
        )


def study_model(plan: Plan, study: Study) -> Model:
    """Return what to train for a row: at ``full`` its own recipe, else the size's
    recipe with changes.
    """
    name = study_name(study)
    unvalidated = "training.validate_every=0"
    if plan.size == "full":
        # what tells a row's recipe from the others of its table
        ends = {
            "4.2": study.activation,
            "4.3": study.widths[0],
            "4.4": len(study.widths),
            "4.5": study.row,
        }
        variant = f"table-{study.table}-{ends[study.table]}"
        return Model(name, name, varied="mlp", settings=(unvalidated,), recipe=variant)
    share, divisor = SHARES[plan.size]
    settings = (
        unvalidated,
        f"model.widths={list(study.widths)}",
        f"model.activation={study.activation}",
        *("model.target=state", "model.noise_std=0", "model.material=false"),
        f"training.epochs={max(1.0, share * study.epochs):g}",
        f"training.batch={study.batch // divisor}",
        *("training.learning_rate=0.001", "training.schedule=constant"),
    )
    return Model(name, name, varied="mlp", settings=settings)


def make_studies(plan: Plan, name: str) -> None:
    """Train the rows of a table and measure their errors, unless that was done."""
    split = TABLES[name][1]
    seed = plan.seeds[0]
    path = plan.home(split) / STUDY_FILE
    for study in study_rows(name):
        folder = study_folder(plan, name, study)
        model = study_model(plan, study)
        held = read_json(path)
        check_training(plan, split, model, seed, folder=folder)
        if (
            held.get(model.name, {}).get("seed") == seed
            and (folder / "weights.pt").is_file()
        ):
            continue
        make_training(plan, split, model, seed, folder=folder)
        errors = {
            subset: one_step_error(plan, split, folder, subset)
            for subset in ("train", "valid")
        }
        held[model.name] = {
            "seed": seed,
            **errors,
            "training": read_json(folder / RECORD_NAME),
        }
        write_atomically(path, json.dumps(held, indent=1, sort_keys=True).encode())


def one_step_error(plan: Plan, split: str, folder: Path, subset: str) -> float:
    """Return the mean of Eq. 4.16 over the windows of a subset [standardised^2]."""
    import torch

    from lagbench.baselines.checkpoint import load, restore
    from lagbench.tensors import collate
    from lagbench.torch import WindowDataset

    model = restore(load(folder / "weights.pt")).eval()
    data = WindowDataset(
        split,
        subset=subset,
        size=plan.size,
        root=plan.root,
        history=model.history,
        registry=plan.registry,
    )
    count = min(len(data), WINDOWS)
    chosen = [i * len(data) // count for i in range(count)]
    total = 0.0
    with torch.no_grad():
        for first in range(0, count, 128):
            windows = [data[i] for i in chosen[first : first + 128]]
            terms = model(collate(windows))
            total += len(windows) * float(terms["position"] + terms["velocity"]) / 2.0
    return total / count


def outlook(plan: Plan, split: str, model: Model, seed: int) -> str:
    """Return what :func:`make_run` would do, in words; nothing is made."""
    folder = plan.folder(split, model.name, seed)
    check_training(plan, split, model, seed, folder=folder)
    stale = _stale(plan.hash(split), folder)
    there = {path.name for path in folder.glob("*") if path not in stale}
    if {NETCDF_NAME, JSON_NAME} <= there:
        return "there"
    if PREDICTIONS in there:
        return "to score"
    if _complete(folder):
        return "to predict and score"
    recipe = _recipe(plan, split, model, seed)
    steps = recipe.training.steps
    epochs = recipe.training.epochs
    if steps is not None:
        return f"to train, {recipe.name}: {steps:,} steps"
    return f"to train, {recipe.name}: {'closed form' if epochs is None else f'{epochs:g} epochs'}"


def _recipe(plan: Plan, split: str, model: Model, seed: int) -> Recipe:
    """Return the recipe that was asked for."""
    from lagbench.baselines.catalogue import find
    from lagbench.baselines.recipe import recipe_for

    settings = (*model.settings, *plan.settings)
    variant = model.recipe or plan.recipe
    return recipe_for(
        find(model.baseline),
        split,
        plan.size,
        variant=variant,
        settings=settings,
        seed=seed,
    )


def _stale(data: str | None, folder: Path) -> list[Path]:
    """Return the predictions and scores of a run that are of other data than those of a
    hash.
    """
    predictions = folder / PREDICTIONS
    scores = folder / NETCDF_NAME
    if data is not None and predictions.is_file():
        with open_predictions(predictions) as found:
            if found.header.dataset_sha256 != data:
                return [path for path in (predictions, scores) if path.is_file()]
    if (
        data is not None
        and scores.is_file()
        and read_statistics(scores).identity["dataset_sha256"] != data
    ):
        return [scores]
    return []


def _complete(folder: Path) -> bool:
    """Tell whether weights are there whose training is over, as far as a record
    says.
    """
    record = folder / RECORD_NAME
    if not (folder / "weights.pt").is_file():
        return False
    return not record.is_file() or read_json(record).get("state") in OVER
