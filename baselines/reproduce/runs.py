"""Runs: where they lie, and whatever of them is not there yet: train, predict, score."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lagbench.atomic import write_atomically
from lagbench.baselines.job import OVER
from lagbench.data.local import rooted
from lagbench.data.manifest import read_manifest
from lagbench.data.registry import Registry, Size
from lagbench.errors import DataError, LagbenchError, UsageError
from lagbench.scoring.card import JSON_NAME
from lagbench.scoring.score_file import NETCDF_NAME, read_statistics
from lagbench.scoring.task import ScoredTask, load_scored_task
from lagbench.submission.predictions import open_predictions
from lagbench.work.pool import Report, crashed
from lagbench.work.run import run_all

from .evidence import RECORD_NAME, STUDIES, WEIGHTS, Evidence, Sources, read_json
from .thesis import Model

if TYPE_CHECKING:
    from lagbench.baselines.recipe import Recipe

PREDICTIONS = "predictions.nc"

OTHER = "name another folder of runs with --runs, or remove this run"


@dataclass(frozen=True, kw_only=True)
class Plan:
    """One size to reproduce: what was asked for, and where everything of it lies."""

    size: str
    root: Path  # folder of all data sets
    runs: Path  # folder of runs; what is there is not made again
    output: Path  # folder of tables and pictures
    weights: Path = WEIGHTS  # folder of committed weights
    studies: Path = STUDIES  # folder of committed results that are no entries
    seeds: tuple[int, ...] = (0,)  # seeds of every training; pictures show the first
    recipe: str | None = None  # variant of the recipes, as in short; None for the size's own
    settings: tuple[str, ...] = ()  # changes to every recipe, as in training.steps=100
    device: str = "auto"
    threads: int | None = None  # of a training on the CPU; one per core by default, one with workers
    registry: Registry | None = None  # where splits are described; ours when None
    # folders of runs that could not be made, or are not those that were asked for: nothing of them is shown
    failed: set[Path] = field(default_factory=set, compare=False, repr=False)
    _evidence: dict[str, Evidence] = field(default_factory=dict, compare=False, repr=False)
    _subsets: dict[str, ScoredTask] = field(default_factory=dict, compare=False, repr=False)

    @cached_property
    def described(self) -> Registry:
        """Splits, those of the root folder included."""
        return rooted(self.root, self.registry)

    def tier(self, split: str) -> Size:
        """Return what the registry says of a split at this size."""
        return self.described.size(split, self.size)

    def hash(self, split: str) -> str | None:
        """Return the hash of a split's data, those at hand before those recorded; None where unknown."""
        tier = self.tier(split)
        manifest = read_manifest(self.root, tier.split, tier.name, tier.major)
        recorded = tier.measured.dataset_sha256 if tier.measured else None
        return (manifest.dataset_sha256 if manifest else None) or recorded

    def has_recipe(self, split: str, model: Model) -> bool:
        """Return whether a model has the variant of the recipes that was asked for."""
        if self.recipe is None or self.recipe.endswith((".yaml", ".yml")):
            return True
        from lagbench.baselines.catalogue import find
        from lagbench.baselines.recipe import recipe_names

        try:
            known = recipe_names(find(model.baseline))
        except UsageError:  # it cannot be loaded: training says why
            return True
        return any(f"{where}/{self.size}-{self.recipe}" in known for where in (split, "*"))

    def home(self, split: str) -> Path:
        """Return the folder of a split's runs: ``runs/<split>/<size>[-<recipe>]``."""
        return self.runs / split / (f"{self.size}-{self.recipe}" if self.recipe else self.size)

    def folder(self, split: str, name: str, seed: int) -> Path:
        """Return the folder of one training."""
        return self.home(split) / f"{name}-{seed}"

    def predictions(self, split: str, name: str) -> Path | None:
        """Return a model's predictions, those of the first seed asked for; None where none were scored."""
        method = self.evidence(split).methods.get(name)
        held = sorted(method.seeds if method else (), key=lambda one: one.seed != self.seeds[0])
        paths = [one.path.with_name(PREDICTIONS) for one in held]
        return next((path for path in paths if path.is_file()), None)

    @property
    def sources(self) -> Sources:
        """Where the evidence of these runs lies."""
        return Sources(
            board=None,
            weights=self.weights,
            runs=self.runs,
            recipe=self.recipe,
            registry=self.described,
            studies=self.studies,
            left_out=frozenset(self.failed),
        )

    def evidence(self, split: str) -> Evidence:
        """Return scores, costs and records of a split's runs; read once, after they are made."""
        if split not in self._evidence:
            self._evidence[split] = Evidence(self.sources, split, self.size)
        return self._evidence[split]

    @property
    def stale(self) -> list[Path]:
        """Score files of other data among the evidence that was read; they are left out."""
        return [path for evidence in self._evidence.values() for path in evidence.stale]

    def test_subset(self, split: str) -> ScoredTask:
        """Return the test subset of a split as the scorer sees it."""
        if split not in self._subsets:
            self._subsets[split] = load_scored_task(self.tier(split), self.root)
        return self._subsets[split]


