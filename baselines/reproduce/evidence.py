"""What is known of each model: scores, costs, training; from the leaderboard and from
runs.

The committed files suffice: entries and score files of ``leaderboard/``, and what each
training recorded, ``<weights>/<split>/<size>/<name>_<seed>.json``. Folders of runs,
``runs/<split>/<size>/<name>-<seed>/``, add what is not committed yet. A *name* is that
of a baseline, or of a baseline and a variant, as in ``gns-novorticity``.
"""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from lagbench.data.registry import Registry, Size, load
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import UnreadableFileError
from lagbench.metrics.aggregate import Score
from lagbench.metrics.metric import mean
from lagbench.metrics.table import ranking_metric
from lagbench.references.shipped import shipped, shipped_path
from lagbench.references.table import COUNTING, REFERENCES
from lagbench.scoring.score_file import NETCDF_NAME, read_statistics
from lagbench.scoring.skill import best_reference

from .thesis import ROSTER

BOARD = Path("leaderboard")
WEIGHTS = BOARD / "weights"
"""Where committed weights and the records of their trainings lie, as
`lagbench submit --weights` put them.
"""

STUDIES = Path("docs/studies")
"""Where committed results lie that are no entries: of studies and protocols of the
thesis.
"""

RUN = re.compile(r"([a-z0-9]+(?:-[a-z0-9]+)*?)-(\d+)")
WORDS = re.compile(r"recipe (\S+), step \d+(?:, (?:predicted with )?(.*))?$")
"""What predictions say of a training by one of our recipes: its name and what was
changed.
"""

