"""What is known of each trained model: scores, costs, training; from the leaderboard and from runs.

The committed files suffice: score files and entries of ``leaderboard/``, and what each training
recorded, ``baselines/weights/<split>/<size>/<name>-<seed>.json``. Folders of runs,
``runs/<split>/<size>/<name>-<seed>/``, add what is not committed yet. A *name* is that of a
baseline, or of a baseline and a variant, as in ``gns-novorticity``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lagbench.data.registry import Registry, Size, load
from lagbench.data.yamlfile import read_yaml
from lagbench.errors import UnreadableFileError
from lagbench.floors import FLOORS
from lagbench.scoring.score_file import NETCDF_NAME, read_statistics

from .method import Cost, Method, Seeded

__all__ = ["Evidence", "Sources", "read_json"]

BOARD = Path("leaderboard")
WEIGHTS = Path("baselines/weights")
RUN = re.compile(r"([a-z0-9]+(?:-[a-z0-9]+)*?)-(\d+)")
UNDER_WAY = ("running", "interrupted")
"""States of a training that is not over."""

RECORD_NAME = "training.json"
COST_NAME = "predictions.json"


@dataclass(frozen=True, kw_only=True)
class Sources:
    """Where evidence lies."""

    board: Path | None = BOARD  # the leaderboard's folder; None to use runs alone
    weights: Path = WEIGHTS  # folder of committed weights and what their trainings recorded
    runs: Path | None = None  # folder of runs; None to use committed files alone
    recipe: str | None = None  # variant of the recipes whose runs to read; None for the size's own
    registry: Registry | None = None  # where splits are described; ours when None

    def size(self, split: str, size: str) -> Size:
        """Return what the registry says of a split and size."""
        return (self.registry or load()).size(split, size)

    def run_folders(self, split: str, size: str) -> Iterator[tuple[str, int, Path]]:
        """Yield name, seed and folder of the runs of a size.

        Without a recipe also those of other recipes, ``<size>-<recipe>/``, as variants.
        """
        if self.runs is None:
            return
        homes = {f"-{self.recipe}" if self.recipe else "": self.runs / split / self._home(size)}
        if self.recipe is None:
            homes |= {path.name[len(size) :]: path for path in sorted((self.runs / split).glob(f"{size}-*"))}
        for recipe, home in homes.items():
            for folder in sorted(home.glob("*-*")):
                found = RUN.fullmatch(folder.name)
                if found:
                    yield found[1] + (recipe if self.recipe is None else ""), int(found[2]), folder

    def _home(self, size: str) -> str:
        return f"{size}-{self.recipe}" if self.recipe else size


class Evidence:
    """What is known of the models on one split and size."""

    def __init__(self, sources: Sources, split: str, size: str) -> None:
        """Read entries, score files and records."""
        self.size = sources.size(split, size)  # what the registry says
        # files of scores that belong to another version of the data, which are left out
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
        for name, seed, folder in sources.run_folders(split, size):
            path = folder / NETCDF_NAME
            if path.is_file() and not {seed, None} & found.get(name, {}).keys():
                self._add(
                    found, name, seed, path, read_json(folder / RECORD_NAME) or self._record(name, seed)
                )
                costs = _run_cost(name, folder) | costs
        # models by name, floors among them
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

    def trained(self, name: str) -> bool:
        """Return whether there is a record of a training, with scores or without."""
        folder = self._sources.weights / self.size.split / self.size.name
        return any(folder.glob(f"{name}-[0-9]*.json"))

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


def _run_cost(name: str, folder: Path) -> dict[str, Cost]:
    said = read_json(folder / COST_NAME)
    if "seconds_per_frame" not in said:
        return {}
    seconds, device = float(said["seconds_per_frame"]), str(said.get("device", ""))
    solver = said.get("solver_seconds_per_frame")
    return {name: Cost(seconds_per_frame=seconds, device=device, solver_seconds_per_frame=solver)}


def _parameters(seeds: Iterable[Seeded], entry: Mapping[str, Any] | None) -> int | None:
    known = [held.record.get("parameters") for held in seeds] + [(entry or {}).get("parameters")]
    return next((int(value) for value in known if value is not None), None)


def read_json(path: Path) -> dict[str, Any]:
    """Return what a JSON file holds; nothing where it is not there."""
    if not path.is_file():
        return {}
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UnreadableFileError("cannot read the JSON file", where=str(path), got=error) from None
    if not isinstance(held, dict):
        raise UnreadableFileError("no JSON mapping", where=str(path), got=type(held).__name__)
    return held