Run = tuple[str, Model, int]
"""Split, model and seed."""


def make_runs(plan: Plan, runs: Sequence[Run], *, workers: int = 1) -> int:
    """Make runs, ``workers`` of them side by side; what fails is said and entered, the others are made.

    On one GPU that pays as it does on many cores: small models keep a GPU waiting for their processor.
    Return 0, or the exit code of the last one that failed; a worker that dies three times ends all.
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
        told = error if isinstance(error, LagbenchError) else crashed(error)
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

    An interrupted training goes on where it stopped; predictions and scores of other data are made again,
    with a note.
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
    """Make a run of a model's committed weights of the least seed, if there are any and no run was scored."""
    for name, _, folder in plan.sources.run_folders(split, plan.size):
        if name == model.name and (folder / NETCDF_NAME).is_file():
            return
    known = f"{model.name}-{plan.recipe}" if plan.recipe else model.name
    files = (plan.weights / split / plan.size).glob(f"{known}_*.pt")
    seeds = {int(end): path for path in files if (end := path.stem[len(known) + 1 :]).isdecimal()}
    if not seeds:
        return
    seed, weights = min(seeds.items())
    folder = plan.folder(split, model.name, seed)
    note(f"{folder}: from {weights}")
    # predicting comes first: it refuses weights of other data, and then nothing is written
    if not (folder / PREDICTIONS).is_file():
        _predict(plan, weights, folder, model.name)
    # with its record the run is one like any other: a later training checks its recipe
    for source, target in ((weights, "weights.pt"), (weights.with_suffix(".json"), RECORD_NAME)):
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


def make_training(plan: Plan, split: str, model: Model, seed: int, *, folder: Path) -> None:
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


def check_training(plan: Plan, split: str, model: Model, seed: int, *, folder: Path) -> None:
    """Refuse a folder whose training is not the one that was asked for; one without a record passes."""
    record = read_json(folder / RECORD_NAME)
    if not record:
        return
    from lagbench.baselines.job import first_difference

    asked = _recipe(plan, split, model, seed).as_json()
    if record.get("recipe") != asked:
        difference = first_difference(asked, record.get("recipe"))
        raise UsageError("the run has another recipe", where=str(folder), expected=difference, fix=OTHER)
    data, got = plan.hash(split), record.get("dataset_sha256")
    if data is not None and got != data:
        raise DataError(
            "the run was trained on other data", where=str(folder), expected=data, got=got, fix=OTHER
        )


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
    steps, epochs = recipe.training.steps, recipe.training.epochs
    if steps is not None:
        return f"to train, {recipe.name}: {steps:,} steps"
    return f"to train, {recipe.name}: {'closed form' if epochs is None else f'{epochs:g} epochs'}"


def _recipe(plan: Plan, split: str, model: Model, seed: int) -> Recipe:
    """Return the recipe that was asked for."""
    from lagbench.baselines.catalogue import find
    from lagbench.baselines.recipe import recipe_for

    settings, variant = (*model.settings, *plan.settings), model.recipe or plan.recipe
    return recipe_for(find(model.baseline), split, plan.size, variant=variant, settings=settings, seed=seed)


def _stale(data: str | None, folder: Path) -> list[Path]:
    """Return the predictions and scores of a run that are of other data than those of a hash."""
    predictions, scores = folder / PREDICTIONS, folder / NETCDF_NAME
    if data is not None and predictions.is_file():
        with open_predictions(predictions) as found:
            if found.header.dataset_sha256 != data:
                return [path for path in (predictions, scores) if path.is_file()]
    if data is not None and scores.is_file() and read_statistics(scores).identity["dataset_sha256"] != data:
        return [scores]
    return []


def _complete(folder: Path) -> bool:
    """Tell whether weights are there whose training is over, as far as a record says."""
    record = folder / RECORD_NAME
    if not (folder / "weights.pt").is_file():
        return False
    return not record.is_file() or read_json(record).get("state") in OVER


def budget(record: Mapping[str, Any]) -> str:
    """Return steps and windows of a step, as in "5,000 x 2"; a dash where unknown."""
    if "windows" not in record:
        return "closed form" if record.get("step") == 1 else "-"
    return f"{record['step']:,} x {record['recipe']['training']['batch']}"


def hardware(record: Mapping[str, Any]) -> str:
    """Return the machine of a training: its GPU, or its processor and threads."""
    said = record.get("hardware")
    if not said:
        return "-"
    if said["device"] != "cpu":
        return str(said["device"])
    threads = "1 thread" if said["threads"] == 1 else f"{said['threads']} threads"
    return f"{said['processor']}, {threads}"