RECORD_NAME = "training.json"
COST_NAME = "predictions.json"


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a predicted frame costs."""

    seconds_per_frame: float  # of the model [s]
    device: str  # where it ran
    # of the solver on the same machine [s]; None if not measured
    solver_seconds_per_frame: float | None = None

    @property
    def speed_up(self) -> float | None:
        """Solver time over model time; None where the solver was not measured."""
        solver = self.solver_seconds_per_frame
        if solver is None:
            return None
        return solver / self.seconds_per_frame


@dataclass(frozen=True, kw_only=True, eq=False)
class Seeded:
    """One training of a model."""

    seed: int | None  # None for what has none
    scores: Mapping[str, Score]  # by metric
    # what training.json or else the entry says of it; empty where none does
    record: Mapping[str, Any]
    path: Path  # file of the scores

    @property
    def cpu_hours(self) -> float | None:
        """Processor time of the training without its validations, as entries tell it
        [h].
        """
        if "budget" in self.record:
            hours = self.record["budget"]["cpu_hours"]
            if hours is None:
                return None
            return float(hours)
        seconds = self.record.get("cpu_seconds")
        if seconds is None:
            return None
        return (
            float(seconds) - float(self.record.get("validation_cpu_seconds") or 0.0)
        ) / 3600.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Method:
    """A model with all its seeds."""

    name: str  # as in gns or gns-novorticity
    seeds: tuple[Seeded, ...]  # one per training
    cost: Cost | None = None  # of a predicted frame; None where it was not measured
    parameters: int | None = None  # trained numbers; None where unknown

    @cached_property
    def scores(self) -> Mapping[str, Score]:
        """Scores by metric: the mean over the seeds that have a value, per scenario and
        frame.
        """
        common = [
            n
            for n in self.seeds[0].scores
            if all(n in held.scores for held in self.seeds)
        ]
        return {
            name: _joined([held.scores[name] for held in self.seeds]) for name in common
        }

    @property
    def hours_per_seed(self) -> float | None:
        """Processor time of a training [h], the mean of those recorded; None where none
        was.
        """
        known = [hours for held in self.seeds if (hours := held.cpu_hours) is not None]
        if known:
            return fmean(known)
        return None

    def of_seeds(self, seeds: Collection[int | None]) -> Method:
        """Return this model with the trainings of some seeds only, in their order."""
        held = [one for one in self.seeds if one.seed in seeds]
        return replace(
            self,
            seeds=tuple(
                sorted(held, key=lambda one: -1 if one.seed is None else one.seed)
            ),
        )

    def spread(self, metric: str) -> float:
        """Return the sample deviation over seeds of the mean over scenarios; NaN for
        one seed.
        """
        means = [held.scores[metric].mean for held in self.seeds]
        if len(means) > 1:
            return float(np.std(means, ddof=1))
        return math.nan

    def at(self, metric: str, frame: int, scenario: int | None = None) -> float:
        """Return a metric at an absolute frame, of one scenario or the mean over all;
        NaN if not measured.

        Of floors only means are kept.
        """
        if metric not in self.scores:
            return math.nan
        values = self.scores[metric].at(frame)
        scenarios = self.scores[metric].scenarios
        if scenario is None:
            return mean(values)
        if len(values) == len(scenarios):
            return float(values[scenarios.index(scenario)])
        return math.nan

    def over_horizon(self, metric: str, scenario: int) -> float:
        """Return a metric of one scenario over the horizon; NaN if not measured."""
        score = self.scores.get(metric)
        if score is None:
            return math.nan
        return float(score.values[score.scenarios.index(scenario)])


def _joined(scores: Sequence[Score]) -> Score:
    if len(scores) == 1:
        return scores[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # undefined for all seeds: NaN
        frames = np.nanmean([score.per_frame for score in scores], axis=0)
        values = np.nanmean([score.values for score in scores], axis=0)
    undefined = tuple(
        map(sum, zip(*(score.undefined for score in scores), strict=True))
    )
    return replace(scores[0], per_frame=frames, values=values, undefined=undefined)


def ordered(scores: Mapping[str, Score]) -> list[str]:
    """Return names from the least mean loss to the greatest; undefined ones last."""

    def loss(name: str) -> float:
        value = scores[name].mean
        if math.isnan(value):
            return math.inf
        return scores[name].metric.loss(value)

    return sorted(scores, key=lambda name: (loss(name), name))


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Where evidence lies."""

    board: Path | None = BOARD  # the leaderboard's folder; None to use runs alone
    # folder of committed weights and what their trainings recorded
    weights: Path = WEIGHTS
    runs: Path | None = None  # folder of runs; None to use committed files alone
    studies: Path = STUDIES  # folder of committed results that are no entries
    # variant of the recipes whose runs to read; None for the size's own
    recipe: str | None = None
    registry: Registry | None = None  # where splits are described; ours when None
    left_out: frozenset[Path] = frozenset()  # folders of runs that are not to be read

    def size(self, split: str, size: str) -> Size:
        """Return what the registry says of a split and size."""
        return (self.registry or load()).size(split, size)

    def entries(self, split: str, size: str) -> dict[str, Path]:
        """Return the entries of the board by name."""
        if self.board:
            folder = self.board / "submissions" / split / size
        else:
            folder = None
        if folder:
            return {path.stem: path for path in sorted(folder.glob("*.yaml"))}
        return {}

    def record(
        self, split: str, size: str, name: str, seed: int | None
    ) -> Mapping[str, Any]:
        """Return what a committed training recorded; nothing where it is not there."""
        return read_json(self.weights / split / size / f"{name}_{seed or 0}.json")

    def run_folders(self, split: str, size: str) -> Iterator[tuple[str, int, Path]]:
        """Yield name, seed and folder of the runs of a size.

        Without a recipe also those of other recipes, ``<size>-<recipe>/``, as variants.
        """
        if self.runs is None:
            return
        home = self.runs / split
        homes = {"": home / (f"{size}-{self.recipe}" if self.recipe else size)}
        if self.recipe is None:
            homes |= {
                path.name[len(size) :]: path for path in sorted(home.glob(f"{size}-*"))
            }
        for variant, folder in homes.items():
            for run in sorted(folder.glob("*-*")):
                if run not in self.left_out and (found := RUN.fullmatch(run.name)):
                    yield found[1] + variant, int(found[2]), run


