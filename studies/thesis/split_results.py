"""The results of all models on one split and size: scores, costs and training records.

Committed files suffice: the entries and score files of ``leaderboard/``, and the record
of each training, ``<weights>/<split>/<size>/<name>_<seed>.json``. Folders of runs,
``runs/<split>/<size>/<name>-<seed>/``, add what is not committed yet. A *name* is that
of a reference model or of a variant, as in ``gns-novorticity``.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from lagbench.board.entry import (
    Entry,
    EntryCost,
    MeasuredCost,
    Prediction,
    Status,
    Verification,
)
from lagbench.board.entry_file import read_entry
from lagbench.board.folder import Folder
from lagbench.board.gates import gates_failed_by, read_failed_gates
from lagbench.board.verified import read_verified, verification_of
from lagbench.data.registry import Registry, Size, load
from lagbench.errors import UnreadableFileError
from lagbench.metrics.aggregate import Score, mean_over_seeds
from lagbench.metrics.metric import mean
from lagbench.metrics.table import ranking_metric
from lagbench.references.predictor import Kind
from lagbench.references.shipped import shipped, shipped_path, solver_seconds
from lagbench.references.table import CLASSICAL, NAIVE, REFERENCES
from lagbench.scoring.score_file import NETCDF_NAME, read_statistics
from lagbench.scoring.skill import (
    AgainstClassical,
    best_reference,
    compute_against_classical,
    seconds_where_measured,
)

from .roster import PUSHFORWARD, ROSTER

BOARD = Path("leaderboard")
WEIGHTS = BOARD / "weights"
"""Folder of committed weights and of the records of their trainings."""

RECORD_NAME = "training.json"
COST_NAME = "predictions.json"

_RUN_NAME = re.compile(r"([a-z0-9]+(?:-[a-z0-9]+)*?)-(\d+)")


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoredTraining:
    """One training of a model, with the scores of its predictions."""

    seed: int | None  # None for a reference predictor
    scores: Mapping[str, Score]  # by metric
    record: Mapping[str, Any]  # training.json, or what the entry says; else empty
    path: Path  # file of the scores
    # options that the prediction changed, as in "model.average=true"
    predicted_with: tuple[str, ...] = ()

    @property
    def cpu_hours(self) -> float | None:
        """Processor time of the training without its validations [h]."""
        if "budget" in self.record:
            hours = self.record["budget"]["cpu_hours"]
            if hours is None:
                return None
            return float(hours)

        cpu_seconds = self.record.get("cpu_seconds")
        if cpu_seconds is None:
            return None
        validation_seconds = self.record.get("validation_cpu_seconds") or 0.0
        return (float(cpu_seconds) - float(validation_seconds)) / 3600.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Method:
    """A model or reference predictor with all its trainings."""

    name: str  # as in gns or gns-novorticity
    trainings: tuple[ScoredTraining, ...]  # one per seed
    # of a predicted frame, as the entry states it; None where it states none
    cost: EntryCost | None = None
    # of a frame, measured by us beside the solvers in one run
    measured: MeasuredCost | None = None
    parameters: int | None = None  # trained numbers; None where unknown
    kind: Kind = Kind.LEARNED

    @cached_property
    def scores(self) -> Mapping[str, Score]:
        """Scores by metric, the mean over the seeds that have a value."""
        scores = {}
        for metric in self.trainings[0].scores:
            if all(metric in training.scores for training in self.trainings):
                seed_scores = [training.scores[metric] for training in self.trainings]
                scores[metric] = _average_seeds(seed_scores)
        return scores

    @property
    def hours_per_seed(self) -> float | None:
        """Mean processor time of the recorded trainings [h]; None without a record."""
        hours = []
        for training in self.trainings:
            if training.cpu_hours is not None:
                hours.append(training.cpu_hours)
        if not hours:
            return None
        return fmean(hours)

    def of_seeds(self, seeds: Collection[int | None]) -> Method:
        """Return this model with the trainings of some seeds only, in ascending order.

        The seed None, of a reference predictor, comes first.
        """

        def order(training: ScoredTraining) -> int:
            if training.seed is None:
                return -1
            return training.seed

        chosen = [training for training in self.trainings if training.seed in seeds]
        return replace(self, trainings=tuple(sorted(chosen, key=order)))

    def spread(self, metric: str) -> float:
        """Return the sample deviation of mean scores over seeds; NaN for one seed."""
        if len(self.trainings) < 2:
            return math.nan
        means = [training.scores[metric].mean for training in self.trainings]
        return float(np.std(means, ddof=1))

    def at(self, metric: str, frame: int, scenario: int | None = None) -> float:
        """Return a metric at an absolute frame; NaN if it was not measured.

        The value is that of one scenario, or the mean over all. Reference predictors
        ship the mean only.
        """
        if metric not in self.scores:
            return math.nan
        score = self.scores[metric]
        values = score.at(frame)
        if scenario is None:
            return mean(values)
        if len(values) == len(score.scenarios):
            return float(values[score.scenarios.index(scenario)])
        return math.nan

    def over_horizon(self, metric: str, scenario: int) -> float:
        """Return a metric of one scenario over the horizon; NaN if not measured."""
        score = self.scores.get(metric)
        if score is None:
            return math.nan
        return float(score.values[score.scenarios.index(scenario)])


def _average_seeds(scores: Sequence[Score]) -> Score:
    """Return the mean of the scores of several seeds, per scenario and per frame.

    A value is the mean over the seeds that have one; undefined frames are added up.
    """
    if len(scores) == 1:
        return scores[0]
    undefined_counts = np.sum([score.undefined for score in scores], axis=0)
    return replace(
        scores[0],
        per_frame=mean_over_seeds([score.per_frame for score in scores]),
        values=mean_over_seeds([score.values for score in scores]),
        undefined=tuple(undefined_counts.tolist()),
    )


def rank(scores: Mapping[str, Score]) -> list[str]:
    """Return names from the least mean loss to the greatest; undefined ones last."""

    def loss(name: str) -> float:
        value = scores[name].mean
        if math.isnan(value):
            return math.inf
        return scores[name].metric.loss(value)

    return sorted(scores, key=lambda name: (loss(name), name))


@dataclass(frozen=True, kw_only=True)
class Sources:
    """The folders that results are read from."""

    board: Path | None = BOARD  # the leaderboard's folder; None to use runs alone
    weights: Path = WEIGHTS  # folder of committed weights and training records
    runs: Path | None = None  # folder of runs; None to use committed files alone
    studies: Path | None = None  # folder of results without an entry
    recipe: str | None = None  # variant of the recipes; None for the size's own
    registry: Registry | None = None  # descriptions of the splits; ours when None
    excluded_runs: frozenset[Path] = frozenset()  # folders of runs to leave out

    def size(self, split: str, size: str) -> Size:
        """Return the description of a split and size."""
        registry = self.registry or load()
        return registry.size(split, size)

    def has_size(self, split: str, size: str) -> bool:
        """Return whether a split has a size."""
        registry = self.registry or load()
        return split in registry.splits and size in registry.splits[split].sizes

    @cached_property
    def verified(self) -> Mapping[str, Verification]:
        """What the maintainers found out about entries, by path of the entry."""
        if self.board is None:
            return {}
        return read_verified(Folder(self.board))

    @cached_property
    def failed_gates(self) -> Mapping[str, tuple[str, ...]]:
        """Gates that weights fail, by SHA-256 of the weights."""
        if self.board is None:
            return {}
        return read_failed_gates(Folder(self.board))

    def entries(self, split: str, size: str) -> dict[str, Path]:
        """Return the entries of the board by name."""
        if self.board is None:
            return {}
        folder = self.board / "submissions" / split / size
        return {path.stem: path for path in sorted(folder.glob("*.yaml"))}

    def record(
        self, *, split: str, size: str, name: str, seed: int | None
    ) -> Mapping[str, Any]:
        """Return the committed record of a training; an empty one if there is none."""
        return read_json(self.weights / split / size / f"{name}_{seed or 0}.json")

    def run_folders(self, split: str, size: str) -> Iterator[tuple[str, int, Path]]:
        """Yield name, seed and folder of every run of a size.

        Without a recipe, runs of other recipes, in ``<size>-<recipe>/``, count as
        variants: their names end in ``-<recipe>``.
        """
        if self.runs is None:
            return

        home = self.runs / split
        if self.recipe is None:
            folders = {"": home / size}
            for folder in sorted(home.glob(f"{size}-*")):
                variant = folder.name.removeprefix(size)
                folders[variant] = folder
        else:
            folders = {"": home / f"{size}-{self.recipe}"}

        for variant, folder in folders.items():
            for run in sorted(folder.glob("*-*")):
                match = _RUN_NAME.fullmatch(run.name)
                if match and run not in self.excluded_runs:
                    name, seed = match.groups()
                    yield name + variant, int(seed), run


class SplitResults:
    """The results of all models and reference predictors on one split and size."""

    def __init__(self, sources: Sources, split: str, size: str) -> None:
        """Read entries, score files and records.

        A committed entry wins over a run of the same seed.
        """
        self.size = sources.size(split, size)
        self.methods: dict[str, Method] = {}  # by name, reference predictors included
        self.stale: list[Path] = []  # score files of another version of the data
        self.under_trained: set[str] = set()  # names of models that fail a gate
        self._sources = sources
        self._read_entries()
        self._read_runs()
        self._read_references()

    def _read_entries(self) -> None:
        split = self.size.split
        size = self.size.name
        for name, path in self._sources.entries(split, size).items():
            entry = read_entry(path)
            if entry.status is not Status.ACTIVE:
                continue
            if gates_failed_by(entry, self._sources.failed_gates):
                self.under_trained.add(name)
            verification = verification_of(entry, self._sources.verified)
            measured = None if verification is None else verification.cost
            # <board>/submissions/<split>/<size>/<name>.yaml
            board = path.parents[3]
            for prediction, score_path in zip(
                entry.predictions, entry.score_paths, strict=True
            ):
                seed = prediction.seed
                record = self._record(name, seed) or _entry_record(entry, prediction)
                if not record and name in ROSTER and ROSTER[name].weights_of:
                    record = self._record(ROSTER[name].weights_of, seed)
                self._add(
                    name,
                    seed,
                    path=board / score_path,
                    record=record,
                    predicted_with=_prediction_changes(entry, prediction),
                    cost=entry.cost,
                    measured=measured,
                    parameters=entry.parameters,
                    kind=entry.kind,
                )

    def _read_runs(self) -> None:
        committed: set[tuple[str, int | None]] = set()
        for name, method in self.methods.items():
            committed.update((name, training.seed) for training in method.trainings)

        run_folders = self._sources.run_folders(self.size.split, self.size.name)
        for name, seed, folder in run_folders:
            score_path = folder / NETCDF_NAME
            is_committed = (name, seed) in committed or (name, None) in committed
            if is_committed or not score_path.is_file():
                continue
            record = read_json(folder / RECORD_NAME) or self._record(name, seed)
            cost = _read_cost(folder / COST_NAME)
            self._add(name, seed, path=score_path, record=record, cost=cost)

    def _read_references(self) -> None:
        references = shipped(self.size) or {}
        for reference in references.values():
            if reference.name not in REFERENCES:
                continue  # measured by an earlier version of the package
            training = ScoredTraining(
                seed=None,
                scores=reference.scores,
                record={},
                path=shipped_path(self.size),
            )
            kind = REFERENCES[reference.name].kind
            method = Method(name=reference.name, trainings=(training,), kind=kind)
            self.methods.setdefault(reference.name, method)

    def _record(self, name: str, seed: int | None) -> Mapping[str, Any]:
        return self._sources.record(
            split=self.size.split, size=self.size.name, name=name, seed=seed
        )

    def _add(
        self,
        name: str,
        seed: int | None,
        *,
        path: Path,
        record: Mapping[str, Any],
        cost: EntryCost | None,
        predicted_with: tuple[str, ...] = (),
        measured: MeasuredCost | None = None,
        parameters: int | None = None,
        kind: Kind = Kind.LEARNED,
    ) -> None:
        """Add one training to a method, unless its scores are of other data."""
        stored = read_statistics(path)
        recorded = self.size.measured
        if recorded and stored.identity["dataset_sha256"] != recorded.dataset_sha256:
            self.stale.append(path)
            return

        training = ScoredTraining(
            seed=seed,
            scores=stored.scores(),
            record=record,
            path=path,
            predicted_with=predicted_with,
        )
        earlier = self.methods.get(name, Method(name=name, trainings=()))
        self.methods[name] = Method(
            name=name,
            trainings=(*earlier.trainings, training),
            cost=earlier.cost or cost,
            measured=earlier.measured or measured,
            parameters=earlier.parameters or record.get("parameters") or parameters,
            kind=kind,
        )

    @property
    def where(self) -> str:
        """Split and size, as in "cavity mini"."""
        return f"{self.size.split} {self.size.name}"

    @property
    def ranking(self) -> str:
        """Name of the metric that ranks."""
        return ranking_metric(self.size)

    @property
    def references(self) -> dict[str, Method]:
        """The reference predictors that were scored."""
        return {
            name: method for name, method in self.methods.items() if name in REFERENCES
        }

    @property
    def models(self) -> dict[str, Method]:
        """The learned and hybrid models, in the order of their names."""
        models = {}
        for name, method in sorted(self.methods.items()):
            is_model = method.kind in (Kind.LEARNED, Kind.HYBRID)
            if is_model and name not in REFERENCES:
                models[name] = method
        return models

    def best(self, *kinds: Kind) -> str | None:
        """Return the best method of some kinds; None where none of them is ranked."""
        names = [name for name, method in self.methods.items() if method.kind in kinds]
        ranked = self.order(names)
        return ranked[0] if ranked else None

    def order(self, names: Collection[str] | None = None) -> list[str]:
        """Return the ranked ones of some methods, of all by default, best first."""
        if names is None:
            names = self.methods
        scores = {}
        for name in names:
            if name in self.methods and self.ranking in self.methods[name].scores:
                scores[name] = self.methods[name].scores[self.ranking]
        return rank(scores)

    @property
    def best_naive(self) -> str | None:
        """Name of the best naive baseline, which skill is measured from; None without.

        It is the scorer's own choice.
        """
        scores = {}
        for name, method in self.methods.items():
            if name in NAIVE and self.ranking in method.scores:
                scores[name] = method.scores[self.ranking]
        return best_reference(scores)

    def skill(self, name: str) -> float:
        """Return ``1 - score / score of the best naive baseline``.

        The score is that of the ranking metric: 1 is perfect, 0 no better than the best
        naive baseline, NaN undefined.
        """
        naive = self.best_naive
        if naive is None or self.ranking not in self.methods[name].scores:
            return math.nan
        score = self.methods[name].scores[self.ranking].mean
        naive_score = self.methods[naive].scores[self.ranking].mean
        return 1.0 - score / naive_score

    def seconds_per_frame(self, name: str) -> float | None:
        """Return what a frame costs a method where the references were timed [s].

        The time that we measured counts before the one that an entry states. The time
        of our solver on the same machine scales it.
        """
        if name in REFERENCES:
            references = shipped(self.size) or {}
            if name in references:
                return references[name].seconds_per_frame
            return None
        measured = self.methods[name].measured
        if measured is not None:
            return seconds_where_measured(
                seconds_per_frame=measured.seconds_per_frame,
                solver_seconds=measured.solver,
                solver_seconds_here=solver_seconds(self.size),
            )
        cost = self.methods[name].cost
        if cost is None:
            return None
        return seconds_where_measured(
            seconds_per_frame=cost.seconds_per_frame,
            solver_seconds=cost.solver_seconds_per_frame,
            solver_seconds_here=solver_seconds(self.size),
        )

    def against_classical(self, name: str) -> AgainstClassical | None:
        """Return the score over that of the best classical solver of no greater cost.

        Where all cost more, the cheapest one takes its place.

        Costs that we measured in one run are compared as they are, as the leaderboard
        does. None where a cost is not known.
        """
        measured = self.methods[name].measured
        seconds = self.seconds_per_frame(name)
        if measured is not None and measured.classical:
            seconds = measured.seconds_per_frame
        if seconds is None:
            return None
        solvers = {}
        costs = {}
        for solver in CLASSICAL.intersection(self.methods):
            if measured is not None and measured.classical:
                cost = measured.classical.get(solver)
            else:
                cost = self.seconds_per_frame(solver)
            is_scored = self.ranking in self.methods[solver].scores
            if cost is not None and is_scored:
                solvers[solver] = self.methods[solver].scores[self.ranking]
                costs[solver] = cost
        trainings = self.methods[name].trainings
        seeds = [training.scores[self.ranking] for training in trainings]
        return compute_against_classical(
            seeds, solvers, seconds=costs, seconds_per_frame=seconds
        )

    def stand_in(self, name: str) -> str:
        """Return the model that claims about a graph network are tested with.

        It is the variant trained with pushforward, where that has scores. Else it is
        the model itself.
        """
        variant = f"{name}-{PUSHFORWARD}"
        if variant in self.methods:
            return variant
        return name

    def was_trained(self, name: str) -> bool:
        """Return whether a training of a model is recorded, with scores or without."""
        folder = self._sources.weights / self.size.split / self.size.name
        return any(folder.glob(f"{name}_[0-9]*.json"))


def _prediction_changes(entry: Entry, prediction: Prediction) -> tuple[str, ...]:
    """Return the options that a prediction of an entry changed."""
    provenance = prediction.provenance or entry.provenance
    if provenance is None:
        return ()
    return provenance.prediction_overrides


def _entry_record(entry: Entry, prediction: Prediction) -> dict[str, Any]:
    """Return what an entry says of a training, as a record like training.json.

    ``cpu_seconds`` are those of the entry's budget. The record is empty unless the
    training used one of our recipes, and the entry states its steps and hours.
    """
    provenance = prediction.provenance or entry.provenance
    budget = prediction.budget
    if budget is None and len(entry.predictions) == 1:
        budget = entry.budget  # of several seeds the entry has the mean
    if provenance is None or budget is None:
        return {}
    if not budget.steps or budget.cpu_hours is None:
        return {}

    changes = provenance.training_only().describe_changes()
    validations = []
    if budget.metric is not None:
        for step, value in budget.validations:
            validations.append({"step": step, budget.metric: value})

    device = budget.device or entry.hardware or None
    used_gpu = bool(budget.gpu_hours)
    windows_seen = budget.windows or 0
    threads = 1 if budget.threads is None else budget.threads
    record: dict[str, Any] = {
        "step": budget.steps,
        "start_steps": budget.start_steps,
        "cpu_seconds": 3600.0 * budget.cpu_hours,
        "validation": validations,
        "recipe": {
            "name": provenance.recipe,
            "changed": changes or None,
            "training": {"batch": round(windows_seen / budget.steps)},
        },
        "hardware": {
            "device": device if used_gpu else "cpu",
            "processor": device,
            "threads": threads,
        },
    }
    if windows_seen and budget.epochs:
        record["windows"] = round(windows_seen / budget.epochs)
    return record


def _read_cost(path: Path) -> EntryCost | None:
    """Return the cost of a frame that predictions were written with; None without."""
    costs = read_json(path)
    if "seconds_per_frame" not in costs or not costs.get("device"):
        return None
    return EntryCost(
        seconds_per_frame=float(costs["seconds_per_frame"]),
        device=str(costs["device"]),
        solver_seconds_per_frame=costs.get("solver_seconds_per_frame"),
    )


def read_json(path: Path) -> dict[str, Any]:
    """Return the mapping in a JSON file; an empty one if there is no file."""
    if not path.is_file():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UnreadableFileError(
            "cannot read the JSON file", where=str(path), got=error
        ) from None
    if not isinstance(content, dict):
        raise UnreadableFileError(
            "the JSON file holds no mapping",
            where=str(path),
            got=type(content).__name__,
        )
    return content


def count_start_steps(record: Mapping[str, Any]) -> int:
    """Return the steps of the earlier trainings from whose weights a training began."""
    budget = record.get("budget", record)
    return int(budget.get("start_steps") or 0)


def format_budget(record: Mapping[str, Any]) -> str:
    """Return steps and windows per step, as in "5,000 x 2"; a dash where unknown.

    Steps of earlier trainings, from whose weights it started, count too. They are
    assumed to have had as many windows as those of the last training.
    """
    if "windows" in record:
        steps = count_start_steps(record) + record["step"]
        return f"{steps:,} x {record['recipe']['training']['batch']}"
    if record.get("step") == 1:
        return "a fit"
    return "-"


def format_hardware(record: Mapping[str, Any]) -> str:
    """Return the machine on which a training ended: GPU, or processor and threads."""
    hardware = record.get("hardware")
    if not hardware:
        return "-"
    if hardware["device"] != "cpu":
        return str(hardware["device"])
    threads = f"{hardware['threads']} threads"
    if hardware["threads"] == 1:
        threads = "1 thread"
    return f"{hardware['processor']}, {threads}"
