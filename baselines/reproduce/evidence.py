"""What is known of each trained model: scores, costs, training; from the leaderboard and from runs.

The committed files suffice: score files and entries of ``leaderboard/``, and what each training
recorded, ``baselines/weights/<split>/<size>/<name>-<seed>.json``. Folders of runs,
``runs/<split>/<size>/<name>-<seed>/``, add what is not committed yet. A *name* is that of a
baseline, or of a baseline and a variant, as in ``gns-novorticity``.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lagbench.errors import UnreadableFileError
from lagbench.floors import FLOORS
from lagbench.metrics import Score
from lagbench.metrics.reductions import mean
from lagbench.registry import Registry, Size, load
from lagbench.score_file import NETCDF_NAME, read_statistics
from lagbench.yamlfile import read_yaml

__all__ = ["Cost", "Evidence", "Method", "Seeded", "Sources", "read_json"]

Floats = NDArray[np.float64]

BOARD = Path("leaderboard")
WEIGHTS = Path("baselines/weights")
RUN = re.compile(r"([a-z0-9]+(?:-[a-z0-9]+)*?)-(\d+)")
RECORD_NAME = "training.json"
COST_NAME = "predictions.json"


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What a predicted frame costs.

    Attributes:
        seconds_per_frame: of the model [s].
        device: where it ran.
        solver_seconds_per_frame: of the solver on the same machine [s]; None where not measured.
    """

    seconds_per_frame: float
    device: str
    solver_seconds_per_frame: float | None = None

    @property
    def speed_up(self) -> float | None:
        """Solver time over model time; None where the solver was not measured."""
        solver = self.solver_seconds_per_frame
        return None if solver is None else solver / self.seconds_per_frame


@dataclass(frozen=True, kw_only=True, eq=False)
class Seeded:
    """One training of a model.

    Attributes:
        seed: its seed; None for what has none.
        scores: scores by metric.
        record: what training.json says; empty where it is not there.
        path: file of the scores.
    """

    seed: int | None
    scores: Mapping[str, Score]
    record: Mapping[str, Any]
    path: Path

    @property
    def cpu_hours(self) -> float | None:
        """Processor time of the training [h]."""
        seconds = self.record.get("cpu_seconds")
        return None if seconds is None else float(seconds) / 3600.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Method:
    """A model with all its seeds.

    Attributes:
        name: as in ``gns`` or ``gns-novorticity``.
        seeds: one entry per training.
        cost: of a predicted frame; None where it was not measured.
        parameters: trained numbers; None where unknown.
    """

    name: str
    seeds: tuple[Seeded, ...]
    cost: Cost | None = None
    parameters: int | None = None

    @cached_property
    def scores(self) -> Mapping[str, Score]:
        """Scores by metric: the mean over the seeds that have a value, per scenario and frame."""
        common = [n for n in self.seeds[0].scores if all(n in held.scores for held in self.seeds)]
        return {name: _joined([held.scores[name] for held in self.seeds]) for name in common}

    def spread(self, metric: str) -> float:
        """Return the sample deviation over seeds of the mean over scenarios; NaN for one seed."""
        means = [held.scores[metric].mean for held in self.seeds]
        return float(np.std(means, ddof=1)) if len(means) > 1 else float("nan")

    def at(self, metric: str, frame: int, scenario: int | None = None) -> float:
        """Return a metric at an absolute frame, of one scenario or in the mean over all."""
        score = self.scores[metric]
        values = score.at(frame)
        return mean(values) if scenario is None else float(values[score.scenarios.index(scenario)])

    def frozen_at(self, metric: str, frame: int) -> Score:
        """Return a metric's score with its values at one frame in place of those over the horizon."""
        return replace(self.scores[metric], values=self.scores[metric].at(frame))