class Evidence:
    """What is known of the models on one split and size."""

    def __init__(self, sources: Sources, split: str, size: str) -> None:
        """Read entries, score files and records; committed ones win over runs of the
        same seed.
        """
        self.size = sources.size(split, size)
        self.methods: dict[str, Method] = {}  # by name, floors among them
        # score files of another version of the data, which are left out
        self.stale: list[Path] = []
        self._weights = sources.weights / split / size
        for name, path in sources.entries(split, size).items():
            entry = read_yaml(path)
            files = list(_score_files(path, entry))  # refuses what is no entry
            if entry.get("cost"):
                cost = Cost(**entry["cost"])
            else:
                cost = None
            for made, file in files:
                seed = made.get("seed")
                record = sources.record(split, size, name, seed) or _told(entry, made)
                if not record and name in ROSTER and ROSTER[name].weights:
                    record = sources.record(split, size, ROSTER[name].weights, seed)
                self._add(name, seed, file, record, cost, entry.get("parameters"))
        committed = {
            (name, held.seed)
            for name, method in self.methods.items()
            for held in method.seeds
        }
        for name, seed, folder in sources.run_folders(split, size):
            file = folder / NETCDF_NAME
            if file.is_file() and not {(name, seed), (name, None)} & committed:
                record = read_json(folder / RECORD_NAME) or sources.record(
                    split, size, name, seed
                )
                said = read_json(folder / COST_NAME)
                cost = None
                if "seconds_per_frame" in said:
                    cost = Cost(
                        seconds_per_frame=float(said["seconds_per_frame"]),
                        device=str(said.get("device", "")),
                        solver_seconds_per_frame=said.get("solver_seconds_per_frame"),
                    )
                self._add(name, seed, file, record, cost)
        for floor in (shipped(self.size) or {}).values():
            held = Seeded(
                seed=None, scores=floor.scores, record={}, path=shipped_path(self.size)
            )
            self.methods.setdefault(floor.name, Method(name=floor.name, seeds=(held,)))

    def _add(
        self,
        name: str,
        seed: int | None,
        path: Path,
        record: Mapping[str, Any],
        cost: Cost | None,
        parameters: int | None = None,
    ) -> None:
        """Add one training to a method, unless its scores are of other data."""
        stored = read_statistics(path)
        measured = self.size.measured
        if measured and stored.identity["dataset_sha256"] != measured.dataset_sha256:
            self.stale.append(path)
            return
        known = self.methods.get(name) or Method(name=name, seeds=())
        self.methods[name] = Method(
            name=name,
            seeds=(
                *known.seeds,
                Seeded(seed=seed, scores=stored.scores(), record=record, path=path),
            ),
            cost=known.cost or cost,
            parameters=known.parameters or record.get("parameters") or parameters,
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
    def floors(self) -> dict[str, Method]:
        """The floors that were scored."""
        return {
            name: method for name, method in self.methods.items() if name in REFERENCES
        }

    @property
    def models(self) -> dict[str, Method]:
        """Everything else, in the order of names."""
        return {
            name: self.methods[name]
            for name in sorted(self.methods)
            if name not in REFERENCES
        }

    def order(self, names: Collection[str] | None = None) -> list[str]:
        """Return those of some models, of all methods by default, that are ranked, best
        first.
        """
        chosen = {
            n: self.methods[n]
            for n in (self.methods if names is None else names)
            if n in self.methods
        }
        return ordered(
            {
                n: m.scores[self.ranking]
                for n, m in chosen.items()
                if self.ranking in m.scores
            }
        )

    @property
    def best_floor(self) -> str | None:
        """Name of the floor that skill is measured from, as the scorer has it; None
        where none was scored.
        """
        counting = {
            n: m
            for n, m in self.methods.items()
            if n in COUNTING and self.ranking in m.scores
        }
        return best_reference({n: m.scores[self.ranking] for n, m in counting.items()})

    def skill(self, name: str) -> float:
        """Return ``1 - score / score of the best floor`` by the ranking metric: 1
        perfect, 0 no learning.
        """
        floor = self.best_floor
        if floor is None or self.ranking not in self.methods[name].scores:
            return math.nan
        return (
            1.0
            - self.methods[name].scores[self.ranking].mean
            / self.methods[floor].scores[self.ranking].mean
        )

    def trained(self, name: str) -> bool:
        """Return whether there is a committed record of a training, with scores or
        without.
        """
        return any(self._weights.glob(f"{name}_[0-9]*.json"))


def _score_files(path: Path, entry: Any) -> Iterator[tuple[Mapping[str, Any], Path]]:  # noqa: ANN401
    """Yield every prediction of an entry, submissions/<split>/<size>/<name>.yaml, and
    its score file.
    """
    try:
        predictions = [(made.get("seed"), made) for made in entry["predictions"]]
    except (TypeError, KeyError, AttributeError) as error:
        raise UnreadableFileError(
            "no entry of a leaderboard", where=str(path), got=error
        ) from None
    board = path.parents[3]
    scores = board / "scores" / path.parent.relative_to(board / "submissions")
    for seed, made in predictions:
        yield (
            made,
            scores
            / (
                f"{path.stem}.nc" if len(predictions) == 1 else f"{path.stem}_{seed}.nc"
            ),
        )


def _told(entry: Mapping[str, Any], made: Mapping[str, Any]) -> dict[str, Any]:
    """Return what an entry says of a training by one of our recipes, in the terms of
    training.json.
    """
    words = WORDS.search(entry.get("training") or "")
    paid = made.get("budget") or {}
    if (
        not paid and len(entry["predictions"]) == 1
    ):  # of several seeds the entry has the mean
        paid = entry.get("budget") or {}
    if not words or not paid.get("steps") or paid.get("cpu_hours") is None:
        return {}
    device = paid.get("device") or entry.get("hardware")
    windows = paid.get("windows")
    metric = paid.get("metric")
    if metric:
        validations = paid.get("validations")
    else:
        validations = None
    told = {
        "step": paid["steps"],
        "cpu_seconds": 3600.0 * paid["cpu_hours"],
        "validation": [
            {"step": step, metric: value} for step, value in validations or ()
        ],
        "recipe": {
            "name": words[1],
            "changed": words[2],
            "training": {"batch": round((windows or 0) / paid["steps"])},
        },
        "hardware": {
            "device": device if paid.get("gpu_hours") else "cpu",
            "processor": device,
            "threads": paid.get("threads", 1),
        },
    }
    return told | (
        {"windows": round(windows / paid["epochs"])}
        if windows and paid.get("epochs")
        else {}
    )


def read_json(path: Path) -> dict[str, Any]:
    """Return what a JSON file holds; nothing where it is not there."""
    if not path.is_file():
        return {}
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UnreadableFileError(
            "cannot read the JSON file", where=str(path), got=error
        ) from None
    if not isinstance(held, dict):
        raise UnreadableFileError(
            "no JSON mapping", where=str(path), got=type(held).__name__
        )
    return held


def budget(record: Mapping[str, Any]) -> str:
    """Return steps and windows of a step, as in "5,000 x 2"; a dash where unknown."""
    if "windows" not in record:
        if record.get("step") == 1:
            return "closed form"
        return "-"
    return f"{record['step']:,} x {record['recipe']['training']['batch']}"


def hardware(record: Mapping[str, Any]) -> str:
    """Return the machine of a training: its GPU, or its processor and threads."""
    said = record.get("hardware")
    if not said:
        return "-"
    if said["device"] != "cpu":
        return str(said["device"])
    if said["threads"] == 1:
        threads = "1 thread"
    else:
        threads = f"{said['threads']} threads"
    return f"{said['processor']}, {threads}"