def _joined(scores: Sequence[Score]) -> Score:
    if len(scores) == 1:
        return scores[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # undefined for all seeds: NaN
        frames: Floats = np.nanmean([score.per_frame for score in scores], axis=0)
        values: Floats = np.nanmean([score.values for score in scores], axis=0)
    undefined = tuple(map(sum, zip(*(score.undefined for score in scores), strict=True)))
    return replace(scores[0], per_frame=frames, values=values, undefined=undefined)


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Where evidence lies.

    Attributes:
        board: the leaderboard's folder; None to use runs alone.
        weights: folder of committed weights and what their trainings recorded.
        runs: folder of runs; None to use committed files alone.
        registry: where splits are described; ours when None.
    """

    board: Path | None = BOARD
    weights: Path = WEIGHTS
    runs: Path | None = None
    registry: Registry | None = None

    def size(self, split: str, size: str) -> Size:
        """Return what the registry says of a split and size."""
        return (self.registry or load()).size(split, size)

    def run_folders(self, split: str, size: str) -> Iterator[tuple[str, int, Path]]:
        """Yield name, seed and folder of the runs of a size, and then those of its variants."""
        if self.runs is None:
            return
        homes = [self.runs / split / size, *sorted((self.runs / split).glob(f"{size}-*"))]
        for home in homes:
            for folder in sorted(home.glob("*-*")):
                found = RUN.fullmatch(folder.name)
                if found:
                    yield found[1], int(found[2]), folder


class Evidence:
    """What is known of the models on one split and size.

    Attributes:
        size: what the registry says.
        methods: models by name, floors among them.
        stale: files of scores that belong to another version of the data, which are left out.
    """

    def __init__(self, sources: Sources, split: str, size: str) -> None:
        """Read entries, score files and records.

        Args:
            sources: where they lie.
            split: name of the split.
            size: name of the size.

        Raises:
            UsageError: unknown split or size.
            UnreadableFileError: a file is not what its name promises.
        """
        self.size = sources.size(split, size)
        self.stale: list[Path] = []
        self._sources = sources
        board = sources.board
        entries = {path.stem: read_yaml(path) for path in self._entries(board)} if board else {}
        found: dict[str, dict[int | None, Seeded]] = {}
        costs: dict[str, Cost] = {}
        for name, entry in entries.items():
            for seed, path in _score_files(Path(board or ""), split, size, name, entry):
                self._add(found, name, seed, path, self._record(name, seed))
            costs |= _board_cost(name, entry)
        solver = next((c.solver_seconds_per_frame for c in costs.values() if c.speed_up), None)
        for name, seed, folder in sources.run_folders(split, size):
            path = folder / NETCDF_NAME
            if path.is_file() and not {seed, None} & found.get(name, {}).keys():
                self._add(
                    found, name, seed, path, read_json(folder / RECORD_NAME) or self._record(name, seed)
                )
                costs = _run_cost(name, folder, solver) | costs
        self.methods = {
            name: Method(
                name=name,
                seeds=tuple(seeds.values()),
                cost=costs.get(name),
                parameters=_parameters(seeds.values(), entries.get(name)),
            )
            for name, seeds in found.items()
        }

    def floors(self) -> dict[str, Method]:
        """Return the floors that were scored."""
        return {name: method for name, method in self.methods.items() if name in FLOORS}

    def models(self) -> dict[str, Method]:
        """Return everything else, in the order of names."""
        return {name: self.methods[name] for name in sorted(self.methods) if name not in FLOORS}

    def _entries(self, board: Path) -> list[Path]:
        return sorted((board / "submissions" / self.size.split / self.size.name).glob("*.yaml"))

    def _add(
        self,
        found: dict[str, dict[int | None, Seeded]],
        name: str,
        seed: int | None,
        path: Path,
        record: Mapping[str, Any],
    ) -> None:
        stored = read_statistics(path)
        measured = self.size.measured
        if measured and stored.identity["dataset_sha256"] != measured.dataset_sha256:
            self.stale.append(path)
            return
        held = Seeded(seed=seed, scores=stored.scores(), record=record, path=path)
        found.setdefault(name, {})[seed] = held

    def _record(self, name: str, seed: int | None) -> Mapping[str, Any]:
        folder = self._sources.weights / self.size.split / self.size.name
        return read_json(folder / f"{name}-{seed or 0}.json")


def _score_files(
    board: Path, split: str, size: str, name: str, entry: object
) -> Iterator[tuple[int | None, Path]]:
    """Yield seed and score file of every prediction of an entry."""
    try:
        seeds = [made.get("seed") for made in entry["predictions"]]  # type: ignore[index]
    except (TypeError, KeyError, AttributeError) as error:
        where = str(board / "submissions" / split / size / f"{name}.yaml")
        raise UnreadableFileError("no entry of a leaderboard", where=where, got=error) from None
    for seed in seeds:
        file = f"{name}.nc" if len(seeds) == 1 else f"{name}_{seed}.nc"
        yield seed, board / "scores" / split / size / file


def _board_cost(name: str, entry: Mapping[str, Any]) -> dict[str, Cost]:
    return {name: Cost(**entry["cost"])} if entry.get("cost") else {}


def _run_cost(name: str, folder: Path, solver: float | None) -> dict[str, Cost]:
    said = read_json(folder / COST_NAME)
    if "seconds_per_frame" not in said:
        return {}
    seconds, device = float(said["seconds_per_frame"]), str(said.get("device", ""))
    return {name: Cost(seconds_per_frame=seconds, device=device, solver_seconds_per_frame=solver)}


def _parameters(seeds: Iterable[Seeded], entry: Mapping[str, Any] | None) -> int | None:
    known = [held.record.get("parameters") for held in seeds] + [(entry or {}).get("parameters")]
    return next((int(value) for value in known if value is not None), None)


def read_json(path: Path) -> dict[str, Any]:
    """Return what a JSON file holds; nothing where it is not there.

    Raises:
        UnreadableFileError: it holds no JSON mapping.
    """
    if not path.is_file():
        return {}
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UnreadableFileError("cannot read the JSON file", where=str(path), got=error) from None
    if not isinstance(held, dict):
        raise UnreadableFileError("no JSON mapping", where=str(path), got=type(held).__name__)
    return held
